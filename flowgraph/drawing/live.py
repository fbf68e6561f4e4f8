"""A run in a browser while it goes on: a server for this machine alone, and what it sends.

The server listens on the loopback address only. That keeps other machines out, but not the pages of other
sites in the same browser, which may ask for any address: so whoever names another host than this one, or
comes from another origin, is refused, and nothing that a browser sends changes the run.

What is sent goes by WebSocket (RFC 6455), a text a message. The run never waits for a browser: one that does
not keep up misses messages, and one that comes late is given the last ones.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import queue
import struct
import threading
import time as clock
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from flowgraph.data.inputs import Inputs
from flowgraph.drawing.model import describe
from flowgraph.drawing.page import page
from flowgraph.drawing.recorder import Recorder
from flowgraph.drawing.text import doc_words
from flowgraph.errors import writes
from flowgraph.language.graph import Graph, Wire

HOST = "127.0.0.1"
EVERY = 0.05
"""Seconds between two messages, at least."""

_GUID = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"  # RFC 6455, sec. 1.3
_KEPT, _LONGEST = 400, 65_536
_TEXT, _CLOSE, _PING, _PONG = 1, 8, 9, 10


class LiveServer:
    """Serves one page, and sends messages to all who look at it.

    Args:
        page: the text of the page, for its address (`127.0.0.1:PORT`).
        port: 0 for any that is free.

    Raises:
        OutputError: where the port is taken.
    """

    def __init__(self, page: Callable[[str], str], port: int = 0) -> None:
        with writes(f"{HOST}:{port}"):
            self._server = _Server((HOST, port), _Handler)
        self._server.live = self
        self.port = int(self._server.server_address[1])
        self.hosts = tuple(f"{name}:{self.port}" for name in (HOST, "localhost"))
        self.page = page(self.hosts[0])
        self.url = f"http://{self.hosts[0]}/"
        self._viewers: list[queue.Queue[bytes | None]] = []
        self._last: deque[bytes] = deque(maxlen=_KEPT)
        self._changed = threading.Condition()
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()

    def __enter__(self) -> LiveServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, message: Any) -> None:
        """Send what JSON can hold to all viewers."""
        made = frame(json.dumps(message, separators=(",", ":"), allow_nan=False).encode())
        with self._changed:
            self._last.append(made)
            for viewer in self._viewers:
                _put_newest(viewer, made)

    def wait(self, there: bool, seconds: float | None = None) -> bool:
        """Wait until somebody looks, or with `there` False until nobody does; whether it came to that."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._viewers) is there, seconds)

    def close(self) -> None:
        """Say goodbye to all viewers and give the port back."""
        with self._changed:
            for viewer in self._viewers:
                _put_newest(viewer, None)
        self._server.shutdown()
        self._server.server_close()

    def joined(self) -> queue.Queue[bytes | None]:
        """The messages for one more viewer, with the last ones in it."""
        viewer: queue.Queue[bytes | None] = queue.Queue(2 * _KEPT)
        with self._changed:
            for message in self._last:
                viewer.put_nowait(message)
            self._viewers.append(viewer)
            self._changed.notify_all()
        return viewer

    def answer(self, viewer: queue.Queue[bytes | None], message: bytes) -> None:
        """To one viewer, where its queue has room; as all that fills a queue, while nothing else does."""
        with self._changed:
            if not viewer.full():
                viewer.put_nowait(message)

    def left(self, viewer: queue.Queue[bytes | None]) -> None:
        with self._changed:
            if viewer in self._viewers:
                self._viewers.remove(viewer)
            self._changed.notify_all()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    live: LiveServer


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    protocol_version = "HTTP/1.1"
    timeout = 60

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: standard error is the command's."""

    def do_GET(self) -> None:
        live = self.server.live
        if self.headers.get("Host") not in live.hosts:
            return self._refuse(403, "this server is for the machine it runs on")
        origin = self.headers.get("Origin")
        if origin is not None and origin not in tuple(f"http://{host}" for host in live.hosts):
            return self._refuse(403, "this server is for its own page")
        if self.path == "/live":
            return self._socket(live, origin)
        if self.path != "/":
            return self._refuse(404, "there is one page here: /")
        body = live.page.encode()
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("X-Frame-Options", "DENY")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def _refuse(self, status: int, why: str) -> None:
        body = f"{why}\n".encode()
        self.close_connection = True
        self.send_response(status)
        self.send_header("Content-Type", "text/plain; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)

    def _socket(self, live: LiveServer, origin: str | None) -> None:
        key = self.headers.get("Sec-WebSocket-Key")
        upgrade = (self.headers.get("Upgrade") or "").lower()
        if origin is None:
            return self._refuse(403, "a WebSocket says from which page it comes")
        if upgrade != "websocket" or key is None or self.headers.get("Sec-WebSocket-Version") != "13":
            return self._refuse(400, "this is a WebSocket")
        self.close_connection = True
        self.send_response(101)
        self.send_header("Upgrade", "websocket")
        self.send_header("Connection", "Upgrade")
        accept = hashlib.sha1(key.encode() + _GUID, usedforsecurity=False).digest()
        self.send_header("Sec-WebSocket-Accept", base64.b64encode(accept).decode())
        self.end_headers()
        self.wfile.flush()
        self.connection.settimeout(None)
        viewer = live.joined()
        writer = threading.Thread(target=self._write, args=(viewer,), daemon=True)
        writer.start()
        try:
            self._read(viewer)
        except OSError:  # it has gone without a word
            pass
        finally:
            live.left(viewer)
            viewer.queue.clear()
            viewer.put_nowait(None)
            writer.join(2.0)

    def _write(self, viewer: queue.Queue[bytes | None]) -> None:
        try:
            while (message := viewer.get()) is not None:
                self.connection.sendall(message)
            self.connection.sendall(frame(struct.pack(">H", 1001), _CLOSE))
        except OSError:  # it has gone; the reader sees that too
            return

    def _read(self, viewer: queue.Queue[bytes | None]) -> None:
        """Until the browser leaves; of what it sends only a ping has an answer."""
        while True:
            head = self.rfile.read(2)
            if len(head) < 2 or not head[1] & 0x80:  # what a browser sends is masked
                return
            kind, size = head[0] & 0x0F, head[1] & 0x7F
            if size > 125:
                size = int.from_bytes(self.rfile.read(2 if size == 126 else 8), "big")
            if kind == _CLOSE or size > _LONGEST:
                return
            mask = self.rfile.read(4)
            sent = bytes(b ^ mask[k % 4] for k, b in enumerate(self.rfile.read(size)))
            if kind == _PING:
                self.server.live.answer(viewer, frame(sent, _PONG))


def _put_newest(viewer: queue.Queue[bytes | None], message: bytes | None) -> None:
    """Queue a message for a viewer; the oldest gives way where its queue is full."""
    if viewer.full():
        with suppress(queue.Empty):  # its thread may have emptied it meanwhile
            viewer.get_nowait()
    viewer.put_nowait(message)


def frame(payload: bytes, kind: int = _TEXT) -> bytes:
    """A whole frame of a WebSocket, from the server."""
    size = len(payload)
    if size < 126:
        return bytes([0x80 | kind, size]) + payload
    if size < 65_536:
        return bytes([0x80 | kind, 126]) + struct.pack(">H", size) + payload
    return bytes([0x80 | kind, 127]) + struct.pack(">Q", size) + payload


class Sender:
    """A watcher of `flowgraph.engines.watched` that sends what is on the wires, and keeps to the time.

    Args:
        server: that sends it.
        graph: of the run.
        inputs: its recording; None for a live run.
        speed: how much faster than the events were the run may be; 0 for as fast as it can.

    Attributes:
        facts: asked for with each message: what else can be told of the run, texts by name.
    """

    def __init__(self, server: LiveServer, graph: Graph, inputs: Inputs | None, speed: float = 1.0) -> None:
        self.server, self.speed, self.stride = server, speed, 1
        self.facts: Callable[[], Mapping[str, str]] = dict
        self._recorder = Recorder(graph, inputs)
        self._begin: tuple[int, float] | None = None
        self._sent = -math.inf
        self._unsent: tuple[int, int, Mapping[Wire, Any], Mapping[int, Any]] | None = None
        self.ticks = 0

    def see(
        self, time: int, seen: Mapping[Wire, tuple[int, Any]], read: Mapping[int, tuple[int, Any]]
    ) -> None:
        now = clock.monotonic()
        self.ticks += 1
        if self._begin is None:
            self._begin = time, now
        first, start = self._begin
        if self.speed:
            early = start + (time - first) * 1e-9 / self.speed - now
            if early > 0.002:
                clock.sleep(early)
                now += early
        self._unsent = time, first, seen, read
        if now - self._sent >= EVERY:
            self._sent = now
            self._send(*self._unsent)

    def _send(self, time: int, first: int, seen: Mapping[Wire, Any], read: Mapping[int, Any]) -> None:
        self._unsent = None
        row = self._recorder.row(time, seen, read)
        wires = {
            key: [(at - first) * 1e-9, [float(f"{x:.6g}") if math.isfinite(x) else None for x in values]]
            for key, (at, values) in row.items()
        }
        told = dict(self.facts())
        self.server.send({"t": (time - first) * 1e-9, "ticks": self.ticks, "wires": wires, "facts": told})

    def took(self, blocks: Mapping[str, tuple[float, int]]) -> None:
        if self._unsent is not None:  # how the run ended is shown, too
            self._send(*self._unsent)
        each = {path: [1e6 * seconds / max(times, 1), times] for path, (seconds, times) in blocks.items()}
        self.server.send({"ended": True, "ticks": self.ticks, "blocks": each, "facts": dict(self.facts())})


class LiveView(Sender):
    """A page on this machine in which a run is watched while it goes on; the watcher of that run.

        with LiveView(graph) as view, Live(graph, watcher=view) as live:
            print(view.url)  # open it, then push

    Args:
        graph: of the run.
        inputs: its recording, for `simulate_watched`; left out for `Live`.
        title: a line under the name of the graph; its documentation where there is none.
        speed: with a recording, how much faster than the events were the run may be; 0 for as fast as it can.
        port: of this machine; 0 for any that is free.

    Raises:
        OutputError: where the port is taken.
    """

    def __init__(
        self,
        graph: Graph,
        inputs: Inputs | None = None,
        *,
        title: str = "",
        speed: float = 1.0,
        port: int = 0,
    ) -> None:
        server = LiveServer(live_page(graph, inputs, title), port)
        super().__init__(server, graph, inputs, 0.0 if inputs is None else speed)

    @property
    def url(self) -> str:
        """The address of the page."""
        return self.server.url

    def wait(self, there: bool, seconds: float | None = None) -> bool:
        """Wait until somebody looks, or with `there` False until nobody does; whether it came to that."""
        return self.server.wait(there, seconds)

    def close(self) -> None:
        """Say goodbye to all viewers and give the port back."""
        self.server.close()

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def live_page(graph: Graph, inputs: Inputs | None, title: str) -> Callable[[str], str]:
    """The page of a run that goes on, for the address that sends it."""
    data = {"graph": describe(graph, inputs=inputs), "parts": Recorder(graph, inputs).parts()}
    words = title or doc_words(graph.doc)
    return lambda host: page("live", graph.name, words, data, ("diagram", "live"), asks=f"ws://{host}")


__all__ = ["LiveServer", "LiveView", "Sender", "live_page"]

"""The server of a live run: whom it lets in, what it sends, and that it waits for nobody."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from flowgraph import Live, LiveView, OutputError, simulate
from flowgraph.drawing import live
from flowgraph.drawing.live import LiveServer, Sender, frame, live_page
from flowgraph.engines.watched import simulate_watched
from tests.drawing.test_page import _Reader
from tests.engines.test_watched import INPUTS, built
from tests.support import MS, same_state


@pytest.fixture
def server() -> Iterator[LiveServer]:
    with LiveServer(lambda host: f"<p>{host}</p>") as made:
        yield made


def asked(server: LiveServer, path: str = "/", **headers: str) -> tuple[int, str]:
    """Status and body of an answer."""
    with connection(server, path, **headers) as connected:
        answer = b""
        while part := connected.recv(65_536):
            answer += part
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split()[1]), body.decode()


def connection(server: LiveServer, path: str, **headers: str) -> socket.socket:
    lines = {
        "Host": server.hosts[0],
        "Connection": "close",
        **{k.replace("_", "-"): v for k, v in headers.items()},
    }
    made = socket.create_connection(("127.0.0.1", server.port), timeout=60)
    text = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
    made.sendall(f"GET {path} HTTP/1.1\r\n{text}\r\n".encode())
    return made


class Viewer:
    """A browser's end of a WebSocket."""

    def __init__(self, server: LiveServer, **headers: str) -> None:
        key = base64.b64encode(os.urandom(16)).decode()
        given = {
            "Origin": server.url[:-1], "Upgrade": "websocket", "Connection": "Upgrade",
            "Sec_WebSocket_Key": key, "Sec_WebSocket_Version": "13", **headers,
        }  # fmt: skip
        self.file = connection(server, "/live", **given).makefile("rwb")
        self.status = int(self.file.readline().split()[1])
        self.headers = {}
        while line := self.file.readline().strip():
            name, _, value = line.decode().partition(": ")
            self.headers[name] = value

    def next(self) -> tuple[int, bytes]:
        head = self.file.read(2)
        size = head[1]
        if size == 126:
            (size,) = struct.unpack(">H", self.file.read(2))
        elif size == 127:
            (size,) = struct.unpack(">Q", self.file.read(8))
        return head[0] & 0x0F, self.file.read(size)

    def message(self) -> Any:
        kind, text = self.next()
        assert kind == 1
        return json.loads(text)

    def send(self, kind: int, payload: bytes = b"") -> None:
        mask = b"abcd"
        masked = bytes(b ^ mask[k % 4] for k, b in enumerate(payload))
        self.file.write(bytes([0x80 | kind, 0x80 | len(payload)]) + mask + masked)
        self.file.flush()


def test_the_page_is_for_this_machine_only(server: LiveServer) -> None:
    assert asked(server) == (200, f"<p>127.0.0.1:{server.port}</p>")
    assert asked(server, Host=f"localhost:{server.port}")[0] == 200
    assert asked(server, "/other")[0] == 404
    assert server._server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "[::1]:{port}"]
)
@pytest.mark.parametrize("path", ["/", "/live"])
def test_other_hosts_are_refused(host: str, path: str, server: LiveServer) -> None:
    status, body = asked(server, path, Host=host.format(port=server.port), Origin=server.url[:-1])
    assert (status, body) == (403, "this server is for the machine it runs on\n")


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "https://127.0.0.1:{port}", "null", "http://127.0.0.1:1"]
)
def test_other_origins_are_refused(origin: str, server: LiveServer) -> None:
    given = origin.format(port=server.port)
    assert asked(server, Origin=given)[0] == 403
    assert Viewer(server, Origin=given).status == 403
    assert server.wait(True, 0.05) is False  # nobody was let in


def test_a_socket_must_be_one_and_say_where_it_comes_from(server: LiveServer) -> None:
    assert asked(server, "/live")[0] == 403
    assert asked(server, "/live", Origin=server.url[:-1])[0] == 400


def test_the_handshake_is_that_of_the_standard(server: LiveServer) -> None:
    viewer = Viewer(server, Sec_WebSocket_Key="dGhlIHNhbXBsZSBub25jZQ==")
    assert viewer.status == 101
    assert viewer.headers["Sec-WebSocket-Accept"] == "s3pPLMBiTxaQ9kYGzzhZRbK+xOo="  # RFC 6455, sec. 1.3


def test_messages_of_every_length_arrive_and_the_late_get_the_last(server: LiveServer) -> None:
    server.send("before")
    viewer = Viewer(server)
    assert viewer.message() == "before"
    for size in (0, 125, 126, 65_535, 70_000):
        server.send("x" * size)
        assert viewer.message() == "x" * size
    viewer.send(9, b"still there?")
    assert viewer.next() == (10, b"still there?")
    assert server.wait(True, 60.0)
    viewer.send(8)
    assert server.wait(False, 60.0)
    assert frame(b"abc") == b"\x81\x03abc"


def test_a_viewer_that_does_not_read_does_not_hold_up_the_run(server: LiveServer) -> None:
    """Nor does one that asks all the time whether we are there, so that its queue fills from two sides."""
    silent = Viewer(server)
    assert silent.status == 101
    assert server.wait(True, 60.0)
    ended = threading.Event()

    def asks() -> None:
        with suppress(OSError):
            while not ended.is_set():
                silent.send(9)

    asking, often = threading.Thread(target=asks, daemon=True), sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads change in the middle of everything
    asking.start()
    try:
        for _ in range(3000):
            server.send("x" * 2000)  # a socket takes a few hundred of them: it would wait for ever
    finally:
        ended.set()
        sys.setswitchinterval(often)
    assert server.wait(True, 0.0), "and it was not shut out"


def test_the_end_says_goodbye() -> None:
    with LiveServer(lambda host: "") as server:
        viewer = Viewer(server)
        assert server.wait(True, 60.0)
    assert viewer.next() == (8, struct.pack(">H", 1001))


def test_a_port_that_is_taken(server: LiveServer) -> None:
    with pytest.raises(OutputError):
        LiveServer(lambda host: "", server.port)


def test_a_run_is_sent_as_it_is(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "EVERY", 0.0)
    viewer = Viewer(server)
    one = built()
    result = simulate_watched(one, INPUTS, Sender(server, one, INPUTS, speed=0))
    index = [node.path for node in one.nodes].index("total")
    got = [viewer.message() for _ in range(result.ticks)]
    assert [m["ticks"] for m in got] == list(range(1, result.ticks + 1))
    sums = [m["wires"][f"{index}.0"] for m in got]
    assert [at for at, _ in sums] == [m["t"] for m in got]
    both = np.array([value[0] for _, value in sums])
    before = np.array([10.0, *both[:-1]])
    np.testing.assert_allclose(both + before, result["both"]["value"])
    assert viewer.message()["ended"] is True


def test_how_a_run_ended_is_sent(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a run that is over before a second message was due, the first tick and the last."""
    monkeypatch.setattr(live, "EVERY", 1e9)
    viewer = Viewer(server)
    one = built()
    result = simulate_watched(one, INPUTS, Sender(server, one, INPUTS, speed=0))
    assert [viewer.message()["ticks"] for _ in range(2)] == [1, result.ticks]
    assert viewer.message()["ended"] is True


def test_a_run_keeps_to_the_time(server: LiveServer) -> None:
    start = time.monotonic()
    simulate_watched(built(), INPUTS, Sender(server, built(), INPUTS, speed=0.1))
    assert time.monotonic() - start >= 0.248  # 25 ms of events; 2 ms too early is in time


@pytest.mark.parametrize("engine", ["python", "c"])
def test_a_live_run_is_sent_with_its_events(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is pushed, what blocks make of it, and what became of the events; in C events and outputs."""
    monkeypatch.setattr(live, "EVERY", 0.0)
    one = built()
    place = {node.path: k for k, node in enumerate(one.nodes)}
    with LiveView(one, title="as it comes") as view:
        viewer = Viewer(view.server)
        assert view.wait(True, 60.0)
        with Live(one, engine=engine, watcher=view) as run:
            for time_, name, value in ((5, "a", 3.0), (7, "b", 4.0), (6, "b", 9.0), (10, "a", 1.0)):
                run.push(time_ * MS, **{name: np.float64(value)})
        result = run.result()
        got = [viewer.message() for _ in range(result.ticks)]
        end = viewer.message()
    assert [m["t"] for m in got] == [0.0, 0.002, 0.005]
    assert [m["wires"][f"{place['a']}.0"] for m in got] == [[0.0, [3.0]], [0.0, [3.0]], [0.005, [1.0]]]
    assert [m["wires"].get(f"{place['b']}.0") for m in got] == [None, [0.002, [4.0]], [0.002, [4.0]]]
    wire = next(c.wire for c in one.collected if c.name == "both")
    assert [m["wires"][f"{wire.node}.{wire.output}"][1][0] for m in got] == result["both"]["value"].tolist()
    assert (f"{place['total']}.0" in got[0]["wires"]) is (engine == "python")
    assert (end["ended"], end["ticks"]) == (True, 3)
    assert (end["facts"]["a taken"], end["facts"]["b late"]) == ("2", "1")
    assert end["facts"]["work p50"].endswith(" ms")
    assert set(end["blocks"]) == {call.path for _, call in one.calls}


def test_a_live_run_that_is_watched_is_the_same_to_the_bit() -> None:
    one = built()
    with LiveView(one) as view, Live(one, watcher=view) as run:
        for time_, name, value in ((5, "a", 3.0), (7, "b", 4.0), (10, "a", 1.0)):
            run.push(time_ * MS, **{name: np.float64(value)})
    again, live_result = simulate(one, run.arrived), run.result()
    assert live_result["both"]["value"].tolist() == again["both"]["value"].tolist()
    same_state(live_result.state, again.state)


def test_the_page_may_connect_to_its_server_alone() -> None:
    reader = _Reader(live_page(built(), INPUTS, "a title")("127.0.0.1:4321"))
    policy = next(a["content"] for tag, a in reader.tags if tag == "meta" and "http-equiv" in a)
    assert policy is not None
    assert policy.endswith("connect-src ws://127.0.0.1:4321")
    assert "total" in [node["path"] for node in reader.data("graph")["nodes"] if node]

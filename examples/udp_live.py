"""A filter that flies: packets of an IMU at 1 kHz and of a GNSS receiver at 10 Hz come in over UDP.

A second process sends them over the loopback with jitter, losses and in the wrong order; the filter runs in C
as they come. `python examples/udp_live.py --seconds 600` runs for ten minutes.
"""

from __future__ import annotations

import argparse
import hashlib
import heapq
import math
import random
import socket
import struct
import subprocess
import sys
import time
from contextlib import suppress
from typing import Any

import numpy as np

from flowgraph import Live, Series, aperiodic, find_graph, simulate
from flowgraph.blocks.inertial import ImuNoise, start_belief
from flowgraph.blocks.signals import Imu, Position

PACKET = struct.Struct("<cqIdddddd")  # kind, stamp in ns, number, six numbers
KINDS = {"imu": (1_000_000, 6), "position": (100_000_000, 3)}  # the period in ns, and how many numbers
NOISE = ImuNoise(gyro=1e-3, accelerometer=1e-2, gyro_bias=1e-5, accelerometer_bias=1e-4)
LOSS, JITTER, LATENESS = 0.01, 0.002, "40ms"
RADIUS, RATE, EASE = 8.0, 0.6, 3.0


def body(seconds: float) -> tuple[list[float], list[float]]:
    """What the IMU reads of a body that eases into a circle, rad/s and m/s^2, and where it is, m."""
    rate = RATE * (1.0 - math.exp(-seconds / EASE))
    angle = RATE * (seconds - EASE * (1.0 - math.exp(-seconds / EASE)))
    along = RADIUS * (RATE - rate) / EASE
    position = [RADIUS * math.sin(angle), RADIUS * (1.0 - math.cos(angle)), 0.0]
    return [0.0, 0.0, rate, along, RADIUS * rate**2, 9.81], position


def send(port: int, seconds: float) -> None:
    """Send the packets of a flight, each at its time and a while later, and some not at all."""
    rng, sock = random.Random(1), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    begun, numbers = time.perf_counter(), dict.fromkeys(KINDS, 0)
    waiting: list[tuple[float, bytes]] = []
    for stamp in range(0, round(seconds * 1e9), KINDS["imu"][0]):
        read, position = body(stamp * 1e-9)
        made = {"imu": [x + rng.gauss(0.0, 0.03 if k < 3 else 0.3) for k, x in enumerate(read)]}
        if stamp % KINDS["position"][0] == 0:
            made["position"] = [*(x + rng.gauss(0.0, 0.5) for x in position), 0.0, 0.0, 0.0]
        for kind, values in made.items():
            numbers[kind] += 1
            if rng.random() >= LOSS:
                packet = PACKET.pack(kind[:1].encode(), stamp, numbers[kind], *values)
                delay = min(rng.expovariate(1.0 / JITTER), 10 * JITTER)
                heapq.heappush(waiting, (stamp * 1e-9 + delay, packet))
        while waiting and waiting[0][0] <= stamp * 1e-9:
            due, packet = heapq.heappop(waiting)
            time.sleep(max(0.0, begun + due - time.perf_counter()))
            sock.sendto(packet, ("127.0.0.1", port))
    for _, packet in sorted(waiting):
        sock.sendto(packet, ("127.0.0.1", port))
    sock.connect(("127.0.0.1", port))
    with suppress(ConnectionRefusedError):  # it has heard the last word, which may get lost as well
        while True:
            sock.send(PACKET.pack(b"e", 0, 0, *numbers.values(), *[0.0] * 4))
            time.sleep(0.02)


def receive(sock: socket.socket, live: Live, seconds: float) -> tuple[dict[str, int], dict[str, int]]:
    """Push what comes until the sender says that it is done; how many of each kind came, and were sent."""
    came, until = dict.fromkeys(KINDS, 0), time.monotonic() + seconds + 20.0
    while time.monotonic() < until:
        kind, stamp, _, *values = PACKET.unpack(sock.recv(256))
        if kind == b"e":
            return came, {name: int(n) for name, n in zip(KINDS, values, strict=False)}
        if kind == b"i":
            came["imu"] += 1
            live.push(stamp, imu=Imu(gyro=np.array(values[:3]), specific_force=np.array(values[3:])))
        else:
            came["position"] += 1
            live.push(stamp, position=Position(np.array(values[:3])))
    return came, dict.fromkeys(KINDS, -1)


def digests(graph: Any, arrived: dict[str, Series]) -> dict[str, str]:
    """Of each leaf of the belief, where the recorded events are run: 10 s by 10 s, so that memory is flat."""
    state, step = None, 10_000_000_000
    found: dict[str, Any] = {}
    for first in range(0, int(arrived["imu"].time[-1]) + 1, step):
        part = {n: s[(s.time >= first) & (s.time < first + step)] for n, s in arrived.items()}
        result = simulate(graph, part, engine="c", state=state)
        state = result.state
        for leaf, values in result.belief.leaves.items():
            found.setdefault(leaf, hashlib.sha256()).update(values.tobytes())
    return {leaf: digest.hexdigest() for leaf, digest in found.items()}


def main() -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1.5)
    parser.add_argument("--send", type=int, metavar="PORT", help="be the sender")
    given, _ = parser.parse_known_args()
    if given.send is not None:
        send(given.send, given.seconds)
        return {}
    graph = find_graph("ins_eskf").build(
        imu=aperiodic(), position=aperiodic(), start=start_belief(np.zeros(3), np.array([1.0, 0, 0, 0])),
        noise=NOISE, position_noise=0.5,
    )  # fmt: skip
    live_digests: dict[str, Any] = {}
    off = []

    def seen(name: str, stamp: int, belief: Any) -> None:
        if name == "belief":
            for leaf in ("position", "velocity", "attitude", "gyro_bias", "accelerometer_bias", "covariance"):
                live_digests.setdefault(leaf, hashlib.sha256()).update(getattr(belief, leaf).tobytes())
            if stamp % 100_000_000 == 0:
                off.append(float(np.linalg.norm(belief.position - body(stamp * 1e-9)[1])))

    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**22)
    sock.bind(("127.0.0.1", 0))
    sock.settimeout(20.0)
    live = Live(
        graph, engine="c", lateness=LATENESS, deadline="1ms", record="arrived", on_output=seen, thread=False
    )
    words = [sys.executable, __file__, "--send", str(sock.getsockname()[1]), "--seconds", str(given.seconds)]
    sender = subprocess.Popen(words)
    try:
        came, sent = receive(sock, live, given.seconds)
    finally:
        sock.close()
        sender.wait(timeout=20.0)
    result, arrived = live.close(), live.arrived
    for name, n in sent.items():
        made_none = ("late", "twice", "dropped", "unclocked", "absent")
        known = sum(live.counts[f"{name}.{kind}"] for kind in made_none)
        print(f"{name}: {n} made, {n - came[name]} lost on the way, {came[name]} came,")
        print(f"  {known} of them counted out, {len(arrived[name])} in ticks")
        assert came[name] == known + len(arrived[name]) + live.counts[f"{name}.refused"]
    same = {n: d.hexdigest() for n, d in live_digests.items()} == digests(graph, arrived)
    took = live.latencies
    share = 100.0 * (1.0 - took.deadline_missed / result.ticks)
    most, longest = 1e3 * took.response["p99.9"], 1e3 * took.response["max"]
    print(f"{result.ticks} ticks, {1e6 * took.work['p50']:.0f} us each, {share:.2f} % within 1 ms")
    print(f"  of being complete; 99.9 % within {most:.2f} ms, the longest {longest:.1f} ms")
    print(f"position: {np.sqrt(np.mean(np.square(off[len(off) // 2 :]))):.2f} m RMS, receiver 0.87 m")
    print(f"the recorded run of what arrived: {'the same to the bit' if same else 'DIFFERENT'}")
    return {"same": same, "live": live, "result": result, "came": came, "sent": sent, "share": share}


if __name__ == "__main__":
    FOUND = main()

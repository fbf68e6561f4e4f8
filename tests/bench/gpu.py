"""The XLA engine on each device that JAX finds: `rbpf_indoor` in float32 over numbers of particles.

`python -m tests.bench.gpu --particles 1000 10000 --json` prints a row for each device and number: time a
tick, particles a second, and the least memory traffic, all registers read and written once a tick, over the
time that it took and over the bandwidth of the device, which a pass over 256 MB measures. Where there are
several devices of a kind two more rows have the particles shared out among them, and a run on each. Where
there is no GPU the rows are those of the processor.

Agreement is measured beside it, not assumed: for the smallest number of particles, how far the pose is from
that of the float64 reference interpreter. In float32 a particle filter may resample at another tick; that is
counted.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph import Batch, Case, find_graph, load_flight, lower, simulate, simulate_many

CPU_MOST = 100_000
"""Particles of a processor where there is a GPU as well."""


def case(particles: int, seconds: float) -> Case:
    """The filter on the simulated flight."""
    flight = load_flight("sim", seed=1, settings={"duration": f"{seconds:g}"})
    return find_graph("rbpf_indoor").case(flight, particles=particles)


def played(made: Case, keep: Sequence[str], shard: Mapping[str, int] | None = None) -> Batch:
    """A run, or one for each device that shares them, with only what is kept of its outputs brought back."""
    runs = (shard or {}).get("runs", 1)
    return simulate_many(
        made.graph, made.inputs, range(runs), engine="xla", dtype="float32", keep=keep, runs_at_once=runs,
        shard=shard,
    )  # fmt: skip


def row(
    made: Case, device: Any, particles: int, repeats: int, bandwidth: float, shard: Mapping[str, int]
) -> dict[str, Any]:
    """One kind of device and number of particles: the best of some calls after one that compiles.

    Args:
        bandwidth: of one device, bytes a second.
        shard: how many devices share runs or particles.
    """
    import jax  # the extra `xla`

    with jax.default_device(device):
        calls = [played(made, ["pose"], shard) for _ in range(repeats + 1)]
    wall, ticks = min(call.wall_s for call in calls[1:]), calls[0].ticks
    devices, runs = math.prod(shard.values()), shard.get("runs", 1)
    moved = _bytes_per_tick(made)
    rate = moved * runs * ticks / wall
    return {
        "graph": "rbpf_indoor", "device": device.platform, "kind": device.device_kind, "dtype": "float32",
        "devices": devices, "shared": ", ".join(shard) or None, "particles": particles, "runs": runs,
        "ticks": ticks, "us_per_tick": 1e6 * wall / ticks,
        "particles_per_s": runs * particles * ticks / wall, "register_bytes_per_tick": moved,
        "gb_per_s": rate / 1e9, "bandwidth_gb_per_s": devices * bandwidth / 1e9,
        "of_bandwidth": rate / (devices * bandwidth),
    }  # fmt: skip


def bandwidth_of(device: Any) -> float:
    """Bytes that a device reads and writes a second, the best of ten passes over 256 MB in place."""
    import jax  # the extra `xla`

    array = jax.device_put(np.zeros(2**26, np.float32), device)
    count = jax.jit(lambda x: x + np.float32(1.0), donate_argnums=0)
    seconds = []
    for _ in range(11):  # the first compiles
        start = perf_counter()
        array = count(array).block_until_ready()
        seconds.append(perf_counter() - start)
    return float(2 * array.nbytes / min(seconds))


def shares(devices: int, particles: int) -> list[dict[str, int]]:
    """How the work can be shared out: not at all, by particles where these divide, by runs."""
    parted = [{"particles": devices}] if particles % devices == 0 else []
    return [{}, *parted, {"runs": devices}] if devices > 1 else [{}]


def _bytes_per_tick(made: Case) -> int:
    """Registers read and written once a tick, as float32: the floor of the traffic."""
    return sum(2 * 4 * int(np.prod(c.shape)) for r in lower(made.graph).registers for c in r.cells)


def agreement(made: Case, device: Any) -> dict[str, Any]:
    """How far a device's float32 run is from the float64 definition."""
    import jax  # the extra `xla`

    exact = simulate(made.graph, made.inputs, engine="reference")
    with jax.default_device(device):
        found = played(made, ["pose", "ancestors.resampled"])
    apart = found["pose"].position[0] - exact["pose"]["position"]
    other = found["ancestors"].resampled[0] != exact["ancestors"]["resampled"]
    return {
        "position_difference_rms_m": float(np.sqrt((apart**2).sum(-1).mean())),
        "decisions_differing": int(other.sum()), "decisions": int(other.size),
    }  # fmt: skip


def _said(name: str, value: Any) -> str:
    return f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}"


def main(arguments: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Print the rows."""
    import jax  # the extra `xla`

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--particles", type=int, nargs="+", default=[1_000, 10_000])
    parser.add_argument("--seconds", type=float, default=1.0, help="of flight")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args(arguments)
    devices = {d.platform: d for d in reversed((*jax.devices("cpu"), *jax.devices()))}
    bandwidths = {platform: bandwidth_of(device) for platform, device in devices.items()}
    rows: list[dict[str, Any]] = []
    for particles in asked.particles:
        made = case(particles, asked.seconds)
        for platform, device in devices.items():
            if platform == "cpu" and len(devices) > 1 and particles > CPU_MOST:
                continue
            for shard in shares(len(jax.devices(platform)), particles):
                found = row(made, device, particles, asked.repeats, bandwidths[platform], shard)
                if particles == min(asked.particles) and not shard:
                    found |= agreement(made, device)
                rows.append(found)
                if not asked.json:
                    print(", ".join(_said(*item) for item in found.items()), flush=True)
    if asked.json:
        print(json.dumps({"rows": rows}))
    return rows


if __name__ == "__main__":
    main()

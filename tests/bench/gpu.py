"""The XLA engine on each device that JAX finds: `rbpf_indoor` in float32 over numbers of particles.

`python -m tests.bench.gpu --particles 1000 10000 --json` prints a row for each device and number: time a
tick, particles a second, and the least memory traffic, all registers read and written once a tick, over the
time that it took. Where there is no GPU the rows are those of the processor.

Agreement is measured beside it, not assumed: for the smallest number of particles, how far the pose is from
that of the float64 reference interpreter. In float32 a particle filter may resample at another tick; that is
counted.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from flowgraph import Batch, Case, find_graph, load_flight, lower, simulate, simulate_many

CPU_MOST = 100_000


def case(particles: int, seconds: float) -> Case:
    """The filter on the simulated flight."""
    flight = load_flight("sim", seed=1, settings={"duration": f"{seconds:g}"})
    return find_graph("rbpf_indoor").case(flight, particles=particles)


def played(made: Case, keep: Sequence[str]) -> Batch:
    """One run, with only what is kept of its outputs brought back."""
    return simulate_many(
        made.graph, made.inputs, [0], engine="xla", dtype="float32", keep=keep, runs_at_once=1
    )


def row(made: Case, device: Any, particles: int, repeats: int) -> dict[str, Any]:
    """One device and number of particles: the best of some runs after one that compiles."""
    import jax  # the extra `xla`

    with jax.default_device(device):
        runs = [played(made, ["pose"]) for _ in range(repeats + 1)]
    wall, ticks = min(run.wall_s for run in runs[1:]), runs[0].ticks
    moved = _bytes_per_tick(made)
    return {
        "graph": "rbpf_indoor", "device": device.platform, "kind": device.device_kind, "dtype": "float32",
        "particles": particles, "ticks": ticks, "us_per_tick": 1e6 * wall / ticks,
        "particles_per_s": particles * ticks / wall, "register_bytes_per_tick": moved,
        "gb_per_s": moved * ticks / wall / 1e9,
    }  # fmt: skip


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


def main(arguments: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Print the rows."""
    import jax  # the extra `xla`

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--particles", type=int, nargs="+", default=[1_000, 10_000])
    parser.add_argument("--seconds", type=float, default=1.0, help="of flight")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args(arguments)
    devices = {d.platform: d for d in (*jax.devices("cpu"), *jax.devices())}
    rows = []
    for particles in asked.particles:
        made = case(particles, asked.seconds)
        for platform, device in devices.items():
            if platform == "cpu" and particles > CPU_MOST:
                continue
            found = row(made, device, particles, asked.repeats)
            if particles == min(asked.particles):
                found |= agreement(made, device)
            rows.append(found)
            if not asked.json:
                print(
                    ", ".join(
                        f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in found.items()
                    )
                )
    if asked.json:
        print(json.dumps({"rows": rows}))
    return rows


if __name__ == "__main__":
    main()

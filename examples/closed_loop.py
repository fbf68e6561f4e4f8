"""A quadrotor that is flown on its filter's own estimate, with and without a late motion capture.

    python examples/closed_loop.py loop.png

Plant, sensors, filter, controller and score are one graph: the estimate steers the vehicle, whose motion the
sensors read, of which the estimate is made. The loop closes through the plant, whose state of a tick does not
hang on what it is told in that tick. `seeds` choose the noise, and every engine flies the same flight.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import (
    Array,
    Result,
    Scalar,
    Series,
    Stream,
    Tick,
    block,
    graph,
    periodic,
    simulate,
    ticks,
    when,
)
from flowgraph.blocks.control import fly_to, late, quadrotor, quadrotor_motion
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.metrics import pose_score, running_rms
from flowgraph.blocks.models.pose import start_pose
from flowgraph.blocks.sensors import read_imu, read_pose, true_state
from flowgraph.blocks.signals import BodyMotion
from flowgraph.graphs.ekf import ekf

CORNERS = np.array([[0.0, 0.0, 1.0], [1.5, 0.0, 1.0], [1.5, 1.5, 1.5], [0.0, 1.5, 1.0]])
EACH = 3_000_000_000
"""How long each corner is the target, ns."""

PERIOD = 5_000_000
"""Of the inertial unit, which is that of control too, ns; each tenth reading there is a pose."""

NOISE = ImuNoise(gyro=2e-3, accelerometer=2e-2, gyro_bias=0.0, accelerometer_bias=0.0)
POSE: dict[str, Any] = {"position_noise": 0.02, "attitude_noise": 0.02}
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
HOVER = BodyMotion(
    position=np.zeros(3), velocity=np.zeros(3), acceleration=np.zeros(3), attitude=LEVEL, rate=np.zeros(3)
)


@block
def corner(motion: BodyMotion, *, t: Any, xp: Any) -> Array:
    """Where to fly now."""
    corners = xp.asarray(CORNERS, dtype=motion.position.dtype)
    return xp.take(corners, (t // EACH) % len(CORNERS), axis=0)


@block
def away(motion: BodyMotion, target: Array, *, t: Any, xp: Any) -> Scalar | None:
    """How far the vehicle is from its corner, m, once it has had 2 s to come there."""
    off = motion.position - target
    return when(t % EACH >= 2_000_000_000, xp.sqrt(xp.linalg.vecdot(off, off)))  # type: ignore[return-value]


@graph
def loop(imu: Stream[Tick], end: Stream[Tick], *, latency: int, own: bool):
    """A quadrotor that is sent round four corners.

    latency: by how many readings of the inertial unit a pose is late; the filter takes it for fresh. own:
    whether the vehicle is flown on the estimate, or on the truth.
    """
    body = quadrotor(at=imu)
    motion = quadrotor_motion(body.output)
    per_reading = (1e9 / PERIOD) ** 0.5
    reading = read_imu(motion, gyro=NOISE.gyro * per_reading, accelerometer=NOISE.accelerometer * per_reading)
    seen = late(motion, latency, HOVER, name="seen")
    pose = read_pose(seen.every(10), **POSE)
    belief = ekf(reading, pose, start=start_pose(np.zeros(3), LEVEL), noise=NOISE, **POSE)["belief"]
    target = corner(motion)
    body.feed(fly_to(belief if own else motion, target))
    return {
        "motion": motion,
        "target": target,
        "away": running_rms(away(motion, target)),
        "score": pose_score(belief, true_state(motion), end=end),
    }


def flown(
    *, latency: int = 0, own: bool = True, seconds: float = 12.0, engine: str = "python", seed: int = 0
) -> Result:
    """A run of the loop; latency in readings of 5 ms."""
    last = round(seconds * 1e9)
    given = {
        "imu": ticks(PERIOD, until=last + 1),
        "end": Series(np.array([last]), np.ones(1, dtype=bool), name="end"),
    }
    built = loop.build(imu=periodic(PERIOD, phase=0), latency=latency, own=own)
    return simulate(built, given, engine=engine, seed=seed)


KINDS: dict[str, dict[str, Any]] = {
    "flown on the truth": {"own": False},
    "flown on the estimate": {},
    "on the estimate, poses 60 ms late": {"latency": 12},
    "on the estimate, poses 200 ms late": {"latency": 40},
}


def main(file: str | None = None, *, engine: str = "c") -> dict[str, Any]:
    """Fly each kind, print how it went, and draw the paths."""
    runs = {name: flown(engine=engine, **kind) for name, kind in KINDS.items()}
    for name, run in runs.items():
        print(
            f"{name}: {run['away'].value[-1]:.3f} m from its corner, the estimate wrong by "
            f"{run['score']['position_rmse_m'][0]:.3f} m and {run['score']['attitude_rmse_deg'][0]:.2f} deg"
        )
    if file is not None:
        draw(runs, Path(file))
    return runs


def draw(runs: dict[str, Any], file: Path) -> None:
    """The paths from above, and how far each is from its corner."""
    from matplotlib.figure import Figure  # slow to import, and only this needs it

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    above, apart = figure.subplots(1, 2)
    for name, run in runs.items():
        p, target = run["motion"]["position"], run["target"].value
        above.plot(p[:, 0], p[:, 1], label=name)
        apart.plot(run["motion"].time * 1e-9, np.linalg.norm(p - target, axis=1))
    above.plot(*CORNERS[:, :2].T, "k+", markersize=12)
    above.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    apart.set(xlabel="s", ylabel="m from the corner")
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    figure.savefig(file)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 and sys.argv[1].endswith(".png") else None)

"""An extended filter of derived Jacobians in generated C beside the one by hand: time, and operations.

Ten numbers of pose, an IMU as control, a motion capture as measurement. The derived one has the motion and
the observation of the unscented filter and six noises that go through the motion (`tests/graphs/derived.py`);
the one by hand is `ekf`, with the same outputs.
"""

from __future__ import annotations

from typing import Any

from flowgraph import load_flight, simulate
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.models.pose import start_pose
from flowgraph.blocks.models.unscented_pose import start_state
from flowgraph.graphs import ekf
from tests.bench.generated_c import loop
from tests.bench.rows import Row, interleaved
from tests.graphs.derived import derived_ekf, ekf_by_hand, operations

NOISE = ImuNoise(gyro=0.01, accelerometer=0.1, gyro_bias=0.0, accelerometer_bias=0.0)


def rows(*, duration: float = 60.0, repeats: int = 15) -> list[Row]:
    """Microseconds a tick, and operations of a tick with a pose."""
    case = ekf.case(load_flight("sim", seed=0, settings={"duration": f"{duration:g}"}))
    inputs: Any = case.inputs
    first = inputs["vicon"][0]
    settings: Any = {"noise": NOISE, "position_noise": 0.01, "attitude_noise": 0.02}
    derived = derived_ekf.build(start=start_state(first.position, first.attitude), **settings)
    by_hand = ekf_by_hand.build(start=start_pose(first.position, first.attitude), **settings)
    found = simulate(derived, inputs, engine="c")
    scale = 1e6 / found.ticks
    a, b = loop(derived, inputs), loop(by_hand, inputs)
    mine, peer, ratio = interleaved(lambda: a() * scale, lambda: b() * scale, repeats)
    counts = operations(derived), operations(by_hand)
    share = counts[0] / counts[1]
    name, bound = "EKF of the pose, derived", "ratio <= 1.2"
    return [
        Row(f"{name}, C", mine, peer, "us/tick", "by hand", ratio, bound, ratio <= 1.2),
        Row(
            f"{name}, work",
            float(counts[0]),
            float(counts[1]),
            "operations",
            "by hand",
            share,
            bound,
            share <= 1.2,
        ),
    ]

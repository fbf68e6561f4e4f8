"""A small filter in a graph of its own, for the tests that draw."""

from __future__ import annotations

import numpy as np

from flowgraph import Array, Signal, Stream, block, delay, graph, latest, real


class Imu(Signal):
    gyro: Array = real(3, unit="rad/s", frame="body")


class Fix(Signal):
    position: Array = real(3, unit="m", frame="world")


class Belief(Signal):
    position: Array = real(3, unit="m", frame="world")


ARM = 1.0
"""Metres a radian."""


@block
def predict(belief: Belief, control: Imu, *, dt) -> Belief:
    """Carry the belief to now."""
    return Belief(belief.position + ARM * dt * control.gyro)


@block
def aid(prior: Belief, measured: Fix | None = None) -> tuple[Belief, Array | None]:
    """Use a fix, where there is one."""
    if measured is None:
        return prior, None
    gap = measured.position - prior.position
    return Belief(prior.position + 0.5 * gap), gap


@graph
def core(imu: Stream[Imu], fix: Stream[Fix]):
    belief = delay(Belief(np.zeros(3)), name="belief")
    control = latest(imu, init=Imu(np.ones(3)), name="control")
    posterior, innovation = aid(predict(belief, control, at=imu | fix), fix)
    belief.feed(posterior)
    return posterior, innovation

"""Motion primitives: the way from one state to a key point in a given time that needs the least jerk.

Each axis by itself: the integral of the squared jerk is least for a position that is a polynomial of fifth
degree, with jerk g + b t + a t^2 / 2. Its three numbers follow in closed form from what the key point gives;
a component that is free ends where its costate is zero.

Source: M. Mueller, M. Hehn, R. D'Andrea, "A computationally efficient motion primitive for quadrocopter
trajectory generation", IEEE Trans. Robotics 31(6), 2015: sec. III and appendix A (the seven end states).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.errors import DeclarationError

__all__ = ["KeyPoint", "Primitives", "join", "primitive"]

Vector = tuple[float, float, float]

# (a T^5, b T^4, g T^3) for (dp, T dv, T^2 da), by which of position, velocity and acceleration are given.
_CASES = {
    (True, True, True): ((720, -360, 60), (-360, 168, -24), (60, -24, 3)),
    (True, True, False): ((320, -120, 0), (-200, 72, 0), (40, -12, 0)),
    (True, False, True): ((45, 0, -7.5), (-45, 0, 7.5), (15, 0, -1.5)),
    (False, True, True): ((0, 0, 0), (0, -12, 6), (0, 6, -2)),
    (True, False, False): ((20, 0, 0), (-20, 0, 0), (10, 0, 0)),
    (False, True, False): ((0, 0, 0), (0, -3, 0), (0, 3, 0)),
    (False, False, True): ((0, 0, 0), (0, 0, 0), (0, 0, 1)),
}


@dataclass(frozen=True)
class KeyPoint:
    """Where a primitive ends, after `seconds`; None leaves a component free, and one at least is given.

    Args:
        seconds: s, from the key point before.
        position, velocity, acceleration: three numbers each in m, m/s, m/s^2, world; or None.

    Raises:
        DeclarationError: when nothing is given, or the time is not positive.
    """

    seconds: float
    position: Vector | None = None
    velocity: Vector | None = None
    acceleration: Vector | None = None

    def __post_init__(self) -> None:
        if not self.seconds > 0.0 or self._given not in _CASES:
            raise DeclarationError(
                "this key point fixes no way",
                path="KeyPoint",
                expected="seconds > 0, and one or more of position, velocity and acceleration",
                got=repr(self),
                fix="for example KeyPoint(1.0, position=(0.0, 0.0, 1.0))",
            )

    @property
    def _given(self) -> tuple[bool, bool, bool]:
        return (self.position is not None, self.velocity is not None, self.acceleration is not None)


@dataclass(frozen=True, eq=False)
class Primitives:
    """Primitives one after the other; position, velocity and acceleration do not jump between them.

    Args:
        start: (n,) s, when each begins.
        seconds: (n,) s, how long each takes.
        coefficients: (n, 6, 3) of the position, lowest power first: sum_k c_k (t - start)^k, m and s, world.
    """

    start: np.ndarray
    seconds: np.ndarray
    coefficients: np.ndarray

    @property
    def duration(self) -> float:
        """s, of all of them."""
        return float(self.start[-1] + self.seconds[-1])

    def at(self, t: Array, *, xp: Any = np) -> tuple[Array, Array, Array, Array]:
        """Position, velocity, acceleration and jerk (..., 3) at times (...) in s."""
        begins = xp.asarray(self.start, dtype=t.dtype)
        which = xp.clip(xp.searchsorted(begins, t, side="right") - 1, 0, len(self.start) - 1)
        return self.within(which, t - xp.take(begins, which, axis=0), xp=xp)

    def within(self, which: Array, s: Array, *, xp: Any = np) -> tuple[Array, Array, Array, Array]:
        """The same, at `s` (...) seconds into the primitives `which` (...)."""
        rows = xp.take(xp.asarray(self.coefficients, dtype=s.dtype), which, axis=0)
        derivative = [rows[..., k, :] for k in range(6)]
        found = []
        for _ in range(4):
            found.append(_horner(derivative, s[..., None]))
            derivative = [float(k) * derivative[k] for k in range(1, len(derivative))]
        return found[0], found[1], found[2], found[3]

    @property
    def cost(self) -> float:
        """m^2/s^5: the integral of the squared jerk (the paper divides it by the time)."""
        j = self.coefficients[:, 3:] * np.array([6.0, 24.0, 60.0])[:, None]
        powers = np.arange(3)[:, None] + np.arange(3) + 1
        weights = self.seconds[:, None, None] ** powers / powers
        return float(np.einsum("nki,nkl,nli->", j, weights, j))


def _horner(coefficients: Any, s: Array) -> Array:
    value = coefficients[-1]
    for c in coefficients[-2::-1]:
        value = value * s + c
    return value


def join(
    key_points: Iterable[KeyPoint],
    *,
    position: Vector = (0.0, 0.0, 0.0),
    velocity: Vector = (0.0, 0.0, 0.0),
    acceleration: Vector = (0.0, 0.0, 0.0),
) -> Primitives:
    """The primitives from a start (m, m/s, m/s^2, world) to each key point in turn.

    Each is optimal from the state in which the one before ends, whatever was left free there.
    """
    state = np.array([position, velocity, acceleration], dtype=float)
    seconds, rows = [], []
    for point in key_points:
        none = (np.nan,) * 3
        goal = np.array(
            [none if g is None else g for g in (point.position, point.velocity, point.acceleration)]
        )
        row, state = primitive(state, goal, point._given, point.seconds)
        seconds.append(point.seconds)
        rows.append(row)
    if not rows:
        raise DeclarationError(
            "there is no key point",
            path="join",
            expected="one or more",
            got="none",
            fix="join([KeyPoint(1.0, position=(0.0, 0.0, 1.0))])",
        )
    made = np.array(seconds), np.array(rows)
    start = np.concatenate([[0.0], np.cumsum(made[0])[:-1]])
    for array in (start, *made):
        array.flags.writeable = False
    return Primitives(start, *made)


def primitive(
    state: np.ndarray, goal: np.ndarray, given: tuple[bool, bool, bool], seconds: float
) -> tuple[np.ndarray, np.ndarray]:
    """The coefficients (..., 6, 3) of one primitive, and the state (..., 3, 3) in which it ends.

    Args:
        state: (..., 3, 3) position, velocity and acceleration at its start, world; m, m/s, m/s^2.
        goal: (..., 3, 3) those of the key point; what is not given is not looked at.
        given: which of the three are.
        seconds: s.
    """
    T = seconds
    p, v, a = np.moveaxis(state, -2, 0)
    coasting = np.stack([p + v * T + 0.5 * a * T**2, v + a * T, a], axis=-2)
    wanted = np.where(np.array(given)[:, None], goal, coasting)
    change = (wanted - coasting) * np.array([[1.0], [T], [T**2]])
    alpha, beta, gamma = np.moveaxis(np.array(_CASES[given]) @ change / T ** np.array([[5], [4], [3]]), -2, 0)
    row = np.stack([p, v, a / 2.0, gamma / 6.0, beta / 24.0, alpha / 120.0], axis=-2)
    place = np.moveaxis(row, -2, 0)
    speed = place[1:] * np.arange(1, 6).reshape(5, *[1] * (place.ndim - 1))
    end = (
        np.asarray(_horner(place, np.array(T))),
        np.asarray(_horner(speed, np.array(T))),
        a + gamma * T + beta * T**2 / 2.0 + alpha * T**3 / 6.0,
    )
    return row, np.stack(end, axis=-2)

"""A plant whose differential equation is solved to a tolerance, on the host, as stiff or sudden motion needs.

The steps follow the motion, so their number is not known beforehand and no fixed-size pipeline can hold them:
a plant of this kind runs in Python whatever the engine, and what does not lie in a loop with it where it is
told to. A loop that closes through it takes `engine="python"`.

Source: J. Dormand, P. Prince, "A family of embedded Runge-Kutta formulae", J. Comput. Appl. Math. 6(1), 1980;
as `scipy.integrate.solve_ivp` has it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy  # its parts are loaded when they are used

from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.geometry.views import joined
from flowgraph.blocks.statespace.functions import Handed
from flowgraph.errors import DeclarationError, RunError

__all__ = ["DormandPrince"]


@dataclass(frozen=True, eq=False)
class DormandPrince:
    """A motion by a differential equation, for `plant`, each step as short as the tolerance asks for.

    Args:
        space: of the state, made of vectors and angles.
        rates: `rates(x, u, t, xp)`, the derivative of each part by time, per s; t, the time in s, and u may
            be left out.
        relative, absolute: tolerances of a step, above 0.

    Raises:
        DeclarationError: where `rates` has other parameters, a tolerance is none, or the space has attitudes:
            those keep their length by `runge_kutta`.
    """

    space: StateSpace
    rates: Callable[..., Any]
    relative: float = 1e-9
    absolute: float = 1e-12
    _rates: Handed = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.space.size != self.space.tangent:
            raise DeclarationError(
                "this solver adds what changes, and an attitude is not added to",
                path="DormandPrince.space",
                expected="a space of vectors and angles",
                got=f"{self.space.size} numbers with {self.space.tangent} directions",
                fix="use runge_kutta",
            )
        if not (0.0 < self.relative < np.inf and 0.0 < self.absolute < np.inf):
            raise DeclarationError(
                "no step is this good",
                path="DormandPrince",
                expected="relative and absolute: numbers above 0",
                got=f"relative={self.relative!r}, absolute={self.absolute!r}",
                fix="leave them out, or write relative=1e-6",
            )
        object.__setattr__(self, "_rates", Handed(self.rates, "DormandPrince.rates", ("t", "xp"), "control"))

    def after(self, x: np.ndarray, control: Any, seconds: float, *, begin: float = 0.0) -> np.ndarray:
        """The state (size) that x has become so many seconds after `begin` (s) under one control.

        Raises:
            RunError: where no step is short enough.
        """
        if seconds <= 0.0:
            return np.array(x)

        def slope(since: float, now: np.ndarray) -> np.ndarray:
            made = self._rates(self.space.view(now, np), control, t=begin + since, xp=np)
            return np.asarray(joined(self.space, made, now, np, tangent=True))

        found = scipy.integrate.solve_ivp(
            slope, (0.0, seconds), np.asarray(x, dtype=float), method="RK45", t_eval=(seconds,),
            rtol=self.relative, atol=self.absolute,
        )  # fmt: skip
        if not found.success:
            raise RunError(
                "a plant's equation could not be solved",
                path="DormandPrince",
                expected=f"a solution over {seconds:g} s to {self.relative:g}",
                got=str(found.message),
                fix="look at the rates near this state, allow a larger error, or fire more often",
            )
        return np.asarray(found.y[:, -1])

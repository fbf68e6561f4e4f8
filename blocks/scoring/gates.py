"""How far a filter trusts a measurement: gates, losses that weigh outliers down, noise it learns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from flowgraph.blocks.kalman.lost import PATIENCE
from flowgraph.blocks.kalman.robust import ROBUST
from flowgraph.blocks.scoring.settings import Positive, Settings, above_one, count, one_of

__all__ = ["Adapted", "Gated", "Weighed"]


@dataclass(frozen=True)
class Gated(Settings):
    """Which measurements are believed.

    Args:
        gate: below 1 the probability with which an honest measurement passes, from 1 on the largest NIS.
        patience: how many refusals in a row are taken for outliers; then the gate opens again (`find_back`).
    """

    gate: Positive | None = None
    patience: Annotated[int, count(1, 1_000_000)] = PATIENCE

    def gating(self) -> dict[str, Any]:
        """What is a setting of the graph itself, by name."""
        return {"gate": self.gate, "patience": self.patience}


@dataclass(frozen=True)
class Weighed(Gated):
    """How far a measurement is believed that is far off.

    Args:
        robust: none, and it counts as its noise is told; huber or student_t, and for less, by its distance
            from what is left after the correction (`robust`).
    """

    robust: Annotated[str, one_of(*ROBUST)] = "none"

    def gating(self) -> dict[str, Any]:
        """What is a setting of the graph itself, by name."""
        return {**super().gating(), "robust": ROBUST[self.robust]()}


@dataclass(frozen=True)
class Adapted(Weighed):
    """How large the noise of a measurement is.

    Args:
        adaptive: over about how many measurements the size of each sensor's noise is learned; it is as told
            if left out (`learned_scale`).
    """

    adaptive: Annotated[float | None, above_one] = None

    def gating(self) -> dict[str, Any]:
        """What is a setting of the graph itself, by name."""
        return {**super().gating(), "adaptive": self.adaptive}

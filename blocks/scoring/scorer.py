"""What a run is worth, in one table: errors against the truth, consistency, and what a smoother makes of it.

Every graph scores its runs with a `Scorer`, so all print the same names: those of `metrics` and `consistency`
for the estimate; for each stream of innovations those of `nis_summary`, with the name of the stream in front
where there are several; and the errors of the smoothed run behind `smoothed_` and `lagged_` where that was
asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from flowgraph import Graph, Result, Series, Stream
from flowgraph.blocks.filtering.batch import Loss, Recording
from flowgraph.blocks.kalman.smoothing import Smoothing
from flowgraph.blocks.metrics.chi_square import chi_square_band
from flowgraph.blocks.metrics.consistency import nis_remarks, nis_summary
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.metrics.running import nis_score, pose_score
from flowgraph.blocks.metrics.truth import truth_remarks
from flowgraph.blocks.particles.lost import depletion_remarks
from flowgraph.data.consistency import measured
from flowgraph.drawing.states import Quantity, seconds_of
from flowgraph.types import ArrayType, leaves_of

__all__ = ["SMOOTHED", "Scorer"]

Errors = Callable[..., dict[str, float]]

SMOOTHED = (
    "position_rmse_m",
    "position_max_m",
    "velocity_rmse_mps",
    "attitude_rmse_deg",
    "tilt_rmse_deg",
    "heading_rmse_deg",
    "inclination_rmse_deg",
    "total_rmse_deg",
    "nees_mean",
    "nees_inside",
)
"""The errors of a smoothed run that are worth a line."""


@dataclass(frozen=True)
class Scorer:
    """The `score` of a `Case`, which says what streams it reads, so that a run of many need not keep others,
    and has `remarks` on a result: what was not compared, what a gate refused in a row, and where a cloud was
    depleted.

    Args:
        truth: with which the estimate is compared; without one there are innovations only.
        errors: such as `pose_errors`, `point_errors` or `attitude_errors`.
        estimate: the stream that is compared.
        settle: seconds at the start that the errors leave out.
        innovations: whether those that a run collects are summed up too; where not, the filter expects larger
            ones than honest ones, and those may be alike.
        steps: what a smoother needs of a result.
        smooth: "rts" smooths the whole run, "batch" takes the most likely trajectory of the recording, "none"
            does neither.
        lag: s: with one, each tick is smoothed with what came until so much later.
        recording: what the filter was given, for a batch.
        loss: of a batch.
    """

    truth: Series | None
    errors: Errors
    estimate: str = "belief"
    settle: float = 1.0
    innovations: bool = True
    steps: Callable[[Result], Smoothing] | None = None
    smooth: str = "none"
    lag: float | None = None
    recording: Recording | None = None
    loss: Loss | None = None

    @property
    def smoothing(self) -> bool:
        """Whether the smoothed runs are compared too."""
        asked = self.smooth != "none" or self.lag is not None
        return asked and self.steps is not None and self.truth is not None

    def reads(self, graph: Graph) -> list[str]:
        """The collected streams of a graph that the score looks at."""
        types = {c.name: graph.port(c.wire).type for c in graph.collected}
        if self.smoothing:
            return list(types)
        return [n for n, t in types.items() if n == self.estimate or self._sums_up(dict(leaves_of(t)))]

    def __call__(self, result: Result) -> dict[str, float]:
        found = self._compared(result[self.estimate])
        innovations = {n: s for n, s in result.series.items() if self._sums_up(s.leaves) and len(s)}
        for name, series in innovations.items():
            front = name.removesuffix("innovation")
            found.update({front + key: value for key, value in nis_summary(series).items()})
        smoothed: dict[str, Any] = {}
        if self.smoothing and self.steps is not None:
            steps = self.steps(result)
            if self.smooth != "none":
                smoothed["smoothed"] = steps.smoothed()
            if self.smooth == "batch" and self.recording is not None:
                smoothed["smoothed"] = self.recording(smoothed["smoothed"], self.loss)
            if self.lag is not None:
                smoothed["lagged"] = steps.lagged(self.lag)
            for front, series in smoothed.items():
                better = self._compared(steps.named(series))
                telling = getattr(self.errors, "telling", SMOOTHED.__contains__)
                found.update({f"{front}_{key}": value for key, value in better.items() if telling(key)})
        return found

    def in_graph(self, streams: Mapping[str, Stream[Any]], truth: Stream[Any], end: Stream[Any]) -> Any:
        """This score as blocks of the graph under construction, in which the truth is a stream.

        Returns:
            The streams of its figures, at `end`, and what makes the figures of a result with those streams;
            None where there are no blocks for it, as for one that smooths.
        """
        estimate = streams.get(self.estimate)
        if estimate is None or self.errors is not pose_errors or self.smoothing:
            return None
        leaves = dict(leaves_of(estimate.type))
        if not {"position", "velocity", "attitude"} <= set(leaves) or not _whole(leaves.get("covariance")):
            return None
        settle, name = round(self.settle * 1e9), f"{self.estimate}_score"
        made: dict[str, Any] = {self.estimate: pose_score(estimate, truth, end=end, settle=settle, name=name)}
        for name, stream in streams.items():
            if self._sums_up(dict(leaves_of(stream.type))):
                made[name] = nis_score(stream, end=end, name=f"{name}_score")
        return made, Figures(self.estimate)

    def remarks(self, result: Result) -> tuple[str, ...]:
        """Notes on a run that the figures do not tell."""
        found: list[str] = []
        if self.truth is not None and self.estimate in result.series:
            found += truth_remarks(result[self.estimate], self.truth, self.settle)
        for name, series in result.series.items():
            if "nis" in series.leaves:
                what = measured(name)
                found += nis_remarks(what, series, loose=not self.innovations)
            if "depleted" in series.leaves:
                found += depletion_remarks(name.removesuffix("depleted").rstrip("_"), series)
        return tuple(found)

    def pictured(self, result: Result) -> list[Quantity]:
        """The numbers of the estimate, as pictures show them; none where the errors know no state."""
        quantities = getattr(self.errors, "quantities", None)
        estimate = result.series.get(self.estimate)
        if quantities is None or estimate is None or not len(estimate):
            return []
        found: list[Quantity] = quantities(estimate, self.truth, seconds_of(estimate, result))
        return found

    def _sums_up(self, leaves: Mapping[str, object]) -> bool:
        return self.innovations and "nis" in leaves

    def _compared(self, series: Series) -> dict[str, float]:
        return {} if self.truth is None else self.errors(series, self.truth, settle=self.settle)


@dataclass(frozen=True)
class Figures:
    """Makes the figures of a run of what the blocks of its score give at its end.

    Args:
        estimate: the stream that was compared.
    """

    estimate: str

    def __call__(self, result: Result) -> dict[str, float]:
        return self.of({name: {n: x[-1] for n, x in s.leaves.items()} for name, s in result.series.items()})

    def of(self, last: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
        """The figures, of the last values of each stream."""
        found = {n: float(x) for n, x in last[self.estimate].items()}
        found["nees_low"], found["nees_high"] = chi_square_band(9)
        for name, sums in last.items():
            if sums.get("nis_count"):
                front = name.removesuffix("innovation")
                found.update({front + n: float(x) for n, x in sums.items() if n != "nis_parts"})
                band = chi_square_band(1, runs=max(round(float(sums["nis_parts"])), 1))
                found[f"{front}nis_low"], found[f"{front}nis_high"] = band
        return found


def _whole(covariance: ArrayType | None) -> bool:
    """Whether a covariance has the nine numbers of a pose."""
    size = 0 if covariance is None else covariance.shape[-1]
    return isinstance(size, int) and size >= 9

"""How a graph is made ready for a flight: with what is set, what the flight says, and a score.

    @on_flight(ekf, "imu", "vicon")
    def for_flight(on: OnFlight, *, filter: PoseFilter) -> Case:
        first = on.inputs["vicon"][0]
        return on.case(filter.score(on, pose_errors), start=start_pose(first.position, first.attitude), ...)

The settings that filters have in common are groups, declared here once. A filter of a pose by an IMU and
something that measures the pose has those of `PoseAided`; what is added there is a setting of all of them.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from flowgraph import Case, Flight, Result, Series
from flowgraph.blocks.filtering.batch import LOSSES, Recording, loss_of
from flowgraph.blocks.inertial.alignment import need_usable
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.kalman.lost import Held
from flowgraph.blocks.kalman.smoothing import Smoothing
from flowgraph.blocks.particles.resampling import MOST_PARTICLES
from flowgraph.blocks.scoring.gates import Adapted, Gated, Weighed
from flowgraph.blocks.scoring.late import Late, built_for
from flowgraph.blocks.scoring.readings import GAP, Ranges, gap_note, gap_notes, gaps, pause, taken
from flowgraph.blocks.scoring.scorer import Errors, Scorer
from flowgraph.blocks.scoring.settings import (
    NotNegative,
    Positive,
    Settings,
    count,
    one_of,
    spliced,
)
from flowgraph.blocks.scoring.start import Started
from flowgraph.blocks.scoring.tuning import given, imu_noise_of, noise_of
from flowgraph.blocks.signals import GRAVITY
from flowgraph.data.notes import note, said
from flowgraph.data.settings import need_settings_taken
from flowgraph.errors import DeclarationError
from flowgraph.language.declare import GraphFunction

__all__ = [
    "Adapted",
    "Factors",
    "Gated",
    "HeldControl",
    "OnFlight",
    "Particles",
    "PoseAided",
    "PoseFilter",
    "PoseNoises",
    "Scored",
    "Smoothed",
    "SmoothedPoseFilter",
    "Weighed",
    "on_flight",
]

Score = Callable[[Result], dict[str, float]]


@dataclass(frozen=True)
class OnFlight:
    """A graph and a flight that are about to become a case.

    Args:
        graph: who asks, in what is refused.
        flight: as it was loaded, or as `told` has completed it.
        inputs: the streams that were needed, by name.
        notes: what is assumed while the case is made; see `note`.
        rewind: s, as the setting of `Late`.
    """

    graph: GraphFunction
    flight: Flight
    inputs: dict[str, Series]
    notes: list[str] = field(default_factory=list)
    rewind: float | None = None

    @property
    def name(self) -> str:
        """The graph's."""
        return self.graph.name

    @property
    def gravity(self) -> tuple[float, float, float]:
        """In the world, m/s^2: zero for a unit that reads the coordinate acceleration."""
        return tuple(self.flight.info.get("gravity", GRAVITY))

    @property
    def weightless(self) -> bool:
        """Whether the unit's readings know no gravity, and so show no vertical."""
        return not any(self.gravity)

    def need(self, *streams: str, fix: str = "choose another flight") -> dict[str, Series]:
        """`Flight.need` of the graph."""
        return self.flight.need(self.name, *streams, fix=fix)

    def note(self, word: str, sentence: str) -> None:
        """Add a note of a kind to the case; see `flowgraph.data.notes`."""
        self.notes.append(note(word, sentence))

    def first_up(self, stream: str, readings: np.ndarray) -> np.ndarray:
        """The first reading (3) of an accelerometer's (n, 3) that shows where up is; see `usable`.

        Raises:
            DataError: where none does.
        """
        row = int(np.argmax(need_usable(readings, f"{self.flight.name}: {stream}")))
        if row:
            self.note("skipped", f"{stream}: {row} readings before the first that shows where up is")
        return np.asarray(readings[row])

    def usual_step(self, control: Series) -> float | None:
        """The median step of a control in s; None where none of its steps is a gap. Gaps are a note."""
        wide, usual = gaps(control)
        if not len(wide):
            return None
        self.notes.append(gap_note(control.name, wide, usual))
        return usual

    def longest(self, inputs: Mapping[str, Series] | None = None) -> float | None:
        """The step in s over which nothing is predicted, `pause`; None where no step is as long.

        Args:
            inputs: those that were needed if left out. A pause of all of them is a note.
        """
        found = pause(self.inputs if inputs is None else inputs)
        if found is None:
            return None
        self.notes.append(found[1])
        return found[0]

    def noise(self, name: str, setting: float | None, otherwise: float | None = None) -> float:
        """A standard deviation or density: `noise_of` of the graph."""
        return noise_of(self.name, self.flight, name, setting, otherwise)

    def case(
        self,
        score: Score,
        *,
        inputs: Mapping[str, Series] | None = None,
        estimate: str | None = None,
        sizes: Mapping[str, int] | None = None,
        files: Mapping[str, Callable[[Result, Path], None]] | None = None,
        begin: Callable[..., Mapping[str, Any]] | None = None,
        **settings: Any,
    ) -> Case:
        """The graph, built on the clocks of its inputs.

        Args:
            score: of a result.
            inputs: by source; those that were needed if left out.
            estimate: the collected stream that it is of; the one that is scored if left out.
            sizes, settings: as for `build`.
            files, begin: as for `Case`.
        """
        inputs = dict(self.inputs if inputs is None else inputs)
        noted = ["imu"] if "imu" in inputs else []
        for name in noted:
            self.usual_step(inputs[name])
        self.notes.extend(gap_notes(inputs, noted))
        smoothed = getattr(score, "smoothing", False)
        built, said_of_late = built_for(self.graph, inputs, self.rewind, sizes, settings, smoothed=smoothed)
        self.notes.extend(said_of_late)
        named = given(estimate, getattr(score, "estimate", "belief"))
        return Case(built, inputs, score, named, said(self.notes), given(files, {}), begin)


def on_flight(
    graph: GraphFunction,
    *needs: str,
    fix: str = "choose another flight",
    told: Callable[[Flight], Flight] | None = None,
    measured: Collection[str] | None = (),
    ranged: bool = True,
    unsmoothed: str | None = None,
) -> Callable[[Callable[..., Case]], Callable[..., Case]]:
    """Decorator: registers `function(on, *, settings) -> Case` as that which makes a case of a flight.

    Settings are checked first, by what their annotations say; then the streams are looked for.

    Args:
        graph: which is made ready.
        needs: streams without which it is not, put into `on.inputs`.
        fix: what to do where one is missing.
        told: completes the flight by what follows from it.
        measured: streams of controls that the graph takes as measurements, which correct by their finite
            entries; None where it takes whole measurements only.
        ranged: whether it takes what inertial sensors read, so that it has the settings of `Ranges`.
        unsmoothed: why its runs cannot be smoothed, where they cannot.

    Raises:
        DataError: by what is registered, where a stream is missing or empty.
        DeclarationError, UnknownNameError: by what is registered, for a setting that is out of range.
    """

    def register(function: Callable[..., Case]) -> Callable[..., Case]:
        known = spliced(function, **({"ranges": Ranges} if ranged else {}), late=Late)
        flown = inspect.Parameter("flight", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=Flight)
        signature = inspect.Signature([flown, *known.parameters], return_annotation=Case)

        @functools.wraps(function)
        def prepare(*args: Any, **keywords: Any) -> Case:
            need_settings_taken(prepare, keywords, graph.name)
            try:
                bound = signature.bind(*args, **keywords)
            except TypeError as error:
                raise TypeError(f"{function.__name__}() {error}") from None
            bound.apply_defaults()
            values = dict(bound.arguments)
            flight = values.pop("flight")
            known.check(graph.name, values)
            flight = flight if told is None else told(flight)
            groups = known.grouped(values)
            flight, notes = taken(flight, groups.pop("ranges", Ranges()), graph.name, measured)
            inputs = flight.need(graph.name, *needs, fix=fix)
            late = groups.pop("late")
            return function(OnFlight(graph, flight, inputs, notes, late.rewind), **groups)

        prepare.__signature__ = signature  # type: ignore[attr-defined]
        prepare.__annotations__ = {p.name: p.annotation for p in signature.parameters.values()}
        prepare.__doc__ = known.documentation
        prepare.scoring = known.scoring  # type: ignore[attr-defined]
        if unsmoothed is not None:
            prepare.refused = dict.fromkeys(  # type: ignore[attr-defined]
                ("smooth", "lag"), f"the runs of this graph cannot be smoothed: {unsmoothed}"
            )
        return graph.on_flight(prepare)

    return register


# -- settings that filters share -------------------------------------------------------------------------


@dataclass(frozen=True)
class Scored(Settings):
    """How a run is scored.

    Args:
        settle: seconds at the start that the errors leave out.
    """

    judges = True
    settle: NotNegative = 1.0

    def score(
        self,
        on: OnFlight,
        errors: Errors,
        *,
        estimate: str = "belief",
        innovations: bool = True,
        steps: Callable[[Result], Smoothing] | None = None,
        recording: Recording | str | None = None,
    ) -> Scorer:
        """The score of a run on that flight; see `Scorer`. In place of a recording it may be said why
        there is no batch estimate."""
        truth = on.flight.truth
        more = self._smoother(on, recording)
        return Scorer(truth, errors, estimate, self.settle, innovations, steps, *more)

    def _smoother(self, on: OnFlight, recording: Recording | str | None) -> tuple[Any, ...]:
        return ()


@dataclass(frozen=True)
class Smoothed(Scored):
    """How a run is scored that can be smoothed.

    Args:
        smooth: "rts" also scores the smoothed run, "batch" the most likely trajectory of the whole
            recording.
        lag: s; also scores the run smoothed with a fixed lag.
        loss: what a measurement that is far off counts in a batch: none (its square), huber or cauchy.
    """

    judges = True
    smooth: Annotated[str, one_of("none", "rts", "batch")] = "none"
    lag: NotNegative | None = None
    loss: Annotated[str, one_of(*LOSSES)] = "none"

    @property
    def smoothed(self) -> bool:
        """Whether a graph is to collect what a smoother needs."""
        return self.smooth != "none" or self.lag is not None

    def _smoother(self, on: OnFlight, recording: Recording | str | None) -> tuple[Any, ...]:
        if self.smooth == "batch" and not isinstance(recording, Recording):
            raise DeclarationError(
                "this graph has no batch estimate" + (f": {recording}" if recording else ""),
                path=f"{on.name}.smooth",
                expected="rts",
                got="batch",
                fix="write smooth=rts",
            )
        recording = recording if isinstance(recording, Recording) else None
        return self.smooth, self.lag, recording, loss_of(self.loss)


@dataclass(frozen=True)
class HeldControl(Settings):
    """What the age of a control does.

    Args:
        held_noise: grow, and a control that has not come for four of its periods makes the prediction less
            sure by its age (`bridge`); or keep, and it counts as fresh.
    """

    held_noise: Annotated[str, one_of("keep", "grow")] = "grow"

    def held(self, on: OnFlight, control: Series, inputs: Mapping[str, Series] | None = None) -> Held | None:
        """From which age on the control of a flight is old; None where it never is, or that is kept.

        A gap is a note of the case; over a pause of all `inputs` nothing is predicted (`OnFlight.longest`).
        """
        usual, longest = on.usual_step(control), on.longest(inputs)
        if usual is None or (self.held_noise == "keep" and longest is None):
            return None
        more = {"rate": 0.0, "force": 0.0} if self.held_noise == "keep" else {}
        return Held(after=GAP * usual, longest=longest, **more)


@dataclass(frozen=True)
class Factors(Settings):
    """How far the densities of an IMU are believed.

    Args:
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU.
    """

    gyro_factor: Positive | None = None
    accelerometer_factor: Positive | None = None

    def imu_noise(self, on: OnFlight, otherwise: tuple[float, float] = (1.0, 1.0)) -> ImuNoise:
        """The noise of the flight's IMU, times the factors, or those of `otherwise` that were left out.

        Raises:
            DataError: where the flight does not say it.
        """
        gyro, accelerometer = otherwise
        return imu_noise_of(
            on.name,
            on.flight,
            given(self.gyro_factor, gyro),
            given(self.accelerometer_factor, accelerometer),
        )


@dataclass(frozen=True)
class PoseNoises(Settings):
    """How far a measured pose is believed.

    Args:
        position_noise, attitude_noise: standard deviations in m and rad; the flight's own if left out.
    """

    position_noise: Positive | None = None
    attitude_noise: Positive | None = None

    def measured(self, on: OnFlight) -> dict[str, Any]:
        """Both, by name: the settings, or the flight's own, or 4 mm and 0.01 rad."""
        return {
            "position_noise": on.noise("position_noise", self.position_noise, 0.004),
            "attitude_noise": on.noise("attitude_noise", self.attitude_noise, 0.01),
        }


@dataclass(frozen=True)
class PoseAided(Factors, PoseNoises, Scored, Started):
    """What every filter has that is driven by an IMU and corrected by poses."""


@dataclass(frozen=True)
class PoseFilter(PoseAided, HeldControl, Adapted):
    """A `PoseAided` filter that can refuse a measurement, for which it must be Gaussian."""


@dataclass(frozen=True)
class SmoothedPoseFilter(PoseFilter, Smoothed):
    """A `PoseFilter` of which a run can be smoothed."""


@dataclass(frozen=True)
class Particles(Settings):
    """A cloud of particles.

    Args:
        particles: how many.
        seed: of the start's draws; that of the run is given to `simulate`.
        resample_below: resample when the effective sample size is below this fraction of the particles.
        scheme: systematic, stratified, residual or multinomial.
    """

    particles: Annotated[int, count(1, MOST_PARTICLES)] = 1000
    seed: int = 0
    resample_below: NotNegative = 0.5
    scheme: str = "systematic"

    def resampling(self) -> dict[str, Any]:
        """What is a setting of the graph itself, by name."""
        return {"resample_below": self.resample_below, "scheme": self.scheme}

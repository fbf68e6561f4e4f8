"""The experiment of the thesis: five filters, six settings of noise, flights of its random family.

Every filter starts on the truth and is told the noise. IMU 200 Hz, motion capture 4 Hz. A setting is three
letters, for motion capture, accelerometer and gyroscope: H for the precise one, L for the other. The thesis's
accelerometer reads the coordinate acceleration in the body, zero at rest: for a filter that is an inertial
unit in a world without gravity. Its gyroscope measures the rotation since its last reading.

The thesis prints as RMSE what its code computes without a root: the mean of |p - p_true|^2, and the mean of
the square of |R - R_true|_F^2. These, the "thesis metric", stand beside its figures; the errors in metres and
degrees are root mean squares. The bound is the posterior Cramér-Rao bound along the truth, of the same
flights, noise and ticks, for a start that is known exactly: no filter on these readings is better. A filter's
run can be smoothed too (`eskf_smoothed`); the bound beside it is then that of smoothers.

Source: R. Fiszel, thesis (2017), the tables of its results; for the bound see `blocks/metrics/bound.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Flight, Graph, Report, Series, clocks_of, simulate_many
from flowgraph.blocks.flights.worlds import load_world
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.geometry.rotations import geodesic_angle
from flowgraph.blocks.inertial.alignment import StartSpread, start_belief
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.kalman.smoothing import smoother_gain, smoothing_pass
from flowgraph.blocks.metrics.errors import nees, state_error
from flowgraph.blocks.models.inertial_pose import INERTIAL_BIASED, stacked
from flowgraph.blocks.models.pose import start_pose
from flowgraph.blocks.models.pose_bound import pose_bound
from flowgraph.blocks.models.unscented_pose import STATE, start_state
from flowgraph.blocks.particles.cloud import start_cloud
from flowgraph.blocks.scoring.point import positions
from flowgraph.blocks.scoring.tuning import WEIGHTLESS, reading_of, with_imu
from flowgraph.blocks.signals import Attitude, Belief, Gaussian, PoseEstimate
from flowgraph.graphs.augmented_complementary import augmented_complementary
from flowgraph.graphs.benches import engine_of, lists
from flowgraph.graphs.benches.thesis_picture import draw, write_page
from flowgraph.graphs.ekf import ekf
from flowgraph.graphs.ins_eskf import ins_eskf
from flowgraph.graphs.rbpf_indoor import rbpf_indoor
from flowgraph.graphs.ukf import ukf
from flowgraph.language.checks import need_count

__all__ = ["FILTERS", "PUBLISHED", "SETTINGS", "thesis"]

RATE = 200.0
NEAR = StartSpread(1e-3, 1e-3, 1e-3, 1e-3, 0.0, 0.0)
"""The start is the truth; a covariance of zero has no square root."""

AT_ONCE = 50
"""Flights whose covariances are held in memory together."""

VARIANCES = {"H": 0.1, "L": 1.0}
"""Of a sample of accelerometer or gyroscope, (m/s^2)^2 and (rad/s)^2; the motion capture's are a tenth."""

SETTINGS = ("HHH", "HHL", "HLL", "LHH", "LHL", "LLL")
"""Motion capture, accelerometer, gyroscope."""

_POSITION = {
    "acf": (0.0688, 0.0610, 0.0405, 0.505, 0.616, 0.357),
    "ekf": (0.0326, 0.113, 0.0524, 0.505, 1.09, 0.266),
    "ukf": (0.0345, 0.0920, 0.0329, 0.290, 0.930, 0.327),
    "rbpf": (0.0145, 0.0217, 0.0161, 0.127, 0.122, 0.119),
}
_ATTITUDE = {
    "acf": (0.00736, 0.00637, 0.00625, 0.530, 0.518, 0.590),
    "ekf": (0.00586, 0.0137, 0.0169, 0.328, 0.299, 0.328),
    "ukf": (0.00517, 0.00917, 0.0102, 0.326, 0.295, 0.324),
    "rbpf": (0.000101, 0.00065, 0.000834, 0.00582, 0.00578, 0.00397),
}
PUBLISHED: Mapping[tuple[str, str], tuple[float, float]] = {
    (name, setting): (position, attitude)
    for name in _POSITION
    for setting, position, attitude in zip(SETTINGS, _POSITION[name], _ATTITUDE[name], strict=True)
}
"""The thesis's figures for position and attitude, by filter and setting, in its metric."""


@dataclass(frozen=True)
class Noise:
    """The standard deviation of the motion capture, m and rad, and the densities of the inertial unit."""

    pose: float
    imu: ImuNoise

    @classmethod
    def of(cls, setting: str) -> Noise:
        """That of a setting such as "HLL"."""
        capture, force, turn = (VARIANCES[letter] for letter in setting)
        return cls(float(np.sqrt(0.1 * capture)), ImuNoise.per_sample(RATE, gyro=turn, accelerometer=force))


@dataclass(frozen=True)
class Trial:
    """A filter on one flight: what it is fed, and the register that holds its start."""

    graph: Callable[..., Graph]
    inputs: Mapping[str, Series]
    start: Mapping[str, Any]


def fly(seed: int, noise: Noise, *, duration: float = 20.0) -> Flight:
    """A flight of the thesis with its sensors: the stream `imu` is of a world without gravity."""
    settings: dict[str, str | float] = {
        "sensors": "gyro,coordinate_acceleration,vicon",
        "duration": duration,
        "gyro.noise": noise.imu.gyro,
        "coordinate_acceleration.noise": noise.imu.accelerometer,
        "vicon.noise": noise.pose,
        "vicon.attitude_noise": noise.pose,
    }
    flight = with_imu(load_world("thesis", seed=seed, settings=settings))
    streams = {name: flight.streams[name] for name in ("imu", "vicon")}
    return Flight(flight.name, streams, flight.truth, flight.info)


def _acf(flight: Flight, noise: Noise, _: int) -> Trial:
    p, v, q = _at_first(flight)
    start = PoseEstimate(position=p, velocity=v, attitude=q)
    build = lambda **more: augmented_complementary.build(
        **clocks_of(flight.streams), start=start, gravity=WEIGHTLESS, reading=reading_of(flight), **more
    )
    return Trial(build, flight.streams, {"previous": start})


def _ekf(flight: Flight, noise: Noise, _: int) -> Trial:
    return _told(ekf, flight, noise, _near(start_pose, flight))


def _ukf(flight: Flight, noise: Noise, _: int) -> Trial:
    return _told(ukf, flight, noise, _near(start_state, flight))


def _eskf(flight: Flight, noise: Noise, _: int) -> Trial:
    p, v, q = _at_first(flight)
    start = start_belief(p, q, velocity=v, spread=NEAR)  # biases known: nine states are left
    imu, vicon = (flight.streams[name] for name in ("imu", "vicon"))
    turns = Series(vicon.time, Attitude(attitude=vicon["attitude"]), name="attitude")
    inputs = {"imu": imu, "position": positions(vicon), "attitude": turns}
    return _told(ins_eskf, flight, noise, start, inputs=inputs)


def _rbpf(flight: Flight, noise: Noise, particles: int) -> Trial:
    p, v, q = _at_first(flight)
    start = start_cloud(particles, position=p, velocity=v, attitude=q, spread=NEAR)
    return _told(rbpf_indoor, flight, noise, start, register="cloud")


def _near(start: Callable[..., Any], flight: Flight) -> Any:
    p, v, q = _at_first(flight)
    return start(
        p,
        q,
        velocity=v,
        position_deviation=NEAR.position,
        velocity_deviation=NEAR.velocity,
        attitude_deviation=NEAR.tilt,
    )


def _told(
    graph: Any,
    flight: Flight,
    noise: Noise,
    start: Any,
    *,
    register: str = "belief",
    inputs: Mapping[str, Series] | None = None,
) -> Trial:
    """A filter of a pose on the flight's streams, or on `inputs`; told how the unit reads, if it asks."""
    inputs = flight.streams if inputs is None else inputs
    build = lambda **more: graph.build(
        **clocks_of(inputs),
        start=start,
        noise=noise.imu,
        position_noise=noise.pose,
        attitude_noise=noise.pose,
        gravity=WEIGHTLESS,
        **({"reading": reading_of(flight)} if "reading" in graph.parameters[1] else {}),
        **more,
    )
    return Trial(build, inputs, {register: start})


FILTERS: Mapping[str, Callable[[Flight, Noise, int], Trial]] = {
    "acf": _acf,
    "ekf": _ekf,
    "ukf": _ukf,
    "rbpf": _rbpf,
    "eskf": _eskf,
}
"""By name: what runs the filter on a flight, told the noise, with a number of particles."""

SMOOTHED: Mapping[str, tuple[str, Any, Callable[[Any], Gaussian], StateSpace]] = {
    "eskf": ("belief", Belief, stacked, INERTIAL_BIASED),
    "ukf": ("posterior", Gaussian, lambda belief: belief, STATE),
}
"""Those whose runs can be smoothed: the stream of their beliefs and its signal, these as Gaussians, and over
what space."""

SMOOTHED_AT_ONCE = 10
"""Flights whose covariances, priors and cross-covariances are held in memory together."""


def thesis(
    *,
    flights: int = 5,
    particles: int = 1000,
    duration: float = 20.0,
    seed: int = 0,
    settings: str = ",".join(SETTINGS),
    filters: str = ",".join(FILTERS),
    smoothed: str = "eskf",
    engine: str = "auto",
) -> Report:
    """The thesis's table: ACF, EKF, UKF, RBPF and an error-state filter in six settings of noise.

    Args:
        flights: how many of the random family; the same for all filters. The thesis flew 5.
        particles: of rbpf.
        duration: of a flight, s, at most 20.
        seed: of the first flight; the others follow.
        settings, filters: those to run, with commas between.
        smoothed: of the filters, those whose runs are smoothed too: eskf, ukf, both or none.
        engine: as for `simulate_many`; "auto" is c where there is a compiler, else xla or python.

    Returns:
        A row a setting and filter: the errors, the 95 % interval of the position RMSE (bootstrap over
        flights), the bound of both on the same flights, the mean NEES (9 in an honest filter; None where a
        filter tells no covariance), and the thesis's metric and figure.
    """
    need_count("thesis", "flights", flights, least=1)
    need_count("thesis", "particles", particles, least=1)
    engine = engine_of(engine, many=True)
    chosen = lists.names(filters, FILTERS, what="filter", path="thesis.filters")
    codes = lists.names(settings, SETTINGS, what="setting", path="thesis.settings")
    better = []
    if smoothed:
        better = lists.names(smoothed, SMOOTHED, what="filter that is smoothed", path="thesis.smoothed")
    better = [name for name in better if name in chosen]
    rows = []
    for code in codes:
        noise = Noise.of(code)
        flown = [fly(seed + k, noise, duration=duration) for k in range(flights)]
        bound = bound_of(flown, noise)
        for name in chosen:
            errors = _errors(FILTERS[name], flown, noise, particles, engine)
            rows.append(_row(code, name, errors, bound))
        least = bound_of(flown, noise, smoothing=True) if better else bound
        for name in better:
            errors = smoothed_errors(name, flown, noise, engine)
            rows.append(_row(code, f"{name}_smoothed", errors, least))
    words = f"{flights} flights of {duration:g} s, {particles} particles, {engine}"

    def page(path: Path) -> None:
        noise = Noise.of(codes[0])
        flight = fly(seed, noise, duration=duration)
        trials = {name: FILTERS[name](flight, noise, particles) for name in chosen}
        write_page(rows, path, words=words, flight=flight, trials=trials)

    return Report(rows, {"thesis.png": lambda path: draw(rows, path), "thesis.html": page}, (words,))


@dataclass(frozen=True)
class Errors:
    """The squared errors of a filter, a mean a flight: m^2, rad^2, and the thesis's of the attitude.

    nees: the mean a flight, or none.
    """

    position: np.ndarray
    attitude: np.ndarray
    frobenius: np.ndarray
    nees: np.ndarray


def bound_of(flown: list[Flight], noise: Noise, *, smoothing: bool = False) -> tuple[float, float]:
    """The root mean squares below which no filter's errors are, or no smoother's; m and rad."""
    squares = []
    for first in range(0, len(flown), AT_ONCE):
        some = flown[first : first + AT_ONCE]
        time = _truth(some[0]).time
        velocity, attitude = (
            np.stack([_truth(f)[name] for f in some], axis=1) for name in ("velocity", "attitude")
        )
        P = pose_bound(
            time,
            velocity,
            attitude,
            measured=np.isin(time, some[0].streams["vicon"].time),
            noise=noise.imu,
            position_noise=noise.pose,
            attitude_noise=noise.pose,
            gravity=WEIGHTLESS,
            smoothing=smoothing,
        )
        variances = np.diagonal(P, axis1=-2, axis2=-1).mean(0)
        squares.append(np.stack([variances[:, :3].sum(-1), variances[:, 6:].sum(-1)], axis=-1))
    position, attitude = np.sqrt(np.concatenate(squares).mean(0)).tolist()
    return position, attitude


def _errors(make: Any, flown: list[Flight], noise: Noise, particles: int, engine: str) -> Errors:
    graph = make(flown[0], noise, particles).graph()
    output = next(name for name in ("belief", "pose") if name in {c.name for c in graph.collected})
    parts = []
    for first in range(0, len(flown), AT_ONCE):
        some = flown[first : first + AT_ONCE]
        trials = [make(flight, noise, particles) for flight in some]
        batch = simulate_many(
            graph,
            [trial.inputs for trial in trials],
            range(first, first + len(some)),
            engine=engine,
            init=[trial.start for trial in trials],
            keep=[output],
            runs_at_once=min(len(trials), 10),
        )
        found = batch[output]
        for k, flight in enumerate(some):
            p, v, q = (found[name][k] for name in ("position", "velocity", "attitude"))
            P = found["covariance"][k][:, :9, :9] if "covariance" in found.leaves else None
            parts.append(_compared(found.time, _truth(flight), p, v, q, P))
    return Errors(*np.array(parts).T)


def smoothed_errors(name: str, flown: list[Flight], noise: Noise, engine: str) -> Errors:
    """Those of the smoothed runs of a filter; all flights go back together."""
    stream, signal, gaussian, space = SMOOTHED[name]
    make, parts = FILTERS[name], []
    graph = make(flown[0], noise, 1).graph(smoothing=True)
    for first in range(0, len(flown), SMOOTHED_AT_ONCE):
        some = flown[first : first + SMOOTHED_AT_ONCE]
        trials = [make(flight, noise, 1) for flight in some]
        batch = simulate_many(
            graph,
            [trial.inputs for trial in trials],
            range(first, first + len(some)),
            engine=engine,
            init=[trial.start for trial in trials],
            keep=["prior", stream, "cross"],
            runs_at_once=len(trials),
        )
        before, after = (
            gaussian(signal(**{leaf: np.swapaxes(batch[of][leaf], 0, 1) for leaf in batch[of].leaves}))
            for of in ("prior", stream)
        )
        cross = np.swapaxes(batch["cross"]["covariance"], 0, 1)
        gains = np.asarray(smoother_gain(cross[1:], np.asarray(before.covariance)[1:], np))
        mean, P, _ = smoothing_pass(
            gains, before.mean, before.covariance, after.mean, after.covariance, space
        )
        for k, flight in enumerate(some):
            p, v, q, _ = np.split(mean[:, k], (3, 6, 10), axis=-1)
            parts.append(_compared(batch[stream].time, _truth(flight), p, v, q, P[:, k, :9, :9]))
    return Errors(*np.array(parts).T)


def _compared(
    time: np.ndarray, truth: Series, p: np.ndarray, v: np.ndarray, q: np.ndarray, P: np.ndarray | None
) -> tuple[float, float, float, float]:
    """The mean over one flight of squared position error, attitude error, the thesis's of it, and NEES."""
    np.testing.assert_array_equal(time, truth.time)
    squared = np.sum((p - truth["position"]) ** 2, axis=-1)
    angle = np.radians(geodesic_angle(q, truth["attitude"]))
    honest = np.array([np.nan]) if P is None else nees(state_error(time, truth, p, v, q), P)
    means = (np.mean(x) for x in (squared, angle**2, (8.0 * np.sin(0.5 * angle) ** 2) ** 2, honest))
    a, b, c, d = map(float, means)
    return a, b, c, d


def _row(code: str, name: str, errors: Errors, bound: tuple[float, float]) -> dict[str, Any]:
    published = PUBLISHED.get((name, code), (None, None))
    drawn = np.random.default_rng(0).integers(len(errors.position), size=(2000, len(errors.position)))
    low, high = np.percentile(np.sqrt(errors.position[drawn].mean(axis=1)), [2.5, 97.5])
    return {
        "setting": code,
        "filter": name,
        "position_rmse_m": _root(errors.position),
        "position_rmse_low_m": float(low),
        "position_rmse_high_m": float(high),
        "bound_position_rmse_m": bound[0],
        "attitude_rmse_deg": float(np.degrees(_root(errors.attitude))),
        "bound_attitude_rmse_deg": float(np.degrees(bound[1])),
        "nees_mean": None if np.isnan(errors.nees).any() else float(errors.nees.mean()),
        "thesis_metric_position": float(errors.position.mean()),
        "thesis_position": published[0],
        "thesis_metric_attitude": float(errors.frobenius.mean()),
        "thesis_attitude": published[1],
    }


def _root(squares: np.ndarray) -> float:
    return float(np.sqrt(squares.mean()))


def _truth(flight: Flight) -> Series:
    assert flight.truth is not None
    return flight.truth


def _at_first(flight: Flight) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    truth = _truth(flight)
    return truth["position"][0], truth["velocity"][0], truth["attitude"][0]

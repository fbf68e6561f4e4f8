"""Filters of a model: equal in all engines, equal to what is known, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import (
    Array,
    DeclarationError,
    LoweringError,
    Series,
    Signal,
    Stream,
    arrays,
    clocks_of,
    delay,
    graph,
    latest,
    lower,
    real,
    simulate,
)
from flowgraph.blocks.filtering import (
    DiscreteModel,
    LinearMeasurement,
    LinearModel,
    MeasurementModel,
    MotionModel,
    SigmaPoints,
    StateSpace,
    angle,
    cubature,
    euclidean,
    extended,
    filtered,
    first,
    information,
    linear,
    square_root,
    unscented,
)
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.kalman import predict_linear, update_linear
from flowgraph.blocks.models.inertial_pose import (
    INERTIAL,
    INERTIAL_BIASED,
    INERTIAL_GROUP,
    inertial_motion,
    pose_seen,
)
from flowgraph.blocks.models.pose import between_imu
from flowgraph.blocks.models.tracking import (
    BICYCLE,
    PENDULUM,
    TURNING,
    bicycle,
    constant_acceleration,
    constant_velocity,
    coordinated_turn,
    pendulum,
    singer,
)
from flowgraph.blocks.signals import Gaussian, Imu, Pose, Steering
from flowgraph.graphs import ekf, ukf
from tests.graphs.estimation import smooth
from tests.support import all_engines, same

MS = 1_000_000
SLOW = pytest.mark.slow


class Fix(Signal):
    """A position in the plane, and how good it is."""

    position: Array = real(2, unit="m")
    covariance: Array = real(2, 2)


CAR = bicycle(2.7, steering=0.02, acceleration=0.3)
START = BICYCLE.gaussian(position=((0.0, 0.0), 1.0), heading=(0.3, 0.2), speed=(5.0, 0.5))
GPS = MeasurementModel(BICYCLE, lambda x, xp: x.position, noise=4.0, read=lambda fix: fix.position)


@graph
def tracker(steering: Stream[Steering], fix: Stream[Fix], *, seen=GPS, start=START, method=None, gate=None):
    """The belief about a car."""
    return filtered(CAR, {seen: fix}, control=steering, start=start, method=method, gate=gate)


def driven(seconds: float = 10.0, seed: int = 0):
    """States (n, 4) at 20 Hz, and the inputs: GPS at 2 Hz with a clock of its own."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(20 * seconds)) * 50 * MS
    told = Steering(angle=0.1 * np.sin(time * 1e-9), acceleration=0.3 * np.cos(0.7e-9 * time))
    x, states = np.array([[0.0, 0.0, 0.3, 5.0]]), []
    for k in range(len(time)):
        if k:
            w = rng.normal(size=(1, 2)) * np.sqrt(np.array([0.02, 0.3]) ** 2 / 0.05)
            held = Steering(angle=told.angle[k - 1], acceleration=told.acceleration[k - 1])
            x = CAR.carry(x, held, w, 0.05, np)
        states.append(x[0])
    at = np.arange(3, len(time), 10)
    position = np.array(states)[at, :2] + 2.0 * rng.normal(size=(len(at), 2))
    fix = Fix(position=position, covariance=np.broadcast_to(4.0 * np.eye(2), (len(at), 2, 2)))
    return np.array(states), {"steering": Series(time, told), "fix": Series(time[at], fix)}


METHODS = {
    "extended": extended(),
    "iterated": extended(iterations=3),
    "root": square_root(),
    "information": information(),
    "unscented": unscented(),
    "cubature": cubature(),
}


@pytest.mark.parametrize(
    "name",
    [
        "extended",
        "unscented",
        *(pytest.param(n, marks=SLOW) for n in ("iterated", "root", "information", "cubature")),
    ],
)
def test_a_method_is_equal_in_all_engines_lowered_and_drawn(name):
    _, inputs = driven(3.0)
    built = tracker.build(method=METHODS[name])
    result = all_engines(built, inputs)
    assert len(result["innovation"]) == len(inputs["fix"])
    assert len(result["log_likelihood"]) == len(inputs["fix"])
    paths = {stage.path for stage in lower(built).stages}
    assert {"filter/predict", "filter/correct"} <= paths
    assert "predict" in built.text()


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_a_method_is_consistent_and_better_than_what_it_is_told(name):
    nees, error, nis = [], [], []
    for seed in range(6):
        states, inputs = driven(20.0, seed)
        result = simulate(tracker.build(method=METHODS[name]), inputs, engine="reference")
        belief = result["output"]
        apart = BICYCLE.minus(states, belief["mean"], np)
        solved = np.linalg.solve(belief["covariance"], apart[..., None])[..., 0]
        nees.append(np.sum(apart * solved, axis=-1).mean())
        error.append(np.sqrt(np.mean(np.sum(apart[:, :2] ** 2, axis=-1))))
        nis.append(result["innovation"]["nis"].mean())
    assert np.mean(error) < 1.6, "a fix alone is 2.8 m off"
    assert 3.0 < np.mean(nees) < 5.2, "4 in a consistent filter"
    assert 1.6 < np.mean(nis) < 2.4, "2 in a consistent filter"


def test_noise_that_goes_in_is_noise_that_is_added_where_it_only_adds():
    _, inputs = driven(2.0)
    inside = MeasurementModel(
        BICYCLE, lambda x, v, xp: x.position + v, noise=[4.0, 4.0], read=lambda fix: fix.position
    )
    told = MeasurementModel(
        BICYCLE, lambda x, xp: x.position, noise=lambda fix: fix.covariance, read=lambda fix: fix.position
    )
    for method in (extended(), unscented()):
        expected = simulate(tracker.build(method=method), inputs)
        for seen in (inside, told):
            found = simulate(tracker.build(seen=seen, method=method), inputs)
            for leaf in ("mean", "covariance"):
                np.testing.assert_allclose(found["output"][leaf], expected["output"][leaf], atol=1e-10)
            likely = expected["log_likelihood"]["value"]
            np.testing.assert_allclose(found["log_likelihood"]["value"], likely, atol=1e-10)


# -- linear models ---------------------------------------------------------------------------------------

POINT = constant_velocity(0.5, dimensions=2)
PLACE = LinearMeasurement(POINT.space, np.eye(2, 4), noise=0.25)
AMBLING = POINT.space.gaussian(position=((0.0, 0.0), 1.0), velocity=((1.0, 0.0), 1.0))


class Spot(Signal):
    """A position in the plane."""

    position: Array = real(2)


@graph
def point(spot: Stream[Spot], *, motion=POINT, seen=PLACE, start=AMBLING, method=None, gate=None, patience=5):
    """The belief about a point."""
    return filtered(motion, {seen: spot}, start=start, method=method, gate=gate, patience=patience)


def spots(n: int = 40, seed: int = 0, **changed) -> dict[str, Series]:
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.integers(50, 200, n)) * MS
    position = np.c_[time * 1e-9, np.sin(time * 1e-9)] + 0.5 * rng.normal(size=(n, 2))
    for row, value in changed.get("at", {}).items():
        position[row] = value
    return {"spot": arrays(time, Spot(position=position), not_finite="keep")}


@pytest.mark.parametrize("method", [linear(), *METHODS.values()])
def test_all_methods_are_the_kalman_filter_for_a_linear_model(method):
    @graph
    def known(spot: Stream[Spot]):
        """The same from the blocks of the Kalman filter."""
        belief = delay(AMBLING, name="belief")
        model = LinearModel(np.eye(4, 4, 2), np.zeros((4, 1)), np.diag([0.0, 0.0, 0.25, 0.25]))
        still = latest(spot.map(lambda s: 0.0 * s.position[:1]), init=np.zeros(1), at=spot)
        prior = predict_linear(belief, still, model=model)
        posterior, _ = update_linear(prior, spot.map(lambda s: s.position), H=np.eye(2, 4), R=0.25)
        belief.feed(posterior)
        return posterior

    inputs = spots()
    expected, found = simulate(known.build(), inputs), simulate(point.build(method=method), inputs)
    for leaf in ("mean", "covariance"):
        np.testing.assert_allclose(found["output"][leaf], expected["output"][leaf], rtol=0, atol=1e-12)


def test_the_likelihood_is_that_of_all_measurements_at_once():
    """Of a discrete model: the joint Gaussian of three measurements, written out."""
    F, Q, H, R = np.array([[1.0, 0.1], [0.0, 0.9]]), np.diag([0.01, 0.04]), np.array([[1.0, 0.0]]), 0.09
    motion = DiscreteModel(F, Q)
    start = Gaussian(mean=np.array([0.3, -0.2]), covariance=np.diag([0.5, 0.7]))
    z = np.array([0.1, 0.4, -0.3])

    @graph
    def steps(z: Stream[Value], *, method):
        """By steps."""
        return filtered(motion, {LinearMeasurement(motion.space, H, noise=R): z}, start=start, method=method)

    covariance, mean = np.zeros((3, 3)), np.zeros(3)
    P = [start.covariance]
    for _ in range(2):
        P.append(F @ P[-1] @ F.T + Q)
    for i in range(3):
        mean[i] = (H @ np.linalg.matrix_power(F, i) @ start.mean)[0]
        for j in range(i + 1):
            covariance[i, j] = (H @ np.linalg.matrix_power(F, i - j) @ P[j] @ H.T)[0, 0]
            covariance[j, i] = covariance[i, j]
    covariance += R * np.eye(3)
    expected = -0.5 * (
        (z - mean) @ np.linalg.solve(covariance, z - mean)
        + np.linalg.slogdet(covariance)[1]
        + 3.0 * np.log(2.0 * np.pi)
    )
    inputs = {"z": Series(np.arange(3) * 100 * MS, Value(value=z))}
    for method in (linear(), unscented()):
        result = simulate(steps.build(method=method), inputs)
        assert abs(result["log_likelihood"]["value"].sum() - expected) < 1e-12


class Value(Signal):
    """A number."""

    value: Array = real()


def test_matrices_may_come_with_each_message():
    """F, H and R of each step from the messages: the same as the constants, where these are what is said."""

    class Said(Signal):
        F: Array = real(2, 2)
        H: Array = real(1, 2)
        R: Array = real(1, 1)
        z: Array = real(1)

    space = StateSpace(x=euclidean(2))
    start = space.gaussian(x=((0.3, -0.2), 0.8))
    F, H = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[1.0, 0.5]])

    @graph
    def varying(said: Stream[Said]):
        """All in the message."""
        motion = DiscreteModel(lambda s: s.F, np.diag([0.01, 0.04]), space=space)
        seen = LinearMeasurement(space, lambda s: s.H, noise=lambda s: s.R, read=lambda s: s.z)
        return filtered(motion, {seen: said}, control=said, start=start, method=linear())

    @graph
    def fixed(said: Stream[Said]):
        """All known before."""
        motion = DiscreteModel(F, np.diag([0.01, 0.04]), space=space)
        seen = LinearMeasurement(space, H, noise=0.09, read=lambda s: s.z)
        return filtered(motion, {seen: said}, start=start, method=linear())

    n = 6
    spread = lambda a: np.broadcast_to(a, (n, *np.shape(a)))
    z = np.random.default_rng(0).normal(size=(n, 1))
    said = Said(F=spread(F), H=spread(H), R=spread(np.array([[0.09]])), z=z)
    inputs = {"said": Series(np.arange(n) * 100 * MS, said)}
    a, b = all_engines(varying.build(), inputs), simulate(fixed.build(), inputs)
    np.testing.assert_allclose(a["output"]["covariance"], b["output"]["covariance"], atol=1e-14)
    np.testing.assert_allclose(a["output"]["mean"], b["output"]["mean"], atol=1e-14)


def test_on_a_root_a_sharp_measurement_leaves_a_covariance_in_single_precision():
    """Deviations of 1 mm beside 100 m: their squares have more digits between them than float32."""
    wide = POINT.space.gaussian(position=((0.0, 0.0), 1e2), velocity=((1.0, 0.0), 1.0))
    sharp = LinearMeasurement(POINT.space, np.eye(2, 4), noise=1e-6)
    inputs = spots(30)
    built = point.build(seen=sharp, start=wide, method=square_root())
    exact = simulate(built, inputs)["output"]["covariance"]
    single = simulate(built, inputs, engine="reference", dtype="float32")["output"]["covariance"]
    deviations = np.sqrt(np.einsum("nii->ni", exact))
    apart = np.abs(single - exact) / (deviations[:, :, None] * deviations[:, None, :])
    assert apart.max() < 0.02
    assert (np.linalg.eigvalsh(exact) > 0.0).all()


# -- what goes wrong in the field ------------------------------------------------------------------------


@pytest.mark.parametrize("method", [extended(), square_root(), information(), unscented()])
def test_a_gate_refuses_and_finds_its_way_back(method):
    jump = {k: (50.0, 50.0) for k in range(20, 40)}
    built = point.build(method=method, gate=0.999)
    result = (all_engines if method == extended() else simulate)(built, spots(at=jump))
    accepted = result["innovation"]["accepted"]
    assert accepted[:20].all()
    assert not accepted[20:25].any()
    assert accepted[-5:].all()
    assert np.abs(result["output"]["mean"][-1][:2] - 50.0).max() < 1.0


@pytest.mark.parametrize("method", METHODS.values())
def test_entries_that_are_missing_say_nothing(method):
    at = {5: (np.nan, 0.1), 9: (np.nan, np.nan)}
    inputs = spots(at=at)
    series = inputs["spot"]
    result = simulate(point.build(method=method), inputs)
    assert len(result["innovation"]) == len(series) - 1
    assert result["innovation"]["parts"][5] == 1.0
    for leaf in ("mean", "covariance"):
        assert np.isfinite(result["output"][leaf]).all()
    np.testing.assert_array_equal(result["output"]["mean"][9], result["prior"]["mean"][9])
    before, after = (result[name]["covariance"][5, 0, 0] for name in ("prior", "output"))
    assert before == pytest.approx(after, rel=1e-14)


@pytest.mark.parametrize("method", [extended(), square_root(), information(), unscented()])
def test_a_filter_starts_from_its_first_measurement(method):
    def believe(fix, xp):
        mean = xp.concat([fix.position, xp.asarray([0.3, 5.0])])
        return Gaussian(mean=mean, covariance=xp.asarray(np.diag([4.0, 4.0, 0.04, 0.25])))

    _, inputs = driven(3.0)
    built = tracker.build(start=first(GPS, believe), method=method)
    result = simulate(built, inputs)
    same(result, simulate(built, inputs, engine="reference"))
    fix = inputs["fix"]
    assert result["output"].time[0] == fix.time[0] == result["prior"].time[0]
    np.testing.assert_array_equal(result["output"]["mean"][0], [*fix["position"][0], 0.3, 5.0])
    np.testing.assert_array_equal(result["innovation"].time, fix.time[1:])
    later = {name: series[series.time >= fix.time[0]] for name, series in inputs.items()}
    start = Gaussian(mean=result["output"]["mean"][0], covariance=result["output"]["covariance"][0])
    later["fix"] = later["fix"][1:]
    other = simulate(tracker.build(start=start, method=method), later)
    np.testing.assert_allclose(result["output"]["mean"], other["output"]["mean"], atol=1e-12)


# -- the library's models --------------------------------------------------------------------------------


def test_the_points_are_their_closed_forms():
    T, q = 0.7, 0.3**2
    _, F, Q = constant_velocity(0.3, dimensions=1).linearised(np.zeros(2), None, T, np)
    np.testing.assert_allclose(F, [[1.0, T], [0.0, 1.0]])
    np.testing.assert_allclose(Q, q * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]]))
    _, F, Q = constant_acceleration(0.3, dimensions=1).linearised(np.zeros(3), None, T, np)
    np.testing.assert_allclose(F[0], [1.0, T, T * T / 2])
    np.testing.assert_allclose(Q[0], q * np.array([T**5 / 20, T**4 / 8, T**3 / 6]))
    tau = 2.0
    _, F, Q = singer(0.3, tau, dimensions=1).linearised(np.zeros(3), None, T, np)
    decay = np.exp(-T / tau)
    np.testing.assert_allclose(F[0, 2], tau * tau * (T / tau - 1.0 + decay))
    np.testing.assert_allclose(Q[2, 2], q * (1.0 - decay**2))


@pytest.mark.parametrize("rate", [0.0, 1e-9, 0.05, 0.8])
def test_a_turn_is_the_limit_of_many_small_ones(rate):
    motion = coordinated_turn(0.1, 0.01)
    x = np.array([[1.0, 2.0, 3.0, -1.0, rate]])
    whole, y = motion.carry(x, None, np.zeros((1, 3)), 1.0, np), x
    for _ in range(1000):
        y = motion.carry(y, None, np.zeros((1, 3)), 1e-3, np)
    np.testing.assert_allclose(whole, y, atol=1e-12)
    assert np.hypot(*whole[0, 2:4]) == pytest.approx(np.hypot(3.0, 1.0), abs=1e-12)


def test_a_pendulum_keeps_its_energy_and_a_car_its_circle():
    motion, x = pendulum(1.0, push=0.1), np.array([[1.0, 0.0]])
    for _ in range(100):
        x = motion.carry(x, None, np.zeros((1, 1)), 0.01, np)
    energy = 0.5 * x[0, 1] ** 2 - 9.81 * np.cos(x[0, 0])
    assert energy == pytest.approx(-9.81 * np.cos(1.0), abs=1e-6)
    turn, x = Steering(angle=np.float64(0.2), acceleration=np.float64(0.0)), np.array([[0.0, 0.0, 0.0, 2.0]])
    for _ in range(50):
        x = CAR.carry(x, turn, np.zeros((1, 2)), 0.05, np)
    radius = 2.7 / np.tan(0.2)
    assert np.hypot(x[0, 0], x[0, 1] - radius) == pytest.approx(radius, abs=1e-6)


@pytest.mark.parametrize(
    "space", [INERTIAL, pytest.param(INERTIAL_GROUP, marks=SLOW)], ids=["parts", "group"]
)
def test_the_pose_by_the_model_is_the_pose_by_hand(space):
    """Extended as `ekf`, unscented as `ukf` to rounding: the noise is scaled in another order."""

    @graph
    def pose(
        imu: Stream[Imu],
        vicon: Stream[Pose],
        *,
        start,
        noise,
        position_noise,
        attitude_noise,
        gravity,
        method,
    ):
        """The same wiring as that of `ukf`."""
        ticks = imu | vicon
        last = delay(Imu.at_rest(-gravity[2]), name="last")
        now = latest(imu, init=Imu.at_rest(-gravity[2]), at=ticks, name="now")
        drive = between_imu(last, now)
        last.feed(now)
        motion = inertial_motion(noise, space=space, gravity=gravity)
        seen = pose_seen(position_noise, attitude_noise, space=space)
        return filtered(motion, {seen: vicon}, control=drive, start=start, method=method)

    flight = smooth(1, 1.0)
    by_hand = {g.name: g.case(flight) for g in (ekf, ukf)}
    told = by_hand["ukf"].graph.settings
    settings = {k: told[k] for k in ("start", "noise", "position_noise", "attitude_noise", "gravity")}
    for name, method in (("ukf", unscented()), ("ekf", extended())):
        case = by_hand[name]
        expected = simulate(case.graph, case.inputs, engine="reference")["belief"]
        built = pose.build(**clocks_of(flight.streams), **settings, method=method)
        belief = simulate(built, case.inputs, engine="reference")["output"]
        if name == "ukf" and space is INERTIAL:
            np.testing.assert_allclose(belief["mean"][:, :3], expected.position, rtol=0, atol=1e-13)
            np.testing.assert_allclose(belief["covariance"], expected.covariance, rtol=0, atol=1e-13)
        else:
            assert np.abs(belief["mean"][:, :3] - expected.position).max() < 0.06, "of noise of 0.1 m"


def test_biases_are_found():
    noise = ImuNoise(1e-3, 1e-2, 1e-4, 1e-3)
    bias = np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.15])
    n = 300
    time = np.arange(n) * 40 * MS
    force = np.array([0.0, 0.0, 9.81]) + bias[3:]
    imu = Imu(gyro=np.broadcast_to(bias[:3], (n, 3)), specific_force=np.broadcast_to(force, (n, 3)))
    pose = Pose(position=np.zeros((n, 3)), attitude=np.broadcast_to([1.0, 0.0, 0.0, 0.0], (n, 4)))
    start = INERTIAL_BIASED.gaussian(
        position=(np.zeros(3), 0.1), velocity=(np.zeros(3), 0.1), attitude=([1.0, 0.0, 0.0, 0.0], 0.1),
        gyro_bias=(np.zeros(3), 0.1), accelerometer_bias=(np.zeros(3), 0.3),
    )  # fmt: skip

    @graph
    def biased(imu: Stream[Imu], vicon: Stream[Pose]):
        """At rest."""
        seen = pose_seen(0.01, 0.01, space=INERTIAL_BIASED)
        motion = inertial_motion(noise, space=INERTIAL_BIASED)
        return filtered(motion, {seen: vicon}, control=imu, start=start)

    inputs = {"imu": Series(time, imu), "vicon": Series(time[::5], Pose(
        position=pose.position[::5], attitude=pose.attitude[::5]))}  # fmt: skip
    belief = simulate(biased.build(), inputs, engine="reference")["output"]
    np.testing.assert_allclose(belief["mean"][-1, 10:], bias, atol=0.01)


# -- what is refused -------------------------------------------------------------------------------------


def test_models_that_do_not_fit_are_refused():
    with pytest.raises(
        DeclarationError, match=r"the Kalman filter needs a model that is linear[\s\S]*extended"
    ):
        tracker.build(method=linear())
    with pytest.raises(DeclarationError, match=r"a measurement is of another state than the motion"):
        tracker.build(seen=PLACE)
    with pytest.raises(DeclarationError, match=r"the start is no belief about the state[\s\S]*mean \(4,\)"):
        point.build(start=Gaussian(mean=np.zeros(3), covariance=np.eye(3)))
    with pytest.raises(DeclarationError, match=r"what was measured does not fit[\s\S]*6 numbers"):
        tracker.build(seen=MeasurementModel(BICYCLE, lambda x, xp: x.position, noise=4.0))
    with pytest.raises(DeclarationError, match=r"a filter cannot start from what it does not measure"):
        tracker.build(start=first(PLACE, lambda fix, xp: START))
    with pytest.raises(DeclarationError, match="a measurement is linearised a whole number of times"):
        extended(iterations=0)
    with pytest.raises(DeclarationError, match=r"other parameters than a model hands it[\s\S]*\(x, a, b\)"):
        MotionModel(PENDULUM, lambda x, a, b: x)
    with pytest.raises(DeclarationError, match=r"a noise and its density go together"):
        MotionModel(PENDULUM, lambda x, w, dt, xp: x)
    with pytest.raises(DeclarationError, match=r"the matrices of a linear model do not fit together"):
        DiscreteModel(np.eye(2), np.eye(3))
    with pytest.raises(DeclarationError, match=r"the matrix of a measurement does not fit"):
        LinearMeasurement(TURNING, np.eye(2, 4), noise=1.0)
    with pytest.raises(DeclarationError, match=r"MeasurementModel.noise"):
        MeasurementModel(TURNING, lambda x, xp: x.position, noise=-1.0)


def test_a_filter_without_a_measurement_is_refused():
    @graph
    def blind(steering: Stream[Steering]):
        """Nothing is measured."""
        return filtered(CAR, {}, control=steering, start=START)

    with pytest.raises(DeclarationError, match="a filter without a measurement knows nothing"):
        blind.build()


def test_points_too_close_for_single_precision_are_refused_there():
    _, inputs = driven(1.0)
    built = tracker.build(method=unscented(SigmaPoints(alpha=1e-3)))
    with pytest.raises(LoweringError, match="alpha >= 0.1 in float32"):
        simulate(built, inputs, engine="reference", dtype="float32")


def test_angles_are_measured_around_the_circle():
    seen = MeasurementModel(
        BICYCLE,
        lambda x, xp: x.heading,
        noise=0.01,
        measured_space=StateSpace(angle()),
        read=lambda z: z.value,
    )
    start = BICYCLE.gaussian(position=((0.0, 0.0), 1.0), heading=(3.1, 0.2), speed=(0.0, 0.1))
    inputs = {
        "steering": Series([0], Steering(angle=np.zeros(1), acceleration=np.zeros(1))),
        "compass": Series([0], Value(value=np.array([-3.1]))),
    }
    for method in METHODS.values():

        @graph
        def turned(steering: Stream[Steering], compass: Stream[Value], *, method=method):
            """A compass on the other side of the cut."""
            return filtered(CAR, {seen: compass}, control=steering, start=start, method=method)

        found = simulate(turned.build(), inputs)["output"]["mean"][0, 2]
        assert abs(found) > 3.1

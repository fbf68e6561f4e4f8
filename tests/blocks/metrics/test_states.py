"""Errors over a state space: in its own terms, aligned where that was asked for, and honest."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Array, DataError, DeclarationError, Series, Signal, real
from flowgraph.blocks.filtering import StateSpace, angle, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply, rotate
from flowgraph.blocks.metrics.states import StateErrors
from flowgraph.blocks.signals import Gaussian

CAR = StateSpace(position=euclidean(2), heading=angle(), bias=euclidean(1))
BODY = StateSpace(position=euclidean(3), velocity=euclidean(3), attitude=quaternion())


class CarTruth(Signal):
    position: Array = real(2, unit="m")
    heading: Array = real(unit="rad")


class BodyTruth(Signal):
    position: Array = real(3, unit="m")
    velocity: Array = real(3, unit="m/s")
    attitude: Array = real(4)


TIME = np.arange(50) * 10**8
RNG = np.random.default_rng(4)


def beliefs(space, mean, covariance=None):
    P = np.eye(space.tangent) if covariance is None else covariance
    return Series(TIME, Gaussian(mean=mean, covariance=np.broadcast_to(P, (len(TIME), *P.shape))))


def car_truth():
    heading = np.linspace(3.0, 3.4, 50)
    place = np.stack([TIME * 1e-9, np.sin(TIME * 1e-9)], axis=1)
    return Series(TIME, CarTruth(position=place, heading=(heading + np.pi) % (2 * np.pi) - np.pi))


def test_an_angle_is_compared_across_half_a_turn_and_parts_without_truth_are_left_out():
    truth = car_truth()
    error = np.array([0.3, -0.4, 0.1, 9.0])
    true = np.column_stack([truth["position"], truth["heading"], np.zeros(50)])
    mean = CAR.plus(true, error[None, :], np)
    P = np.diag([0.09, 0.16, 0.01, 1.0])
    found = StateErrors(CAR)(beliefs(CAR, mean, P), truth, settle=0.0)
    assert found["position_rmse_m"] == pytest.approx(0.5)
    assert found["heading_rmse_deg"] == pytest.approx(np.rad2deg(0.1))
    assert found["nees_mean"] == pytest.approx(3.0)  # one deviation in each of the three that are known
    assert found["compared_ticks"] == 50
    assert not any(name.startswith("bias") for name in found)
    wide = StateErrors(CAR)(beliefs(CAR, CAR.plus(true, 3.5 * error[None, :], np), P), truth, settle=0.0)
    assert wide["position_3sigma"] == 0.0


def test_the_truth_is_interpolated_as_its_parts_move():
    truth = car_truth()
    late = beliefs(CAR, np.zeros((50, 4)))[:-1]
    between = Series(late.time + 5 * 10**7, late.values)
    apart = StateErrors(CAR).apart(between, truth)["heading"][:, 0]
    middle = np.unwrap(truth["heading"])
    middle = (middle[1:] + middle[:-1]) / 2
    np.testing.assert_allclose(np.cos(apart - middle), 1.0, atol=1e-12)  # not the mean of 3.1 and -3.1


def body_truth():
    turns = np.cumsum(RNG.normal(size=(50, 3)) * 0.1, axis=0)
    place = np.cumsum(RNG.normal(size=(50, 3)), axis=0)
    return place, RNG.normal(size=(50, 3)), np.asarray(from_rotation_vector(turns, xp=np))


@pytest.mark.parametrize(
    ("align", "turn"), [("yaw", [0.0, 0.0, 1.1]), ("se3", [0.4, -0.3, 1.1]), ("se3", [0.0, 0.0, 3.0])]
)
def test_a_moved_world_is_aligned_away(align, turn):
    p, v, q = body_truth()
    truth = Series(TIME, BodyTruth(position=p, velocity=v, attitude=q))
    R = np.asarray(from_rotation_vector(np.array(turn), xp=np))
    put = lambda x: np.asarray(rotate(np.broadcast_to(R, (50, 4)), x, xp=np))
    mean = np.concatenate(
        [put(p) + np.array([5.0, -3.0, 2.0]), put(v), np.asarray(multiply(R, q, xp=np))], axis=1
    )
    found = StateErrors(BODY, align)(beliefs(BODY, mean), truth, settle=0.0)
    assert found["position_rmse_m"] < 1e-9
    assert found["velocity_rmse_mps"] < 1e-9
    assert found["attitude_rmse_deg"] < 1e-5
    assert found["nees_mean"] < 1e-9
    as_it_is = StateErrors(BODY)(beliefs(BODY, mean), truth, settle=0.0)
    assert as_it_is["position_rmse_m"] > 3.0
    assert as_it_is["attitude_rmse_deg"] > 30.0


def test_yaw_does_not_take_a_tilt_away_and_turns_a_plane():
    p, v, q = body_truth()
    truth = Series(TIME, BodyTruth(position=p, velocity=v, attitude=q))
    R = np.asarray(from_rotation_vector(np.array([0.3, 0.0, 0.0]), xp=np))
    mean = np.concatenate([p, v, np.asarray(multiply(R, q, xp=np))], axis=1)
    assert StateErrors(BODY, "yaw")(beliefs(BODY, mean), truth)["attitude_rmse_deg"] == pytest.approx(
        np.rad2deg(0.3), abs=1e-6
    )
    flat = car_truth()
    c, s = np.cos(0.7), np.sin(0.7)
    turned = flat["position"] @ np.array([[c, s], [-s, c]])
    mean = np.column_stack([turned + 4.0, flat["heading"] + 0.7, np.zeros(50)])
    found = StateErrors(CAR, "yaw")(beliefs(CAR, mean), flat)
    assert max(found["position_rmse_m"], found["heading_rmse_deg"]) < 1e-9


def test_what_cannot_be_compared_is_refused_with_the_fix():
    with pytest.raises(DeclarationError, match="no such alignment"):
        StateErrors(CAR, "tilt")
    with pytest.raises(DeclarationError, match="parts have no names"):
        StateErrors(StateSpace(euclidean(2)))
    nowhere = StateSpace(heading=angle(), bias=euclidean(1))
    with pytest.raises(DataError, match="cannot be aligned"):
        StateErrors(nowhere, "yaw")(beliefs(nowhere, np.zeros((50, 2))), car_truth())
    other = StateSpace(position=euclidean(3))
    with pytest.raises(DataError, match="truth's position is not that of the state"):
        StateErrors(other)(beliefs(other, np.zeros((50, 3))), car_truth())
    assert StateErrors(StateSpace(depth=euclidean(1)))(beliefs(other, np.zeros((50, 3))), car_truth()) == {}


def test_what_is_drawn_has_the_band_of_the_covariance_and_the_truth_where_it_is_known():
    truth = car_truth()[:40]
    mean = np.column_stack([car_truth()["position"], car_truth()["heading"], np.zeros(50)])
    shown = StateErrors(CAR).quantities(
        beliefs(CAR, mean, np.diag([4.0, 4.0, 0.01, 1.0])), truth, TIME * 1e-9
    )
    by_name = {q.name: q for q in shown}
    assert list(by_name) == ["position 0", "position 1", "heading", "bias"]
    heading = by_name["heading"]
    assert (heading.unit, heading.turns) == ("deg", True)
    np.testing.assert_allclose(heading.deviation, np.rad2deg(0.1))
    assert heading.truth is not None
    assert np.isfinite(heading.truth[:40]).all()
    assert np.isnan(heading.truth[40:]).all()
    assert by_name["bias"].truth is None
    p, v, q = body_truth()
    body = np.concatenate([p, v, q], axis=1)
    turns = StateErrors(BODY).quantities(beliefs(BODY, body), None, TIME * 1e-9)[-3:]
    assert [t.name for t in turns] == ["attitude, roll", "attitude, pitch", "attitude, yaw"]
    assert np.abs([t.values for t in turns]).max() <= 180.0

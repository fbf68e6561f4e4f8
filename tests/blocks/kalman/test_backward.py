"""The smoother as a graph over the tape in reverse: what the host computes, in every engine and method."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, Series, lower, simulate
from flowgraph.blocks.filtering import (
    cubature,
    extended,
    first,
    information,
    linear,
    particles,
    rao_blackwellized,
    square_root,
    unscented,
)
from flowgraph.blocks.geometry import StateSpace, euclidean, quaternion
from flowgraph.blocks.kalman import (
    backwards,
    forwards,
    rauch_tung_striebel,
    sizes_of,
    smooth,
    smoother,
    steps_of,
)
from flowgraph.blocks.models.tracking import TURNING
from flowgraph.blocks.signals import CrossCovariance, Gaussian
from tests.blocks.filtering.turning import GPS, built, driven, missed

LEAVES = ("mean", "covariance", "lag_one")


@pytest.mark.parametrize("method", [extended(), square_root(), unscented(), cubature()])
def test_every_gaussian_method_is_smoothed(method):
    seen, truth = driven(120)
    result = simulate(built(method), {"position": seen})
    whole, lagged = smooth(result, TURNING), smooth(result, TURNING, lag=0.5)
    assert missed(whole, truth) < 0.65 * missed(result["posterior"], truth)
    assert missed(whole, truth) < missed(lagged, truth) < missed(result["posterior"], truth)
    shrunk = result["posterior"]["covariance"] - whole["covariance"]
    assert np.linalg.eigvalsh(shrunk).min() > -1e-9


def test_forms_of_one_filter_are_smoothed_alike():
    seen, _ = driven(60)
    plain, *others = (
        smooth(simulate(built(method), {"position": seen}), TURNING)
        for method in (extended(), square_root(), information())
    )
    for other in others:
        for leaf in LEAVES:
            np.testing.assert_allclose(plain[leaf], other[leaf], atol=1e-9)


def curved(n: int) -> tuple[StateSpace, Series, Series, Series]:
    """Any priors, posteriors and crosses over an attitude and a vector, with large corrections."""
    space, rng = StateSpace(quaternion(), euclidean(2)), np.random.default_rng(0)
    root = rng.normal(size=(n, 5, 5)) * 0.2
    P = root @ root.mT + 0.1 * np.eye(5)
    F = np.eye(5) + 0.2 * rng.normal(size=(n, 5, 5))
    prior_P = F[1:] @ P[:-1] @ F[1:].mT + 0.05 * np.eye(5)
    prior_P = np.concatenate([P[:1], prior_P])
    mean = np.asarray(space.plus(space.rest, 0.7 * rng.normal(size=(n, 5)), np))
    ahead = np.asarray(space.plus(mean, 0.4 * rng.normal(size=(n, 5)), np))
    time = np.cumsum(rng.integers(1, 9, n)) * 1_000_000
    cross = np.concatenate([P[:1], P[:-1] @ F[1:].mT])
    return (
        space,
        Series(time, Gaussian(mean=ahead, covariance=prior_P)),
        Series(time, Gaussian(mean=mean, covariance=P)),
        Series(time, CrossCovariance(covariance=cross)),
    )


def test_the_graph_is_the_smoother_in_every_engine():
    space, prior, posterior, cross = curved(25)
    host = rauch_tung_striebel(prior, posterior, cross, space=space)
    graph = smoother.build(space=space, sizes=sizes_of(space))
    tape = backwards(prior, posterior, cross)
    assert tape.time[0] == prior.time[0]
    assert (np.diff(tape.time) > 0).all()
    for engine, tolerance in (("python", 1e-14), ("reference", 1e-14), ("c", 1e-9), ("xla", 1e-9)):
        found = forwards(simulate(graph, {"step": tape}, engine=engine)["smoothed"])
        np.testing.assert_array_equal(found.time, host.time)
        for leaf in LEAVES:
            np.testing.assert_allclose(found[leaf], host[leaf], atol=tolerance, err_msg=f"{engine} {leaf}")
    assert "go_back" in {stage.path for stage in lower(graph).stages}


def test_a_filter_that_waits_for_its_first_message_is_smoothed_from_there():
    seen, truth = driven(60)
    believe = lambda z, xp: Gaussian(
        mean=xp.concat([z.position, xp.asarray([3.0, 0.0, 0.2])]),
        covariance=xp.asarray(np.diag([0.04, 0.04, 1.0, 1.0, 0.1])),
    )
    result = simulate(built(extended(), start=first(GPS, believe)), {"position": seen})
    assert missed(smooth(result, TURNING), truth) < 0.7 * missed(result["posterior"], truth)


def test_what_cannot_be_smoothed_says_so():
    seen, _ = driven(5)
    with pytest.raises(DeclarationError, match="no smoother"):
        built(rao_blackwellized(20, linear="position"))
    cloud = simulate(built(particles(20)), {"position": seen})
    with pytest.raises(DataError, match=r"did not collect what a smoother needs[\s\S]*smoothing=True"):
        steps_of(cloud)
    with pytest.raises(DeclarationError, match="needs a model that is linear"):
        built(linear())

"""What is proven of sizes holds on every flight, and gives formats a bit that a margin would take."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pytest

from flowgraph import Series, Stream, block, delay, graph, periodic, real
from flowgraph.engines.fixed.abreast import Recorded
from flowgraph.engines.fixed.bounds import proven_sizes
from flowgraph.engines.fixed.counts import names_of
from flowgraph.engines.fixed.ranges import Sizes
from flowgraph.engines.options import RunOptions
from flowgraph.engines.subject import LoweredGraph
from flowgraph.pipeline.formats import Formats
from flowgraph.pipeline.plain import plain
from flowgraph.recorder.random import seed_words
from tests.engines.fixed.test_fixed import sizes_of
from tests.graphs.library import library_case

Four = Annotated[Any, real(4)]


@block
def weighed(log_weight: Four, z: Four, *, xp) -> tuple[Four, Four, Four]:
    """Weights that add up to one, what has their norm, and something that has no bound."""
    x = log_weight + z
    largest = xp.max(x)
    log_weight = x - (largest + xp.log(xp.sum(xp.exp(x - largest))))
    weight = xp.exp(log_weight)
    unit = z / xp.sqrt(xp.sum(z * z))
    return log_weight, weight * xp.cos(z) + 0.5 * unit, weight * z


@graph
def clouds(z: Stream[Four]):
    """A register whose bound survives a tick."""
    log_weight = delay(np.full(4, -np.log(4.0)), name="log_weight")
    after, bounded, free = weighed(log_weight, z)
    log_weight.feed(after)
    return {"bounded": bounded, "free": free}


def _of(built_graph):
    pipeline = plain(LoweredGraph(built_graph).pipeline)
    return pipeline, {
        names_of(pipeline)[n]: x for n, x in proven_sizes(pipeline).items() if n in names_of(pipeline)
    }


def test_weights_norms_and_sines_are_bounded_and_inputs_are_not():
    pipeline, found = _of(clouds.build(z=periodic("10ms")))
    by_op: dict[str, list[float]] = {}
    for name, size in found.items():
        by_op.setdefault(name.split()[1].rstrip(","), []).append(float(size.max()))
    assert by_op["exp"] == [1.0, 1.0]
    assert by_op["cos"] == by_op["divide"] == [1.0]
    assert by_op["register"] == [np.inf]  # the logarithm of a weight has no least
    assert pipeline.inputs[0].leaves[0].value not in proven_sizes(pipeline)
    leaves = {port.name: port.leaves[0].value for port in pipeline.outputs}
    sizes = proven_sizes(pipeline)
    assert sizes[leaves["bounded"]].tolist() == [1.5] * 4
    assert np.isinf(sizes[leaves["free"]]).all()


def test_what_is_proven_takes_no_margin_and_says_so():
    time = np.arange(200, dtype=np.int64) * 10_000_000
    inputs = {"z": Series(time, np.random.default_rng(0).normal(size=(200, 4)))}
    sizes = sizes_of(clouds.build(z=periodic("10ms")), inputs)
    formats = sizes.formats(24, 4.0)
    cos = next(i.out for i in sizes.pipeline.instructions if i.op == "cos")
    assert cos in formats.proven
    assert formats.fractions[cos].max() == 22  # of which one is before the point, and with a margin three
    given = sizes.pipeline.inputs[0].leaves[0].value
    assert given not in formats.proven
    assert Formats.from_json(formats.to_json()).proven == formats.proven


def test_a_constant_that_varies_among_flights_proves_nothing():
    @graph
    def scaled(z: Stream[Four], *, by: float):
        return {"y": turned(z, by=by)}

    @block
    def turned(z: Four, *, by: float, xp) -> Four:
        return by * xp.cos(z)

    ready = [LoweredGraph(scaled.build(z=periodic("10ms"), by=by)) for by in (0.25, 0.5)]
    inputs = {"z": Series(np.arange(20, dtype=np.int64) * 10_000_000, np.ones((20, 4)))}
    sizes = Sizes(plain(ready[0].pipeline))
    given = [
        Recorded(plain(r.pipeline), r.tape(inputs), r.start(RunOptions()).cells, seed_words(0)) for r in ready
    ]
    product = next(i.out for i in sizes.pipeline.instructions if i.op == "multiply")
    sizes.play(given[:1])
    assert product in sizes.formats(24, 8.0).proven
    sizes.play(given[1:])
    assert product not in sizes.formats(24, 8.0).proven


@pytest.mark.parametrize("name", ["kalman", "marg", "ins_eskf", "rbpf_indoor", "particle"])
def test_no_flight_goes_beyond_what_is_proven(name):
    case = library_case(name, 0.5)
    sizes = sizes_of(case.graph, case.inputs)
    proven = proven_sizes(sizes.pipeline)
    bounded = 0
    for n, seen in (*sizes.largest.items(), *sizes.untaken.items()):
        if n in proven and np.isfinite(proven[n]).any():
            bounded += 1
            assert (
                seen <= np.broadcast_to(proven[n], np.broadcast_shapes(proven[n].shape, seen.shape)) + 1e-12
            ).all()
    assert bounded or name == "kalman"

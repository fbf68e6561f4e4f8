"""The loop over a recording: the same to the bit as tick by tick, and what is left to be called."""

from __future__ import annotations

import linecache
import sys
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    FifoOverflowError,
    Result,
    Run,
    Scalar,
    Stream,
    apply,
    block,
    graph,
    latest,
    scan,
    simulate,
)
from flowgraph.blocks.flights import simulated
from flowgraph.data.registry import find_graph
from flowgraph.engines.python import run as runs
from flowgraph.engines.python.loop import Loop
from tests.oracle.build import built, inputs_of
from tests.oracle.specs import drawn
from tests.support import same, same_state, scalars


def loops(built: Any) -> list[Loop]:
    """The loops that were written for a graph."""
    return [known for known in built.plans.values() if isinstance(known, Loop)]


def tick_by_tick(monkeypatch: pytest.MonkeyPatch, work: Any) -> Any:
    with monkeypatch.context() as patch:
        patch.setattr(runs, "loop", lambda *_: None)
        return work()


def full_or_result(drawn_graph: Any, inputs: Any) -> Result | tuple[str, int | None]:
    try:
        return simulate(drawn_graph, inputs)
    except FifoOverflowError as error:
        return str(error), error.time


def test_random_graphs_are_the_same_tick_by_tick(monkeypatch):
    written = 0
    for seed in range(40):
        spec = drawn(seed)
        made, inputs = built(spec), inputs_of(spec)
        ours = full_or_result(made, inputs)
        other = tick_by_tick(monkeypatch, lambda made=made, inputs=inputs: full_or_result(made, inputs))
        if isinstance(ours, Result):
            same(ours, other)
            written += bool(loops(made))
        else:
            assert ours == other
    assert written > 15


@pytest.mark.parametrize("name", ["ins_eskf", "ekf", "ukf", "kalman", "rbpf_indoor"])
def test_filters_are_the_same_tick_by_tick(monkeypatch, name):
    flight = simulated.load(settings={"duration": 1.0})
    settings = {"particles": 20} if name == "rbpf_indoor" else {}
    case = find_graph(name).case(flight, **settings)
    ours = simulate(case.graph, case.inputs, seed=3)
    same(ours, tick_by_tick(monkeypatch, lambda: simulate(case.graph, case.inputs, seed=3)))
    assert loops(case.graph)


def test_whole_numbers_wrap_around_and_reals_overflow_as_numpy_has_them():
    top = 2**31 - 2

    @graph
    def g(x: Stream[Scalar]):
        count = scan(x, lambda n, x, xp: n + xp.astype(x > 0.0, xp.int32), init=np.int32(top))
        return {"count": count, "grown": scan(x, lambda y, x: y * x, init=1e300)}

    made = g.build()
    found = simulate(made, {"x": scalars([0, 1, 2], [1e5, 1e9, 1e9])}, diverged="count")
    assert found["count"]["value"].tolist() == [top + 1, -(2**31), -(2**31) + 1]
    assert found["count"]["value"].dtype == np.int32
    assert found["grown"]["value"].tolist() == [1e300 * 1e5, np.inf, np.inf]
    assert "% 4294967296" in loops(made)[0].plan.source  # the count is written out


def test_a_quotient_by_zero_is_infinite():
    @graph
    def g(x: Stream[Scalar]):
        return {"out": x.map(lambda x: 1.0 / x)}

    with np.errstate(divide="ignore"):
        found = simulate(g.build(), {"x": scalars([0, 1], [0.0, 4.0])}, diverged="count")
    assert found["out"]["value"].tolist() == [np.inf, 0.25]


def test_a_register_that_is_read_and_then_written_gives_what_it_held():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        before = x.delay(-1.0)
        return {
            "before": before.at(x),
            "pair": apply(lambda a, b: a - b, x, before),
            "held": latest(x, init=7.0).at(y),
        }

    found = simulate(g.build(), {"x": scalars([0, 2, 4]), "y": scalars([0, 1, 4])})
    assert found["before"]["value"].tolist() == [-1.0, 1.0, 2.0]
    assert found["pair"]["value"].tolist() == [2.0, 1.0, 1.0]
    assert found["held"]["value"].tolist() == [1.0, 1.0, 3.0]


def test_a_step_that_does_more_than_compute_is_called(capsys):
    @block
    def telling(x):
        print("here")
        return x + 1.0

    @block
    def choosing(x: Any):
        more: float = 2.0 if isinstance(x, np.generic) else 3.0
        return x + more

    def quiet(x):
        return x * 2.0

    @graph
    def g(x: Stream[Scalar]):
        return {"told": telling(x), "chosen": choosing(x), "quiet": apply(lambda x: quiet(x) + 1.0, x)}

    made = g.build()
    capsys.readouterr()
    found = simulate(made, {"x": scalars([0, 1])})
    assert capsys.readouterr().out == "here\nhere\n"
    assert found["chosen"]["value"].tolist() == [3.0, 4.0]
    source = loops(made)[0].plan.source
    called = {n.path for n in made.nodes if hasattr(n, "block") and f"f{made.nodes.index(n)}(" in source}
    assert called == {"telling", "choosing"}


@block
def drawn_walk(x: Scalar, seen: Scalar, *, draw, xp) -> Scalar:
    """Numbers of any shape, some of which only one arm of a selection needs."""
    plain = xp.sum(draw.normal("row", (30,)) @ xp.linalg.cholesky(4.0 * xp.eye(30)))
    rare = xp.sum(xp.exp(draw.uniform("rare", (40, 2)) * seen))
    moved = xp.where(seen > 3.0, xp.stack([rare, rare]), xp.stack([x, plain]))
    return xp.sum(moved) + draw.uniform("one", ())


@graph
def walks(seen: Stream[Scalar], other: Stream[Scalar]):
    here = drawn_walk(seen, seen)
    return {"here": here, "far": drawn_walk(latest(other, init=1.0, at=seen), seen, name="far", draws="far")}


def test_draws_are_the_same_tick_by_tick(monkeypatch):
    inputs = {
        "seen": (np.arange(0, 700, 2), np.sin(np.arange(350.0)) * 4.0),
        "other": (np.arange(0, 700, 7), np.arange(100.0)),
    }
    work = lambda seed: simulate(walks.build(), inputs, seed=seed)
    found = [work(seed) for seed in (3, 4)]
    assert (found[0]["here"].value != found[1]["here"].value).all()
    same(found[0], tick_by_tick(monkeypatch, lambda: work(3)))
    same(found[1], tick_by_tick(monkeypatch, lambda: work(4)))
    made = walks.build()
    run = Run(made, inputs, seed=3)
    for _ in range(5):
        run.step()
    assert len(loops(made)) == 1
    run.state = Run(made, inputs, seed=4).state  # another seed: nothing that was drawn before is used
    changed = [f["here"].value[part] for f, part in zip(found, (slice(4), slice(4, None)), strict=True)]
    np.testing.assert_array_equal(run.to_end().result()["here"].value, np.concatenate(changed))


def test_what_is_known_and_what_is_not_taken_is_not_computed():
    @block
    def either(x: Scalar, *, xp) -> Scalar:
        a = xp.linalg.solve(xp.eye(3) * 2.0, xp.ones((3,)))
        b = a * xp.sin(x)
        return xp.sum(xp.where(x > 1.0, xp.cos(b), xp.tan(b)))

    @block
    def again(x: Scalar, *, xp) -> Scalar:
        return xp.sin(x) * 2.0

    @graph
    def both(x: Stream[Scalar]):
        return {"a": either(x), "b": again(x)}

    made = both.build()
    at = np.array([0.5, 1.5, 1.0])
    found = simulate(made, {"x": (np.arange(3), at)})
    b = 0.5 * np.sin(at)
    sums = [np.sum(f(np.full(3, v))) for f, v in zip((np.tan, np.cos, np.tan), b, strict=True)]
    np.testing.assert_array_equal(found["a"].value, sums)
    np.testing.assert_array_equal(found["b"].value, np.sin(at) * 2.0)
    lines = [line.strip() for line in loops(made)[0].plan.source.splitlines()]
    assert not any("o_solve" in line for line in lines)
    assert sum("o_sin" in line for line in lines) == 1
    cos, tan = (next(k for k, line in enumerate(lines) if f"= o_{f}(" in line) for f in ("cos", "tan"))
    assert lines[cos - 1].startswith("if ")
    assert lines[tan - 1] == "else:"


def test_an_error_leaves_the_registers_of_the_last_good_tick():
    @block
    def tender(x: Any):
        if isinstance(x, np.generic) and float(x) > 2.0:  # type: ignore[arg-type]
            raise RuntimeError("too much")
        return x

    @graph
    def g(x: Stream[Scalar]):
        return {"sum": scan(tender(x), lambda s, x: s + x, init=0.0)}

    made = g.build()
    run = Run(made, {"x": scalars([0, 10, 20, 30])})
    with pytest.raises(RuntimeError) as error:
        run.to_end()
    assert any("tender" in note and "t = 20 ns" in note for note in error.value.__notes__)
    assert (run.ticks, run.time) == (2, 10)
    assert run.result()["sum"]["value"].tolist() == [1.0, 3.0]
    (path,) = [p for p in run.state["registers"] if "scan" in p]
    assert run.state["registers"][path] == 3.0
    assert run.state["sources"]["x"] == 10


class _Signal(KeyboardInterrupt):
    pass


@pytest.mark.parametrize("loop", [True, False])
def test_what_breaks_in_anywhere_leaves_the_last_whole_tick(monkeypatch, loop):
    """Ctrl-C is heard after a call: after each one in turn, of the loop and of what counts and packs."""

    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        kept = {"x": x, "y": y, "sum": scan(x, lambda s, x: 0.5 * s + x, init=0.0)}
        return kept | {"some": x.filter(lambda x: x > 0.0), "before": x.delay(7.0).at(x)}

    monkeypatch.setattr(runs, "_PACKED", 3)
    monkeypatch.setattr(runs, "_BATCH", 5)
    if not loop:
        monkeypatch.setattr(runs, "loop", lambda *_: None)
    made = g.build()
    inputs = {"x": scalars(range(0, 80, 10), [1, -1, 2, 3, -4, 5, 6, -7]), "y": scalars([0, 30, 60, 75])}
    expected = simulate(made, inputs)
    inside = {"react", "_has_gone", "_account", "_pack", "_collected", "_stamps", "_forget"}

    def broken_off_after(calls: int) -> Run | None:
        left = [calls]

        def heard(frame: Any, event: str, _: Any) -> None:
            if event == "c_return" and frame.f_code.co_name in inside:
                left[0] -= 1
                if left[0] < 0:
                    raise _Signal

        run = Run(made, inputs)
        sys.setprofile(heard)
        try:
            run.to_end()
        except _Signal:
            return run
        finally:
            sys.setprofile(None)
        return None

    places = 0
    while (run := broken_off_after(places)) is not None:
        places += 1
        rest = {n: s[int((s.time <= run.time).sum()) :] for n, s in inputs.items()}
        first, after = run.result(), Run(made, rest, state=run.state).to_end().result()
        assert first.ticks + after.ticks == expected.ticks
        for name, whole in expected.series.items():
            for field in ("time", "value"):
                parts = [getattr(r[name], field) for r in (first, after)]
                np.testing.assert_array_equal(np.concatenate(parts), getattr(whole, field), err_msg=name)
        same_state(after.state, expected.state)
    assert places > 50


def test_a_graph_built_like_one_before_shows_its_lines_too():
    """Its code is there already; what a traceback shows may have been cleared since."""

    @graph
    def g(x: Stream[Scalar]):
        return {"sum": scan(x, lambda s, x: s + x, init=0.0)}

    found = []
    for _ in range(2):
        made = g.build()
        simulate(made, {"x": scalars([0, 10])})
        (plan,) = [known.plan for known in loops(made)]
        found.append("".join(linecache.getlines(plan.code.co_filename)))
        linecache.clearcache()
    assert found == [plan.source, plan.source]


def test_single_steps_and_the_rest_are_one_run():
    @graph
    def g(x: Stream[Scalar]):
        return {"sum": scan(x, lambda s, x: s + x, init=0.0)}

    run = Run(g.build(), {"x": scalars(range(6))})
    assert run.step()
    assert run.step()
    assert run.drain()["sum"]["value"].tolist() == [1.0, 3.0]
    run.to_end(most=3)
    assert run.drain()["sum"]["value"].tolist() == [6.0, 10.0, 15.0]
    assert run.step()
    assert not run.step()
    assert run.result()["sum"]["value"].tolist() == [21.0]


def test_a_debugger_meets_the_lines_of_a_block():
    lines = []

    def step(x):
        return x + 1.0

    @graph
    def g(x: Stream[Scalar]):
        return {"out": apply(step, x)}

    made, before = g.build(), sys.gettrace()
    sys.settrace(lambda frame, *_: lines.append(frame.f_code.co_name))
    try:
        simulate(made, {"x": scalars([0, 1])})
    finally:
        sys.settrace(before)
    assert lines.count("step") == 2

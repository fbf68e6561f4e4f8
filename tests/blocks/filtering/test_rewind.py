"""A filter over late events equals itself over sorted ones: at the time of each, and whatever the order."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from flowgraph import (
    DeclarationError,
    LoweringError,
    Pipeline,
    Run,
    Scalar,
    Series,
    Stream,
    UnknownNameError,
    aperiodic,
    apply,
    block,
    clocks_of,
    delay,
    delayed,
    graph,
    latest,
    load_flight,
    lower,
    match,
    periodic,
    simulate,
)
from flowgraph.blocks.filtering import (
    MeasurementModel,
    MotionModel,
    StateSpace,
    euclidean,
    extended,
    filtered,
    particles,
    rewind,
    unscented,
)
from flowgraph.graphs.benches.late import difference, late, late_eskf
from flowgraph.graphs.ins_eskf import ins_eskf
from tests.recordings import DATA, recordings
from tests.support import ENGINES, all_engines, same

MS = 1_000_000


@block
def corrected(
    prior: Scalar, z: Scalar | None, y: Scalar | None, *, gain: float
) -> tuple[Scalar, Scalar | None]:
    """A correction by whatever there is, and the innovation of z."""
    after = prior if y is None else prior + 0.5 * gain * (y - prior)
    if z is None:
        return after, None
    return after + gain * (z - after), z - after


@graph
def leaky(u: Stream[Scalar], z: Stream[Scalar], y: Stream[Scalar] | None = None, *, gain: float = 0.3):
    """A filter with all that a filter has: a delay, a held control, dt, an optional input, a counter."""
    ticks = u | z if y is None else u | z | y
    x = delay(1.0, name="x")
    prior = apply(
        lambda x, u, *, dt, xp: x * xp.exp(-0.5 * dt) + u * dt,
        x,
        latest(u, init=0.0),
        at=ticks,
        name="predict",
    )
    after, innovation = corrected(prior, z, y, gain=gain)
    x.feed(after)
    return {"x": after, "innovation": innovation, "third": z.every(3)}


@graph
def rewound(
    u: Stream[Scalar], z: Stream[Scalar], y: Stream[Scalar] | None = None, *,
    late: tuple[str, ...] = ("z",), max_lag: str = "500ms", size: int = 150, older: str = "refuse",
):  # fmt: skip
    given = {"u": u, "z": z, **({"y": y} if y is not None else {})}
    found = rewind(leaky, given, late=late, max_lag=max_lag, size=size, older=older)
    return {
        **{f"{n}_now": s for n, s in found.now.items()},
        **{f"{n}_then": s for n, s in found.then.items()},
        "stamp": found.stamp,
    }


RNG = np.random.default_rng(7)
U = Series(np.arange(300) * 5 * MS, RNG.normal(size=300), name="u")
Z = Series(np.arange(20) * 50 * MS + 1_234_567, RNG.normal(size=20), name="z")
Y = Series(np.arange(30) * 33 * MS + 777, RNG.normal(size=30), name="y")
SORTED = simulate(leaky.build(), {"u": U, "z": Z})
COUNTS = ("rewind/late.late_applied", "rewind/late.late_refused", "rewind/late.late_fused")


def counts(result):
    return tuple(result.stats[name] for name in COUNTS)


def at(series, stamps):
    """The values of a series of scalars at these of its times."""
    place = np.searchsorted(series.time, stamps)
    assert (series.time[place] == stamps).all()
    return series.value[place]


def test_what_was_late_is_at_its_own_time_as_if_it_had_come_in_order():
    found = simulate(rewound.build(), {"u": U, "z": delayed(Z, "135ms")})
    stamps = found["stamp"].value
    assert stamps.tolist() == Z.time.tolist()
    assert (found["stamp"].time - stamps == 135 * MS).all()
    np.testing.assert_array_equal(found["x_then"].value, at(SORTED["x"], stamps))
    np.testing.assert_array_equal(found["innovation_then"].value, SORTED["innovation"].value)
    np.testing.assert_array_equal(found["third_then"].value, SORTED["third"].value)
    assert found["x_now"].time.tolist() == U.time.tolist()
    assert counts(found) == (20, 0, 0)


@pytest.mark.parametrize("older", ["refuse", pytest.param("fuse", marks=pytest.mark.slow)])
def test_engines_agree_where_some_are_too_late_and_the_ring_is_short(older):
    mixed = delayed(Z, np.where(np.arange(20) % 4 == 0, 200 * MS, 30 * MS))
    built = rewound.build(max_lag="100ms", older=older, size=18)
    found = all_engines(built, {"u": U, "z": mixed})
    assert counts(found) == ((15, 5, 0) if older == "refuse" else (15, 0, 5))


def test_the_belief_of_now_is_the_sorted_one_predicted_from_the_last_that_came():
    wait = 135 * MS
    found = simulate(rewound.build(), {"u": U, "z": delayed(Z, wait)})
    for t, x in list(zip(found["x_now"].time.tolist(), found["x_now"].value, strict=True))[::23]:
        known = Z[Z.time <= t - wait]
        some = simulate(leaky.build(), {"u": U[U.time <= t], "z": known})
        assert x == some["x"].value[-1]


@pytest.mark.parametrize("seed", [1, 2])
def test_any_order_gives_what_the_right_order_gives(seed):
    mixed = delayed(Z, ("0ms", "480ms"), seed=seed)
    assert (np.diff(mixed.stamp) < 0).any()
    found = simulate(rewound.build(), {"u": U, "z": mixed})
    assert found["x_now"].value[-1] == SORTED["x"].value[-1]
    assert counts(found)[1:] == (0, 0)


def test_several_streams_may_be_late_and_the_control_too():
    on_time = simulate(leaky.build(y=aperiodic()), {"u": U, "z": Z, "y": Y})
    inputs = {
        "u": delayed(U, ("0ms", "60ms"), seed=1),
        "z": delayed(Z, ("0ms", "200ms"), seed=2),
        "y": delayed(Y, ("100ms", "300ms"), seed=3),
    }
    built = rewound.build(y=aperiodic(), late=("u", "z", "y"), size=220)
    found = simulate(built, inputs)
    assert found["x_now"].value[-1] == on_time["x"].value[-1]
    assert found["x_now"].time.tolist() == sorted({t for s in inputs.values() for t in s.time.tolist()})


def test_events_of_one_time_share_a_tick_however_they_come():
    z = Series(U.time[10:200:10], np.arange(19.0), name="z")
    on_time = simulate(leaky.build(), {"u": U, "z": z})
    found = simulate(rewound.build(), {"u": U, "z": delayed(z, "50ms")})
    assert found["x_now"].value[-1] == on_time["x"].value[-1]
    fresh = simulate(rewound.build(), {"u": U, "z": z})
    np.testing.assert_array_equal(fresh["x_now"].value, on_time["x"].value)
    assert counts(fresh) == (0, 0, 0)


def test_what_is_older_than_the_lag_is_refused_and_counted():
    mixed = delayed(Z, np.where(np.arange(20) % 4 == 0, 200 * MS, 30 * MS))
    found = simulate(rewound.build(max_lag="100ms"), {"u": U, "z": mixed})
    kept = Z[np.arange(20) % 4 != 0]
    assert found["x_now"].value[-1] == simulate(leaky.build(), {"u": U, "z": kept})["x"].value[-1]
    assert counts(found) == (15, 5, 0)
    assert len(found["x_then"]) == 15


def test_or_fused_at_the_oldest_time_that_can_be():
    mixed = delayed(Z[3:4], "200ms")
    found = simulate(rewound.build(max_lag="100ms", older="fuse"), {"u": U, "z": mixed})
    there = Series(mixed.time - 100 * MS, mixed.value, name="z")
    assert found["x_now"].value[-1] == simulate(leaky.build(), {"u": U, "z": there})["x"].value[-1]
    assert found["stamp"].value.tolist() == there.time.tolist()
    assert counts(found) == (0, 0, 1)


def test_a_ring_that_is_too_short_refuses_what_it_cannot_reach():
    mixed = delayed(Z, np.where(np.arange(20) == 9, 80 * MS, 20 * MS))
    found = simulate(rewound.build(size=12), {"u": U, "z": mixed})
    kept = Z[np.arange(20) != 9]
    assert counts(found) == (19, 1, 0)
    assert found["x_now"].value[-1] == simulate(leaky.build(), {"u": U, "z": kept})["x"].value[-1]
    fused = simulate(rewound.build(size=12, older="fuse"), {"u": U, "z": mixed})
    assert counts(fused) == (19, 0, 1)


def test_a_second_event_of_a_source_at_one_time_is_refused():
    twice = Series(Z.time[:2] + 40 * MS, Z.value[:2], stamp=[Z.time[0]] * 2, name="z")
    found = simulate(rewound.build(), {"u": U, "z": twice})
    assert counts(found) == (1, 1, 0)
    assert found["x_now"].value[-1] == simulate(leaky.build(), {"u": U, "z": Z[:1]})["x"].value[-1]


def test_more_patterns_than_have_cases_of_their_own_go_by_flags():
    @graph
    def four(a: Stream[Scalar], b: Stream[Scalar], c: Stream[Scalar], d: Stream[Scalar]):
        x = delay(0.0, name="x")
        more = [latest(s, init=0.0) for s in (a, b, c, d)]
        new = apply(lambda x, a, b, c, d: 0.9 * x + a - b + c * d, x, *more, at=a | b | c | d, name="mix")
        x.feed(new)
        return new

    @graph
    def over(a: Stream[Scalar], b: Stream[Scalar], c: Stream[Scalar], d: Stream[Scalar]):
        streams = {"a": a, "b": b, "c": c, "d": d}
        return rewind(four, streams, late=("c", "d"), max_lag="300ms", size=120).now["output"]

    inputs = {"a": U[:100], "b": Y, "c": Z, "d": Series(Y.time + 99, Y.value, name="d")}
    mixed = {**inputs, "c": delayed(Z, ("0ms", "200ms")), "d": delayed(inputs["d"], "90ms")}
    for engine in ("python", "c"):
        found = simulate(over.build(), mixed, engine=engine)
        end = int(found.output.time[-1])
        known = {n: s[s.time <= end] for n, s in mixed.items()}
        known = {n: s[np.argsort(s.stamp)] for n, s in known.items()}
        on_time = simulate(four.build(), {n: Series(s.stamp, s.value, name=n) for n, s in known.items()})
        assert abs(found.output.value[-1] - on_time.output.value[-1]) < 1e-12


@pytest.mark.parametrize("method", [extended(), unscented()])
def test_any_filter_of_a_model_can_be_rewound(method):
    space = StateSpace(place=euclidean(1), speed=euclidean(1))

    def drive(x, u, w, dt, xp):
        return space.plus(x, velocity=(x.speed, u[..., None] + w), dt=dt)

    motion = MotionModel(space, drive, density=np.diag([0.04]))
    gps = MeasurementModel(space, lambda x, v, xp: x.place + v, noise=np.diag([0.01]))
    begin = space.gaussian(place=(0.0, 1.0), speed=(0.0, 1.0))

    @graph
    def tracker(push: Stream[Scalar], fix: Stream[Scalar], *, method):
        z = fix.map(lambda v, *, xp: xp.reshape(v, (1,)))
        return filtered(motion, {gps: z}, control=push, start=begin, method=method)

    @graph
    def tardy(push: Stream[Scalar], fix: Stream[Scalar], *, method):
        streams = {"push": push, "fix": fix}
        return rewind(tracker, streams, late=("fix",), max_lag="200ms", size=60, method=method).then["output"]

    on_time = simulate(tracker.build(method=method), {"push": U, "fix": Z})
    found = simulate(tardy.build(method=method), {"push": U, "fix": delayed(Z, "135ms")}, engine="reference")
    place = np.searchsorted(on_time.output.time, Z.time)
    np.testing.assert_allclose(found.output["mean"], on_time.output["mean"][place], atol=1e-9)
    np.testing.assert_allclose(found.output["covariance"], on_time.output["covariance"][place], atol=1e-9)


def test_a_rewound_run_goes_on_from_its_state_to_the_same_bits():
    inputs = {"u": U, "z": delayed(Z, ("0ms", "300ms"))}
    built = rewound.build()
    whole = simulate(built, inputs)
    cut = 700 * MS
    first = simulate(built, {n: s[s.time <= cut] for n, s in inputs.items()})
    rest = {n: s[s.time > cut] for n, s in inputs.items()}
    second = Run(built, rest, state=first.state).to_end().result()
    assert second["x_now"].value.tolist() == whole["x_now"].value[-len(second["x_now"]) :].tolist()
    same_state = second.state["registers"]["rewind/history"]
    np.testing.assert_array_equal(same_state, whole.state["registers"]["rewind/history"])


def test_live_events_are_rewound(tmp_path):
    run = Run(rewound.build())
    events = [(int(t), "u", v, int(t)) for t, v in zip(U.time[:100], U.value, strict=False)]
    tardy = delayed(Z, "135ms")
    events += [(int(t), "z", v, int(s)) for t, v, s in zip(tardy.time, tardy.value, tardy.stamp, strict=True)]
    for t, name, value, stamp in sorted(e for e in events if e[0] <= U.time[99]):
        run.push(t, **{name: value}, **({"z.stamp": stamp} if name == "z" else {}))
    end = U.time[99]
    recorded = simulate(rewound.build(), {"u": U[:100], "z": tardy[tardy.time <= end]})
    assert run.result()["x_now"].value.tolist() == recorded["x_now"].value.tolist()


def test_the_description_holds_the_loop_and_plays_without_the_graph(tmp_path):
    inputs = {"u": U, "z": delayed(Z, ("0ms", "300ms"))}
    built = rewound.build()
    lower(built).save(tmp_path / "late")
    read = Pipeline.load(tmp_path / "late")
    assert read.to_json() == lower(built).to_json()
    wanted = simulate(built, inputs, engine="reference")
    for engine in ("reference", "c"):
        same(read.run(inputs, engine=engine), wanted, exact=engine == "reference")


@pytest.mark.parametrize("engine", ["reference", "c"])
def test_single_precision_keeps_the_times_whole(engine):
    """Stamps in ns of today: a float32 would round them to minutes."""
    day = 1_700_000_000 * 10**9
    moved = {"u": Series(U.time + day, U.value), "z": Series(Z.time + day, Z.value)}
    mixed = {**moved, "z": delayed(moved["z"], ("0ms", "300ms"))}
    found = simulate(rewound.build(), mixed, engine=engine, dtype="float32")
    assert sorted(found["stamp"].value.tolist()) == moved["z"].time.tolist()
    rounded = len(U) * float(np.finfo(np.float32).eps)  # at most, of numbers near one
    np.testing.assert_allclose(found["x_now"].value[-1], SORTED["x"].value[-1], rtol=0.0, atol=rounded)


def test_the_size_follows_from_declared_rates():
    @graph
    def sized(u: Stream[Scalar], z: Stream[Scalar]):
        return rewind(leaky, {"u": u, "z": z}, late=("z",), max_lag="200ms").now["x"]

    built = sized.build(u=periodic("5ms"), z=aperiodic(max_rate=25))
    (ring,) = [r for _, r in built.registers if r.path.endswith("ring")]
    assert ring.initial[0].shape[0] == 2 + 41 + 6
    with pytest.raises(DeclarationError, match="needs the size of its history"):
        sized.build(u=periodic("5ms"))


def test_what_cannot_be_rewound_is_refused_by_name():
    @graph
    def random(u: Stream[Scalar]):
        return apply(lambda v, *, draw: v + draw.normal("n", ()), u, name="shaken")

    @graph
    def queued(u: Stream[Scalar], z: Stream[Scalar]):
        return match(u, z, tolerance="2ms", size=4, name="pair").map(lambda p: p[0])

    @block(host=True)
    def shown(v: Scalar) -> Scalar:
        return v

    @graph
    def host(u: Stream[Scalar]):
        return shown(u) + 1.0

    @graph
    def made(u: Stream[Scalar], z: Stream[Scalar], *, inner):
        streams = {n: s for n, s in (("u", u), ("z", z)) if n in inner.parameters[0]}
        found = rewind(inner, streams, late=("u",), max_lag="1s", size=9)
        return {"x": found.now["output"], "z": z.map(lambda v: v)}

    for inner, said in (
        (random, "random numbers"),
        (queued, "queue that can be full"),
        (host, "for the host"),
    ):
        with pytest.raises(LoweringError, match=said):
            made.build(inner=inner)


@pytest.mark.parametrize(
    ("given", "kind", "said"),
    [
        ({"late": ()}, DeclarationError, "nothing that comes late is named"),
        ({"late": ("w",)}, UnknownNameError, "no source is called 'w'"),
        ({"older": "drop"}, DeclarationError, "no way with late events"),
        ({"size": 2}, DeclarationError, "needs the size of its history"),
        ({"max_lag": "-1ms"}, DeclarationError, "max_lag is not understood"),
    ],
)
def test_settings_that_cannot_be_are_refused(given, kind, said):
    with pytest.raises(kind, match=said):
        rewound.build(**given)


def test_a_late_stream_has_to_be_a_source():
    @graph
    def derived(u: Stream[Scalar], z: Stream[Scalar]):
        return rewind(leaky, {"u": u, "z": z.map(lambda v: v)}, late=("z",), max_lag="1s", size=9).now["x"]

    with pytest.raises(DeclarationError, match="only what arrives has stamps"):
        derived.build()


def test_particles_say_why_they_cannot():
    space = StateSpace(place=euclidean(1))
    motion = MotionModel(
        space, lambda x, u, w, dt, xp: space.plus(x, velocity=(w,), dt=dt), density=np.diag([0.1])
    )
    gps = MeasurementModel(space, lambda x, v, xp: x.place + v, noise=np.diag([0.1]))

    @graph
    def cloud(fix: Stream[Scalar]):
        z = fix.map(lambda v, *, xp: xp.reshape(v, (1,)))
        return filtered(motion, {gps: z}, start=space.gaussian(place=(0.0, 1.0)), method=particles(50))

    @graph
    def over(fix: Stream[Scalar]):
        return rewind(cloud, {"fix": fix}, late=("fix",), max_lag="1s", size=9).now["output"]

    with pytest.raises(LoweringError, match="draws random numbers"):
        over.build()


@pytest.mark.parametrize("engine", ["python", pytest.param("c", marks=pytest.mark.slow)])
def test_ins_eskf_with_a_late_motion_capture(engine):
    flight = load_flight("sim", seed=3, settings={"duration": "3", "vicon.rate": "10"})
    case = ins_eskf.case(flight)
    assert isinstance(case.inputs, Mapping)
    given = dict(case.inputs)
    fix = given["position"]
    tardy = delayed(fix, ("50ms", "300ms"), seed=1)
    inputs = {**{n: s for n, s in given.items() if n != "attitude"}, "position": tardy}
    plain = {n: s for n, s in given.items() if n != "attitude"}
    settings = dict(case.graph.settings)
    on_time = simulate(ins_eskf.build(**clocks_of(plain), **settings), plain, engine=engine)
    built = late_eskf.build(**clocks_of(inputs), settings=settings, max_lag="300ms", size=80)
    found = simulate(built, inputs, engine=engine)
    assert difference(found, on_time, tardy) < 1e-9
    assert found.stats["rewind/late.late_applied"] == len(tardy)


@pytest.mark.slow
def test_mh_01_with_a_late_leica():
    """The live belief is the best that can be known then; at its own time each fix is as in order."""
    recordings("euroc")
    rows = {(r["policy"], r["engine"]): r for r in late(data=str(DATA), duration=40.0, engines="c").rows}
    best = rows["foreseen", "python"]["position_rmse_m"]
    assert rows["sorted", "c"]["position_rmse_m"] < 0.75 * best
    assert rows["on arrival", "c"]["position_rmse_m"] > 5.0 * best
    assert rows["rewind", "c"]["position_rmse_m"] <= 1.02 * best
    for policy in ("rewind", "random"):
        assert rows[policy, "c"]["difference"] < 1e-9
        assert rows[policy, "c"]["refused"] == 0
    assert set(ENGINES) >= {e for _, e in rows}

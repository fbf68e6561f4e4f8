"""The symbolic array: every operation has NumPy's shape, kind and values, and the rest is refused by line."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import (
    Array,
    DeclarationError,
    LoweringError,
    Scalar,
    Signal,
    Stream,
    block,
    graph,
    integer,
    lower,
    real,
    simulate,
)
from flowgraph.engines.xla.namespace import JaxNamespace
from flowgraph.recorder.namespaces import NUMPY as PLAIN
from flowgraph.recorder.ops import OPS, Spec, bound_attrs, broadcast, promote
from flowgraph.recorder.symbolic import Symbolic
from flowgraph.recorder.symbolic_namespace import namespace
from flowgraph.recorder.trace import Trace
from flowgraph.types import DTYPES, dtype_name

RANDOM = np.random.default_rng(7)
V = RANDOM.uniform(0.1, 0.9, 3)
W = RANDOM.uniform(0.1, 0.9, 3)
M = RANDOM.uniform(-2.0, 2.0, (3, 3))
N = RANDOM.uniform(-2.0, 2.0, (2, 3, 3))
P = M @ M.T + 3.0 * np.eye(3)
I = np.array([5, -3, 2], np.int32)
J = np.array([2, 4, 3], np.int32)
L = np.array([7, -8, 9], np.int64)
U = np.array([1, 2, 3], np.uint32)
B = np.array([True, False, True])
C = np.array([True, True, False])

# name -> [(function of xp and arrays, arrays)]
CASES: dict[str, list[tuple[Callable[..., Any], tuple[Any, ...]]]] = {
    **{
        name: [
            (lambda xp, a, b, n=name: getattr(xp, n)(a, b), pair) for pair in ((V, W), (M, V), (I, J), (L, I))
        ]
        for name in ("add", "subtract", "multiply", "maximum", "minimum", "remainder", "floor_divide")
    },
    "pow": [
        (lambda xp, a, b: xp.pow(a, b), (V, W)),
        (lambda xp, a, b: xp.pow(a, b), (I, J)),
        (lambda xp, a: a**2, (M,)),
        (lambda xp, a: 2.0**a, (V,)),
    ],
    **{
        name: [(lambda xp, a, n=name: getattr(xp, n)(a), (x,)) for x in (M, I, L)]
        for name in ("negative", "abs", "sign", "square", "positive")
    },
    **{
        name: [(lambda xp, a, b, n=name: getattr(xp, n)(a, b), pair) for pair in ((V, W), (M, V), (I, J))]
        for name in ("divide", "atan2", "hypot", "copysign")
    },
    **{
        name: [(lambda xp, a, n=name: getattr(xp, n)(a), (V,))]
        for name in [
            "sqrt",
            "exp",
            "expm1",
            "log",
            "log1p",
            "log2",
            "sin",
            "cos",
            "tan",
            "asin",
            "acos",
            "atan",
            "sinh",
            "cosh",
            "tanh",
            "unnormalized_sinc",
        ]
    },
    **{
        name: [(lambda xp, a, n=name: getattr(xp, n)(a), (x,)) for x in (M, I)]
        for name in ("floor", "ceil", "round", "trunc")
    },
    **{
        name: [
            (lambda xp, a, b, n=name: getattr(xp, n)(a, b), pair) for pair in ((V, W), (I, J), (I, V), (V, V))
        ]
        for name in ("equal", "not_equal", "less", "less_equal", "greater", "greater_equal")
    },
    **{
        name: [(lambda xp, a, b, n=name: getattr(xp, n)(a, b), (B, C))]
        for name in ("logical_and", "logical_or", "logical_xor")
    },
    "logical_not": [(lambda xp, a: xp.logical_not(a), (B,))],
    **{
        name: [(lambda xp, a, n=name: getattr(xp, n)(a), (np.array([1.0, np.nan, np.inf]),))]
        for name in ("isfinite", "isnan")
    },
    **{
        name: [
            (lambda xp, a, b, n=name: getattr(xp, n)(a, b), pair) for pair in ((I, J), (B, C), (L, I), (U, U))
        ]
        for name in ("bitwise_and", "bitwise_or", "bitwise_xor")
    },
    "bitwise_invert": [(lambda xp, a: ~a, (x,)) for x in (I, B, U)],
    **{
        name: [(lambda xp, a, b, n=name: getattr(xp, n)(a, b), (J, J))]
        for name in ("bitwise_left_shift", "bitwise_right_shift")
    },
    **{
        name: [
            *((lambda xp, a, n=name: getattr(xp, n)(a), (x,)) for x in (M, I, L, B, U)),
            (lambda xp, a, n=name: getattr(xp, n)(a, axis=-1), (N,)),
            (lambda xp, a, n=name: getattr(xp, n)(a, axis=(0, 2), keepdims=True), (N,)),
        ]
        for name in ("sum", "prod")
    },
    **{
        name: [
            *((lambda xp, a, n=name: getattr(xp, n)(a), (x,)) for x in (M, I)),
            (lambda xp, a, n=name: getattr(xp, n)(a, axis=1), (N,)),
        ]
        for name in ("max", "min", "mean")
    },
    **{
        name: [(lambda xp, a, n=name: getattr(xp, n)(a, axis=0), (np.stack([B, C]),))]
        for name in ("any", "all")
    },
    **{
        name: [
            (lambda xp, a, n=name: getattr(xp, n)(a, axis=-1), (N,)),
            (lambda xp, a, n=name: getattr(xp, n)(a), (V,)),
        ]
        for name in ("argmax", "argmin")
    },
    "sort": [(lambda xp, a: xp.sort(a, axis=-1), (x,)) for x in (M, I)],
    "argsort": [
        (lambda xp, a: xp.argsort(a, axis=-1), (M,)),
        (lambda xp, a: xp.argsort(a), (np.array([1.0, 0.0] * 20),)),  # ties keep their order
    ],
    "flip": [(lambda xp, a: xp.flip(a, axis=0), (M,)), (lambda xp, a: a[::-1], (M,))],
    "roll": [(lambda xp, a: xp.roll(a, shift=1, axis=0), (M,)), (lambda xp, a: xp.roll(a, -1), (V,))],
    "cumulative_sum": [
        (lambda xp, a: xp.cumulative_sum(a, axis=0), (M,)),
        *((lambda xp, a: xp.cumulative_sum(a), (x,)) for x in (V, I, B, U)),
    ],
    "concat": [
        (lambda xp, a, b: xp.concat([a, b], axis=-1), (M, P)),
        (lambda xp, a, b: xp.concat((a, b, a)), (I, V)),
    ],
    "stack": [
        (lambda xp, a, b: xp.stack([a, b], axis=-1), (V, W)),
        (lambda xp, a, b: xp.stack([a, b, 1.0 + a]), (V, I)),
    ],
    "matmul": [
        (lambda xp, a, b: a @ b, pair) for pair in ((M, P), (M, V), (V, M), (V, W), (N, M), (N, V), (I, J))
    ],
    "matrix_transpose": [
        (lambda xp, a: a.mT, (N,)),
        (lambda xp, a: xp.matrix_transpose(a), (M,)),
        (lambda xp, a: a.T, (M,)),
    ],
    "cholesky": [
        (lambda xp, a: xp.linalg.cholesky(a), (P,)),
        (lambda xp, a: xp.linalg.cholesky(a), (np.stack([P, 2 * P]),)),
    ],
    "solve": [
        (lambda xp, a, b: xp.linalg.solve(a, b), pair)
        for pair in ((P, V), (P, M), (np.stack([P, P]), N), (P, N))
    ],
    "cross": [
        (lambda xp, a, b: xp.linalg.cross(a, b), (V, W)),
        (lambda xp, a, b: xp.linalg.cross(a, b), (M, V)),
    ],
    "vecdot": [
        (lambda xp, a, b: xp.linalg.vecdot(a, b), (V, W)),
        (lambda xp, a, b: xp.linalg.vecdot(a, b), (M, V)),
    ],
    "outer": [(lambda xp, a, b: xp.linalg.outer(a, b), (V, W))],
    "searchsorted": [
        (lambda xp, a, b: xp.searchsorted(a, b), (np.array([0.0, 0.3, 0.6, 0.6]), V)),
        (
            lambda xp, a, b: xp.searchsorted(a, b, side="right"),
            (np.array([0.0, 0.6, 0.6]), np.array([0.6, 2.0])),
        ),
    ],
    "tril": [(lambda xp, a: xp.tril(a), (N,)), (lambda xp, a: xp.tril(a, k=-1), (M,))],
    "triu": [(lambda xp, a: xp.triu(a), (N,)), (lambda xp, a: xp.triu(a, k=1), (M,))],
    "where": [
        (lambda xp, c, a, b: xp.where(c, a, b), (B, V, W)),
        (lambda xp, c, a, b: xp.where(c, a, b), (B, I, V)),
        (lambda xp, c: xp.where(c, 2, 3), (B,)),
        (lambda xp, c: xp.where(c, 2.0, 3), (B,)),
        (lambda xp, c, a: xp.where(c, a, 0), (B, V)),
        (lambda xp, c, a: xp.where(c, True, a), (B, C)),
        (lambda xp, x: xp.where(x > 0.5, 1, 0), (V,)),
    ],
    "permute_dims": [(lambda xp, a: xp.permute_dims(a, (2, 0, 1)), (N,))],
    "reshape": [
        (lambda xp, a: xp.reshape(a, (3, -1)), (N,)),
        (lambda xp, a: xp.reshape(a, (18,)), (N,)),
        (lambda xp, a: xp.expand_dims(a, axis=1), (M,)),
        (lambda xp, a: xp.expand_dims(a, axis=-1), (M,)),
        (lambda xp, a: xp.squeeze(a[:, :1], axis=1), (M,)),
        (lambda xp, a: a[:, None, ...], (M,)),
    ],
    "broadcast_to": [(lambda xp, a: xp.broadcast_to(a, (4, 3)), (V,))],
    "getitem": [
        (lambda xp, a: a[0], (N,)),
        (lambda xp, a: a[..., -1], (N,)),
        (lambda xp, a: a[1, :, 0:2], (N,)),
        (lambda xp, a: a[:, ::2, None], (N,)),
        (lambda xp, a: a[0, 0, 0], (N,)),
        (lambda xp, a: a[..., None, 1:], (N,)),
    ],
    "take": [
        (lambda xp, a, i: xp.take(a, i, axis=0), (M, np.array([2, 0, 2, 1]))),
        (lambda xp, a, i: xp.take(a, i, axis=-1), (M, np.array([0, 1], np.int32))),
        (lambda xp, a, i: a[i], (M, np.array([[0, 1], [2, 2]]))),
    ],
    "astype": [
        (lambda xp, a: xp.astype(a, xp.int32), (M,)),
        (lambda xp, a: xp.astype(a, xp.float64), (I,)),
        (lambda xp, a: xp.astype(a, xp.bool), (I,)),
        (lambda xp, a: xp.astype(a, xp.int64), (B,)),
        (lambda xp, a: xp.asarray(a, dtype=xp.uint32), (J,)),
    ],
    "clip, zeros_like and friends": [
        (lambda xp, a: xp.clip(a, min=-0.5, max=0.5), (M,)),
        (lambda xp, a: xp.clip(a, max=0), (I,)),
        (lambda xp, a: a + xp.zeros_like(a) + xp.ones_like(a), (M,)),
        (lambda xp, a: a + xp.eye(3) + xp.zeros((3, 3)) + xp.full((3,), 2.0) + xp.arange(3), (M,)),
        (lambda xp, a: a * xp.pi + xp.linspace(0.0, 1.0, 3), (V,)),
    ],
    "operators with numbers": [
        (lambda xp, a: 1 - a, (V,)),
        (lambda xp, a: 2 * a + 1, (I,)),
        (lambda xp, a: 2.5 * a, (I,)),
        (lambda xp, a: (a > 0) * 2, (V,)),
        (lambda xp, a: (a > 0.5) + 1, (V,)),
        (lambda xp, a: (a > 0.5) & True, (V,)),
        (lambda xp, a: a // 2 + a % 2 - (-a), (I,)),
        (lambda xp, a: a / 2, (I,)),
        (lambda xp, a: np.array([1.0, 2.0, 3.0]) * a, (V,)),
        (lambda xp, a: np.float64(3.0) / a, (V,)),
        (lambda xp, a: a << 1, (I,)),
        (lambda xp, a: abs(-a) + (+a), (M,)),
        (lambda xp, a, b: a + b, (I, U)),
        (lambda xp, a, b: a * b, (B, V)),
        (lambda xp, a, b: a + b, (B, I)),
    ],
    "unpacking": [(lambda xp, a: sum(x * x for x in a), (V,))],
}
PAIRS = [(name, k) for name, cases in CASES.items() for k in range(len(cases))]
MACHINERY = {"float32_bits", "materialise", "replay"}  # for random numbers and engines, not for blocks


def record(function: Callable[..., Any], arrays: tuple[Any, ...]) -> tuple[Trace, list[int], Any]:
    trace = Trace()
    inputs = [trace.input(Spec(np.shape(a), dtype_name(a))) for a in arrays]
    return trace, [i.number for i in inputs], function(namespace, *inputs)


def play(trace: Trace, numbers: list[int], arrays: tuple[Any, ...], out: Symbolic, xp: Any) -> Any:
    env: dict[int, Any] = {n: xp.asarray(a) for n, a in trace.constants.items()}
    env.update(zip(numbers, (xp.asarray(a) for a in arrays), strict=True))
    for i in trace.instructions:
        env[i.out] = OPS[i.op].run(xp, *(env[a] for a in i.args), **bound_attrs(i.op, i.attrs, np.float64))
        assert Spec(tuple(env[i.out].shape), dtype_name(env[i.out])) == i.spec, f"{i.op} {i.attrs}"
    return env[out.number]


def test_every_operation_has_a_case():
    assert set(OPS) - MACHINERY <= set(CASES)


@pytest.mark.parametrize(("name", "k"), PAIRS)
def test_recorded_shape_kind_and_values_are_those_of_numpy(name, k):
    function, arrays = CASES[name][k]
    actual = function(PLAIN, *arrays)
    trace, numbers, out = record(function, arrays)
    assert isinstance(out, Symbolic)
    assert out.shape == np.shape(actual)
    assert out.dtype_name == dtype_name(actual)
    assert out.dtype == DTYPES[out.dtype_name]
    np.testing.assert_array_equal(play(trace, numbers, arrays, out, PLAIN), actual)
    if name in OPS:
        assert name in {i.op for i in trace.instructions} or name in ("flip", "roll", "getitem", "reshape")
    assert all(i.line.startswith(f"{__name__}:") for i in trace.instructions)


@pytest.mark.parametrize(("name", "k"), PAIRS)
def test_played_in_jax_the_values_are_the_same(name, k):
    jax = pytest.importorskip("jax")
    function, arrays = CASES[name][k]
    trace, numbers, out = record(function, arrays)
    with jax.enable_x64(True):
        found = np.asarray(play(trace, numbers, arrays, out, JaxNamespace(jax)))
    np.testing.assert_allclose(found, function(PLAIN, *arrays), rtol=1e-12, atol=1e-14)


@given(st.lists(st.lists(st.integers(1, 3), max_size=3), min_size=1, max_size=3))
def test_broadcast_is_numpys(shapes):
    found = [tuple(s) for s in shapes]
    try:
        expected = np.broadcast_shapes(*found)
    except ValueError:
        with pytest.raises(ValueError, match="do not broadcast"):
            broadcast(*found)
    else:
        assert broadcast(*found) == expected


@given(st.lists(st.sampled_from(list(DTYPES)), min_size=1, max_size=3))
def test_promotion_is_numpys(kinds):
    if not {"uint64"} < set(kinds) or not {"int32", "int64"} & set(kinds):
        assert np.result_type(*(DTYPES[k] for k in kinds)) == DTYPES[promote(*kinds)]


@settings(deadline=None)
@given(
    st.lists(st.integers(1, 4), min_size=1, max_size=3),
    st.data(),
)
def test_basic_indexing_is_numpys(shape, data):
    array = np.arange(float(np.prod(shape))).reshape(shape)
    edge = st.none() | st.integers(-5, 5)
    entry = lambda n: st.one_of(
        st.integers(-n, n - 1), st.builds(slice, edge, edge, st.sampled_from([None, 1, 2, -1, -2]))
    )
    count = data.draw(st.integers(0, len(shape)))
    index: list[Any] = [data.draw(entry(n)) for n in shape[:count]]
    for extra in (None, Ellipsis):
        if data.draw(st.booleans()):
            index.insert(data.draw(st.integers(0, len(index))) if extra is None else len(index), extra)
    expected = array[tuple(index)]
    trace, numbers, out = record(lambda xp, a: a[tuple(index)], (array,))
    assert out.shape == expected.shape
    np.testing.assert_array_equal(play(trace, numbers, (array,), out, PLAIN), expected)


def test_equal_constants_share_one_value():
    trace, _, _ = record(lambda xp, a: (a + 2.0) * 2.0 + xp.eye(3) @ (xp.eye(3) @ a), (V,))
    assert len(trace.constants) == 2


def test_constants_alone_are_computed_at_once():
    trace, _, out = record(lambda xp, a: a + xp.sqrt(xp.asarray(4.0)) * xp.sum(xp.ones(3)), (V,))
    assert [i.op for i in trace.instructions] == ["add"]
    assert out.shape == (3,)


# -- refusals: each is one line of a block, and the message names it -----------------------------------


def place(x):
    return x


def branch(x):
    return x if x > 0.0 else -x


def loop(x):
    while x > 1.0:
        x = x / 2.0
    return x


def both(x):
    return x > 0.0 and x < 1.0


def smaller(x):
    return min(x, 1.0)


def number(x):
    return float(x)


def whole(x):
    return int(x)


def written(v):
    v[0] = 1.0
    return v


def augmented(v):
    v += 1.0
    return v


def numpy_function(v):
    return np.linalg.norm(v)


def ufunc(v):
    return np.sin(v)


def method(v):
    return v.sum()


def masked(v):
    return v[v > 0.0]


def unknown(v, *, xp):
    return xp.fft(v)


def unknown_linalg(v, *, xp):
    return xp.linalg.svd(v)


def unpacked(x):
    a, _ = x
    return a


def sized(v, n, *, xp):
    return xp.zeros((n,))


def sliced(v, n):
    return v[:n]


def listed(v, *, xp):
    return xp.asarray([v[0], v[1]])


def shapes(v):
    return v + np.zeros(4)


def crowded(v):
    return v[0, 0]


def far(v):
    return v[7]


def fixed(v, *, xp):
    return xp.astype(v, xp.float32)


def bits(x):
    return x & 1


def truths(v):
    return (v > 0.0) - (v > 1.0)


def running(v, *, xp):
    return xp.cumulative_sum(xp.reshape(v, (3, 1)))


def descending(v, *, xp):
    return xp.sort(v, descending=True)


def unequal(v, *, xp):
    return xp.linalg.vecdot(v, v[:1])


def fancy(v):
    return v[[0, 1]]


def high(v):
    return v.T


REFUSALS = [
    (branch, ["Python branch on a traced value", "xp.where(condition, a, b)", "filter"]),
    (loop, ["Python branch on a traced value"]),
    (both, ["Python branch on a traced value", "and"]),
    (smaller, ["Python branch on a traced value", "min()"]),
    (number, ["Python number from a traced value", "float(x)"]),
    (whole, ["Python number from a traced value", "xp.astype"]),
    (written, ["in-place write", "xp.concat"]),
    (augmented, ["in-place write", "x = x + y"]),
    (numpy_function, ["NumPy function on a traced value", "xp.f(x)"]),
    (method, ["no attribute 'sum'", "xp.sum(x)"]),
    (masked, ["depends on data", "xp.where(mask, x, ...)"]),
    (unknown, ["xp.fft is not among the operations", "matmul", "host block"]),
    (unknown_linalg, ["xp.linalg.svd is not among the operations"]),
    (unpacked, ["iteration over a scalar"]),
    (sized, ["Python index from a traced value"]),
    (sliced, ["a slice with a traced bound"]),
    (listed, ["an array from a list of traced values", "xp.stack"]),
    (shapes, ["add: shapes (3,), (4,) do not broadcast"]),
    (crowded, ["too many indices for shape (3,)"]),
    (far, ["index 7 is outside an axis of size 3"]),
    (fixed, ["a fixed float32", "dtype=x.dtype"]),
    (bits, ["bitwise_and of real numbers", "integers"]),
    (truths, ["subtract: truth values are no numbers", "xp.astype"]),
    (running, ["cumulative_sum without an axis"]),
    (descending, ["cannot be traced", "descending"]),
    (unequal, ["vecdot of (3,) and (1,)"]),
    (fancy, ["this index is not supported", "xp.take"]),
    (high, [".T of other than two axes", ".mT"]),
]


@pytest.mark.parametrize(("step", "words"), REFUSALS, ids=lambda v: getattr(v, "__name__", ""))
def test_what_a_pipeline_cannot_hold_is_refused_by_line(step, words):
    arrays = {"x": real(), "v": real(3), "n": integer()}
    ports = [p for p in inspect.signature(step).parameters if p != "xp"]

    @graph
    def g(x: Stream[Scalar], v: Stream[real(3)], n: Stream[integer()]):  # type: ignore[valid-type]
        given = {"x": x, "v": v, "n": n}
        clock = given[ports[0]]
        held = [given[p] if p == ports[0] else given[p].delay(np.int32(0)) for p in ports]
        for unused in arrays:
            given[unused].map(place)
        return block(step)(*held, at=clock)

    with pytest.raises(LoweringError) as error:
        g.build()
    first = step.__code__.co_firstlineno
    lines = range(first, first + len(inspect.getsource(step).splitlines()))
    named = str(error.value.path).rsplit(f"{__name__}:", 1)
    assert len(named) == 2, error.value.path
    assert int(named[1].rstrip(")")) in lines
    assert step.__name__ in str(error.value.path)
    for word in words:
        assert word in str(error.value)


def test_numpys_own_functions_are_refused_though_they_give_up_before_asking():
    @graph
    def g(v: Stream[real(3)]):  # type: ignore[valid-type]
        return v.map(ufunc)

    with pytest.raises(LoweringError, match=rf"ufunc \({__name__}:\d+\)") as error:
        g.build()
    assert "functions of xp" in str(error.value.fix)


def test_a_step_that_cannot_be_traced_still_runs_in_python_where_its_output_is_annotated():
    @block
    def rectified(x: Scalar) -> Scalar:
        return x if x > 0.0 else -x

    @graph
    def g(x: Stream[Scalar]):
        return rectified(x)

    built = g.build()
    assert simulate(built, {"x": ([0, 1], np.array([-1.0, 2.0]))}).output.value.tolist() == [1.0, 2.0]
    with pytest.raises(LoweringError, match="rectified.*Python branch on a traced value"):
        lower(built)


def test_values_of_another_step_are_refused():
    kept: list[Any] = []

    @block
    def keep(x):
        kept.append(x)
        return x

    @block
    def use(x):
        return x + kept[0]

    @graph
    def g(x: Stream[Scalar]):
        return use(keep(x))

    with pytest.raises(DeclarationError, match="the step writes what outlives it") as error:
        g.build()
    assert error.value.line == f"{__name__}:{keep.step.__code__.co_firstlineno + 2}"


def test_a_signal_passes_through_a_step_leaf_by_leaf():
    class Two(Signal):
        a: Array = real(3)
        b: Array = real()

    @block
    def swap(s: Two) -> Two:
        return s.replace(b=2.0 * s.b)

    @graph
    def g(s: Stream[Two]):
        return swap(s)

    assert lower(g.build()).totals()["instructions"] == 1

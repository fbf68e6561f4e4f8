"""Large arrays that are known, in C, and memory that large arrays share."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Scalar, Series, Stream, aperiodic, block, graph, lower, simulate
from flowgraph.engines.c.constants import WRITTEN, start_lines, table_text, without_repeats
from flowgraph.engines.c.memory import Memory, _packed
from flowgraph.engines.c.nodes import Buffer
from flowgraph.engines.c.source import generate
from flowgraph.recorder.ops import Spec
from tests.engines.c.support import STRICT, ran, replays, written

N = WRITTEN + 5
rng = np.random.default_rng(3)
CLOUD = np.stack([rng.normal(size=N), np.full(N, 0.25), np.arange(N) // 2000 * 1.5])
WEIGHTS = np.concatenate([rng.normal(size=(1, N)), np.full((1, N), -0.0), np.arange(N)[None] * 1.0])


@block
def walk(cloud, x: Scalar, *, xp) -> tuple[Scalar, Scalar]:
    """State: (3, N). Moves it, and gives the weighted sum."""
    weights = xp.asarray(WEIGHTS)
    moved = cloud + weights * x
    return moved, xp.sum(moved * moved)


@walk.init
def _(x):
    return CLOUD


@graph
def walking(x: Stream[Scalar]):
    return walk(x)


def test_what_repeats_is_kept_once():
    for array, size in (
        (np.full((3, N), 2.0), 1),
        (np.repeat(rng.normal(size=(2, 3, 1)), N, axis=2), 6),
        (np.repeat(rng.normal(size=(1, N)), 5, axis=0), N),
        (rng.normal(size=(2, N)), 2 * N),
        (np.where(np.arange(N) % 2, 0.0, -0.0), N),
        (np.full(N, np.nan), 1),
        (np.zeros((0, N)), 0),
    ):
        kept, steps = without_repeats(array)
        assert kept.size == size
        strides = [s * kept.itemsize for s in steps]
        seen = np.lib.stride_tricks.as_strided(np.ascontiguousarray(kept), array.shape, strides)
        assert seen.tobytes() == np.ascontiguousarray(array).tobytes()


@pytest.mark.parametrize("dtype", ["real", "float", "bool", "int32", "uint32", "int64", "uint64"])
def test_tables_hold_their_numbers_to_the_bit(tmp_path, dtype):
    real = "float" if dtype == "float" else "double"
    spec = Spec((N,), "real" if dtype == "float" else dtype)
    if spec.dtype == "real":
        array = np.concatenate([rng.normal(size=N - 4), [np.nan, np.inf, -0.0, 1e-300]])
        kept = array.astype(np.float32 if dtype == "float" else np.float64)
    else:
        kept = array = (rng.integers(0, 2**63, N) * 3).astype(dtype)
    program = f"""#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
{table_text("k7", array, spec, real)}
int main(void) {{ return fwrite(k7, sizeof k7[0], {N}, stdout) != {N}; }}
"""
    (tmp_path / "k.c").write_text(program)
    done = ran("cc", *STRICT, "-o", "k", "k.c", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = ran("sh", "-c", "./k > out", cwd=tmp_path)
    assert done.returncode == 0
    assert (tmp_path / "out").read_bytes() == kept.tobytes()


def test_registers_begin_by_stretches_or_from_a_table():
    tables: list[np.ndarray] = []

    def table(array: np.ndarray) -> str:
        tables.append(array)
        return "k0"

    def lines(array: np.ndarray) -> list[str]:
        return start_lines("s->x", array, Spec(array.shape, "real"), "double", table)

    assert lines(np.array(2.0)) == ["s->x = 2.0;"]
    assert lines(np.zeros((0, 3))) == []
    assert lines(np.array([1.0, 2.0])) == ["s->x[0] = 1.0;", "s->x[1] = 2.0;"]
    assert lines(np.ones(3)) == ["for (int32_t i = 0; i < 3; i++) s->x[i] = 1.0;"]
    rows = lines(np.repeat([[1.0], [np.nan]], N, axis=1))
    assert rows == [
        f"for (int32_t i = 0; i < {N}; i++) s->x[i] = 1.0;",
        f"for (int32_t i = {N}; i < {2 * N}; i++) s->x[i] = NAN;",
    ]
    assert not tables
    assert lines(CLOUD) == [f"for (int32_t i = 0; i < {3 * N}; i++) s->x[i] = k0[i];"]
    assert len(tables) == 1


@pytest.mark.parametrize("engine", ["c", "reference"])
def test_a_large_cloud_is_the_same_in_c(engine):
    built, given = walking.build(x=aperiodic()), {"x": Series(np.arange(3) * 10, [0.5, -1.0, 2.0])}
    right = simulate(built, given, engine="python").output.value
    np.testing.assert_allclose(simulate(built, given, engine=engine).output.value, right, rtol=1e-12)


def test_a_large_cloud_is_the_same_in_a_program(tmp_path):
    built = walking.build(x=aperiodic())
    program = written(built, tmp_path)
    done = replays(program, "0,x,0.5\n10,x,-1\n")
    right = simulate(built, {"x": Series(np.array([0, 10]), [0.5, -1.0])}, engine="python").output.value
    found = [float(line.split(",")[2]) for line in done.stdout.splitlines()]
    np.testing.assert_allclose(found, right, rtol=1e-12)


def test_how_registers_begin_is_not_in_the_text_of_the_engine():
    """The engine fills them: of a million particles the text would be the larger part."""
    pipeline = lower(walking.build(x=aperiodic()))
    inside, alone = (generate(pipeline, alone=alone).source for alone in (False, True))
    assert "walking_reset" not in inside
    assert len(alone) - len(inside) > 3 * N * 8


def test_arrays_share_memory_only_one_after_the_other():
    for _ in range(50):
        spans = {}
        for _ in range(30):
            first = int(rng.integers(0, 8))
            buffer = Buffer("", "real", int(rng.integers(1, 3000)), "work")
            spans[buffer] = (first, first + int(rng.integers(0, 4)))
        places = _packed(list(spans), spans)
        for a, at in places.items():
            for b, other in places.items():
                together = spans[a][0] <= spans[b][1] and spans[b][0] <= spans[a][1]
                if a is not b and together:
                    assert at + a.size <= other or other + b.size <= at


def test_memory_is_what_the_reaction_that_needs_most_needs():
    memory = Memory("double", {"real": "double", "int32": "int32_t"}.__getitem__)
    early, late, whole, small, other = (
        Buffer("", dtype, size, "work")
        for dtype, size in (("real", 1000), ("real", 900), ("real", 500), ("real", 4), ("int32", 2000))
    )
    spans = {early: (0, 1), late: (2, 3), whole: (0, 3), small: (0, 0), other: (1, 1)}
    names, local = memory.placed(spans)
    assert names[early] == names[late] == "s->fg_work_real"
    assert names[whole] == "(s->fg_work_real + 1008)"
    assert (names[small], local) == ("w0", ["    double w0[4];"])
    assert names[other] == "s->fg_work_int32"
    memory.placed({early: (0, 0)}, "choice_")
    assert memory.members() == [
        ("real", "fg_work_choice_real", 1000),
        ("int32", "fg_work_int32", 2000),
        ("real", "fg_work_real", 1508),
    ]

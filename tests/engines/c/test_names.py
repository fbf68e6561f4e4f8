"""Names that meet words of C, of its headers, of Make or of the generator: the same graph, in every scope."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from flowgraph import DeclarationError, Pipeline, Scalar, Stream, delay, graph, lower, simulate
from flowgraph.engines.c import generate, write_c, write_events
from flowgraph.engines.c.names import names_of
from flowgraph.engines.c.syntax import KEYWORDS
from flowgraph.pipeline.pipeline import Port
from tests.engines.c.support import STRICT, built, ran
from tests.support import scalars

WORDS = (
    "state", "reset", "react", "time", "seed", "present", "made", "s", "overflow", "not_finite", "replay",
    "loop", "fg_loop", "Makefile", "makefile", "main", "math", "string", "stdio", "int8", "uint64", "int64_t",
    "uint64_t", "size_t", "t", "m", "int", "double", "register", "restrict", "class", "namespace", "printf",
    "memcpy", "exp", "sqrt", "NULL", "NAN", "INFINITY", "EOF", "errno", "stdin", "linux", "I", "INT64_MAX",
    "M_PI", "w0", "i0", "k0", "v1", "fg", "fg_exp", "flowgraph", "in", "out", "in_a", "line", "now", "broken",
    "file", "row", "field", "number", "tick", "next", "clean", "all", "CC", "work_real_0", "work", "no_x",
    "restrict_", "größe", "a b", "9", "%s%n", "??/", "../../x", "\n", "x" * 3000,
)  # fmt: skip


@graph
def base(a: Stream[Scalar]):
    held = delay(0.5, name="held")
    total = a + held
    held.feed(total)
    return {"total": total, "late": held.at(a)}


DATA = [1.0, 2.0, 4.0]
WANTED = [1.5, 3.5, 7.5]


def called(word: str) -> Pipeline:
    """The graph with this name in all places that a user can name."""
    clean = lower(base.build())

    def port(p: Port) -> Port:
        return replace(p, name=word, leaves=tuple(replace(x, name=word) for x in p.leaves))

    registers = tuple(
        replace(r, path=word, cells=tuple(replace(c, name=word) for c in r.cells)) for r in clean.registers
    )
    first, second = clean.outputs
    inputs = tuple(port(p) for p in clean.inputs)
    return replace(clean, name=word, inputs=inputs, outputs=(port(first), second), registers=registers)


@pytest.mark.parametrize("word", WORDS, ids=lambda w: repr(w)[:20])
def test_a_word_in_every_place_is_the_same_filter(word, tmp_path):
    """Strictly, as C99, with the replay beside it."""
    pipeline = called(word)
    write_c(pipeline, tmp_path)
    write_events(pipeline, {word: ([0, 1, 2], {word: DATA})}, tmp_path / "events.csv")
    done = ran(built(tmp_path, *STRICT, "-O0", "-I."), tmp_path / "events.csv")
    assert done.returncode == 0, done.stderr
    assert [float(row.rsplit(",", 1)[1]) for row in done.stdout.splitlines()[::2]] == WANTED


@pytest.mark.parametrize("word", ["loop", "Makefile", "math", "main", "time", "replay", "clean", "flowgraph"])
def test_the_engine_and_make_take_them_too(word, tmp_path):
    pipeline = called(word)
    result = pipeline.run({word: ([0, 1, 2], {word: DATA})}, engine="c")
    assert result[word].leaves[word].tolist() == WANTED
    write_c(pipeline, tmp_path)
    done = ran("make", "-s", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "replay").is_file()


def test_every_keyword_is_put_aside_in_every_scope():
    for word in KEYWORDS | set(WORDS):
        names = names_of(called(word))
        made = [names.module, *names.inputs, *names.outputs, *sum(names.input_leaves, ())]
        assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", n) for n in made)
        assert not KEYWORDS & {*sum(names.input_leaves, ()), *sum(names.registers, ()), names.module}
        assert len({n.lower() for n in (*names.inputs, *names.outputs)}) == 3


def test_names_that_are_fine_stay():
    names = names_of(lower(base.build()))
    assert (names.module, names.inputs, names.outputs) == ("base", ("a",), ("total", "late"))
    assert "void base_reset(base_state *s, uint64_t seed);" in generate(lower(base.build())).header


def test_two_outputs_that_a_csv_would_call_alike_stay_apart(tmp_path):
    @graph
    def g(a: Stream[Scalar]):
        return {"x,y": a, "x_y": a.map(lambda v: -v), "X_Y": a.map(lambda v: 2.0 * v)}

    write_c(lower(g.build()), tmp_path)
    (tmp_path / "e.csv").write_text("0,a,1\n")
    assert ran(built(tmp_path), tmp_path / "e.csv").stdout.split() == ["0,x_y,1", "0,x_y_2,-1", "0,X_Y,2"]


@pytest.mark.parametrize("name", ["\ud800", "a\udfff", "\ufffe", "x\uffff", "\ufdd0", "\U0001fffe"])
def test_what_is_no_character_is_refused_when_the_graph_is_built(name):
    @graph
    def output(a: Stream[Scalar]):
        return {name: a}

    @graph
    def register(a: Stream[Scalar]):
        return a.delay(0.0, name=name)

    with pytest.raises(DeclarationError, match="an output cannot be called this") as error:
        output.build()
    assert "characters" in str(error.value.expected)
    with pytest.raises(DeclarationError, match="a node cannot be called this"):
        register.build()


def test_characters_of_all_the_world_are_names():
    @graph
    def g(a: Stream[Scalar]):
        return {"Größe 大きさ 😀": a}

    result = simulate(g.build(), {"a": scalars([0, 1])}, engine="c")
    assert list(result.series) == ["Größe 大きさ 😀"]


def test_a_broken_name_in_a_file_is_written_as_something(tmp_path):
    """A pipeline from a file may have any name; it reaches C in UTF-8, or replaced."""
    pipeline = called("\ud800")
    write_c(pipeline, tmp_path)
    write_events(pipeline, {"\ud800": ([0, 1, 2], {"\ud800": DATA})}, tmp_path / "events.csv")
    assert ran(built(tmp_path), tmp_path / "events.csv").returncode == 0

"""Written C in other people's builds: other compilers, other flags, and two filters in one program."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from flowgraph import Scalar, Stream, delay, graph, lower
from flowgraph.cli.app import app
from flowgraph.engines.c import write_c, write_events
from tests.engines.c.support import STRICT, built, ran, replays, written
from tests.graphs.library import library_case


@graph
def smooth(x: Stream[Scalar], *, gain: float = 0.5):
    held = delay(0.0, name="held")
    made = x * gain + held
    held.feed(made)
    return {"made": made}


def need(compiler: str) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")


@pytest.fixture(scope="module")
def kalman(tmp_path_factory):
    """The folder of a filter that takes NaN as not measured, and what it prints."""
    folder = tmp_path_factory.mktemp("kalman")
    case = library_case("kalman")
    write_c(lower(case.graph), folder)
    write_events(lower(case.graph), case.inputs, folder / "events.csv")
    return folder, ran(built(folder), folder / "events.csv").stdout


# -- other compilers and flags ----------------------------------------------------------------------


@pytest.mark.parametrize("flag", ["-ffast-math", "-Ofast", "-ffinite-math-only"])
@pytest.mark.parametrize("compiler", ["gcc", "clang", "g++"])
def test_arithmetic_without_nan_is_refused_by_the_code(kalman, tmp_path, compiler, flag):
    """Each file by itself, since each may have flags of its own."""
    need(compiler)
    for name in ("kalman.c", "main.c"):
        done = ran(compiler, flag, "-c", name, "-o", tmp_path / "x.o", cwd=kalman[0])
        assert done.returncode != 0
        assert "compile without -ffast-math" in done.stderr


def test_sums_in_another_order_are_refused_where_the_compiler_says_so(kalman, tmp_path):
    flags = ["-fassociative-math", "-fno-signed-zeros", "-fno-trapping-math"]
    (tmp_path / "empty.c").write_text("")
    if "__ASSOCIATIVE_MATH__" not in ran("cc", *flags, "-dM", "-E", tmp_path / "empty.c").stdout:
        pytest.skip("this compiler does not say it")
    assert ran("cc", *flags, "-c", "kalman.c", "-o", tmp_path / "x.o", cwd=kalman[0]).returncode != 0


BUILDS = [
    ("gcc", "-std=c11 -O2 -Wall -Wextra -Werror -pedantic"),
    ("gcc", "-std=gnu17 -O3 -Wall -Wextra -Werror -Wshadow -Wconversion -Wno-conversion"),
    ("clang", "-std=c99 -O2 -Wall -Wextra -Werror -pedantic"),
    ("clang", "-Os -Wall -Wextra -Werror"),
    ("g++", "-std=c++11 -O2 -Wall -Wextra -Werror"),
    ("g++", "-std=c++20 -O2 -Wall -Wextra -Werror -x c++"),
    ("clang++", "-x c++ -std=c++17 -O2 -Wall -Wextra -Werror"),
]


@pytest.mark.parametrize(("compiler", "flags"), BUILDS, ids=lambda x: x[:24])
def test_compilers_agree(kalman, tmp_path, compiler, flags):
    need(compiler)
    folder, wanted = kalman
    for name in ("kalman.h", "kalman.c", "main.c", "events.csv"):
        shutil.copy(folder / name, tmp_path)
    words = [compiler, *flags.split(), "-o", "replay", "main.c", "kalman.c", "-lm"]
    done = ran(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[:2000]
    check_close(ran(tmp_path / "replay", tmp_path / "events.csv").stdout, wanted)


def check_close(printed: str, wanted: str) -> None:
    rows = [[r.split(",") for r in text.splitlines()] for text in (printed, wanted)]
    assert len(rows[0]) == len(rows[1]) > 10
    for mine, theirs in zip(*rows, strict=True):
        assert mine[:2] == theirs[:2]
        assert [float(x) for x in mine[2:]] == pytest.approx(
            [float(x) for x in theirs[2:]], rel=1e-9, abs=1e-9
        )


@pytest.mark.parametrize(
    "words", ["CC=gcc", "CC=clang", "CC=g++", "ARCH=-march=native", "CFLAGS=-O1", "CC=gcc CFLAGS=-std=c99"]
)
def test_make_takes_another_compiler_and_other_flags(kalman, tmp_path, words):
    compiler = words.split()[0].removeprefix("CC=")
    if words.startswith("CC="):
        need(compiler)
    folder, wanted = kalman
    for name in ("kalman.h", "kalman.c", "main.c", "Makefile", "events.csv"):
        shutil.copy(folder / name, tmp_path)
    done = ran("make", "-s", *words.split(), cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    check_close(ran(tmp_path / "replay", tmp_path / "events.csv").stdout, wanted)


def test_the_makefile_names_no_processor_and_nothing_of_one_compiler(kalman):
    text = (kalman[0] / "Makefile").read_text()
    flags = next(line for line in text.splitlines() if line.startswith("CFLAGS"))
    assert not any(word in flags for word in ("-march", "-mtune", "--param", "-Werror", "-std"))


def test_a_program_in_cpp_includes_the_header(tmp_path):
    need("g++")
    write_c(lower(smooth.build()), tmp_path)
    (tmp_path / "user.cpp").write_text("""#include "smooth.h"
#include <cstdio>
#define restrict 3 /* somebody's own word */
int main() {
    static smooth_state s;
    static smooth_x x;
    static smooth_made made;
    smooth_reset(&s, 0);
    x.value = restrict;
    if (smooth_react(&s, 0, SMOOTH_X, &x, &made) & SMOOTH_MADE) std::printf("%g", made.value);
}
""")
    for words in (
        ("cc", "-std=c99", "-O1", "-c", "smooth.c"),
        ("g++", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic", "-o", "user", "user.cpp", "smooth.o"),
    ):
        done = ran(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    assert ran(tmp_path / "user").stdout == "1.5"


# -- two filters in one program ---------------------------------------------------------------------

USE = """#include "{folder}/smooth.h"
double {folder}(double number);
double {folder}(double number) {{
    static smooth_state s;
    static smooth_x x;
    static smooth_made made;
    smooth_reset(&s, 0);
    x.value = number;
    smooth_react(&s, 0, SMOOTH_X, &x, &made);
    return made.value;
}}
"""
BOTH = """#include <stdio.h>
double front(double number);
double rear(double number);
int main(void) { printf("%g %g", front(1), rear(1)); return 0; }
"""


@pytest.fixture
def variants(tmp_path):
    """Two variants of one graph, each in its folder as an archive."""
    for folder, gain in (("front", 0.25), ("rear", 0.75)):
        write_c(lower(smooth.build(gain=gain)), tmp_path / folder)
        assert ran("cc", *STRICT, "-c", "smooth.c", cwd=tmp_path / folder).returncode == 0
        assert ran("ar", "rcs", "libsmooth.a", "smooth.o", cwd=tmp_path / folder).returncode == 0
    return tmp_path


@pytest.mark.parametrize("order", [("front", "rear"), ("rear", "front")])
def test_two_archives_of_one_name_are_two_filters(variants, order):
    (variants / "main.c").write_text(BOTH)
    for folder in order:
        (variants / f"{folder}.c").write_text(USE.format(folder=folder))
    archives = [f"{folder}/libsmooth.a" for folder in order]
    done = ran("cc", *STRICT, "-o", "both", "main.c", "front.c", "rear.c", *archives, cwd=variants)
    assert done.returncode == 0, done.stderr
    assert ran(variants / "both").stdout == "0.25 0.75"


def test_a_header_and_an_archive_of_two_variants_do_not_link(variants):
    (variants / "main.c").write_text("double front(double);\nint main(void) { return (int)front(1); }\n")
    (variants / "front.c").write_text(USE.format(folder="front"))
    done = ran("cc", "-o", "both", "main.c", "front.c", "rear/libsmooth.a", cwd=variants)
    assert done.returncode != 0
    assert "smooth_reset" in done.stderr


def test_two_headers_of_one_name_in_one_file_are_refused(variants):
    (variants / "both.c").write_text('#include "front/smooth.h"\n#include "rear/smooth.h"\n')
    done = ran("cc", "-c", "both.c", cwd=variants)
    assert done.returncode != 0
    assert "two different filters are called smooth" in done.stderr
    assert "--name" in done.stderr
    (variants / "twice.c").write_text('#include "front/smooth.h"\n#include "front/smooth.h"\n')
    assert ran("cc", "-c", "twice.c", cwd=variants).returncode == 0


def test_plain_names_clash_where_they_are_asked_for(variants):
    (variants / "main.c").write_text(BOTH)
    for folder in ("front", "rear"):
        (variants / f"{folder}.c").write_text(USE.format(folder=folder))
    sources = ["main.c", "front.c", "rear.c", "front/smooth.c", "rear/smooth.c"]
    done = ran("cc", "-DFLOWGRAPH_PLAIN_NAMES", "-o", "both", *sources, cwd=variants)
    assert done.returncode != 0
    assert "multiple definition" in done.stderr


def lowered(folder: Path, *words: str) -> str:
    done = CliRunner().invoke(app, ["lower", "ekf", "--target", "c", "-o", str(folder), *words])
    assert done.exit_code == 0, done.output
    return done.output


def test_lower_gives_each_variant_a_name(tmp_path):
    """Both headers in one file, both filters in one program."""
    lowered(tmp_path / "a", "--name", "ekf_front")
    lowered(tmp_path / "b", "--name", "ekf_rear", "--set", "position_noise=0.5")
    (tmp_path / "two.c").write_text("""#include "a/ekf_front.h"
#include "b/ekf_rear.h"
int main(void) {
    static ekf_front_state x;
    static ekf_rear_state y;
    ekf_front_reset(&x, 0);
    ekf_rear_reset(&y, 0);
    return 0;
}
""")
    words = ["cc", "-std=c99", "-O0", "-Wall", "-o", "two", "two.c", "a/ekf_front.c", "b/ekf_rear.c", "-lm"]
    done = ran(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[:1000]
    assert ran(tmp_path / "two").returncode == 0


@pytest.mark.parametrize("name", ["", "9lives", "a b", "a/b", "größe", "ekf_", "x" * 61, "-x"])
def test_a_name_that_c_would_not_take_is_refused(tmp_path, name):
    done = CliRunner().invoke(app, ["lower", "kalman", "-o", str(tmp_path / "out"), f"--name={name}"])
    assert done.exit_code == 2
    assert "a filter cannot be called this" in done.stderr
    assert "letters, digits and underscores" in done.stderr
    assert not (tmp_path / "out").exists()


def test_the_strict_flags_take_a_filter_without_outputs_or_reals(tmp_path):
    @graph
    def counts(x: Stream[Scalar]):
        return {"positive": x.map(lambda v: v > 0.0)}

    program = written(counts.build(), tmp_path)
    assert replays(program, "0,x,1\n1,x,-1\n").stdout == "0,positive,1\n1,positive,0\n"

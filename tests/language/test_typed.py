"""Typed blocks: they run as others do, and type checkers find what is planted in a filter and no more."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from flowgraph import DeclarationError, Scalar, Stream, block, delay, graph, simulate, typed_block
from tests.support import MS, both_quick, scalars

ROOT = Path(__file__).resolve().parents[2]

# The listing of the page, with mistakes put into it one at a time.
PAGE = (ROOT / "docs" / "editors.md").read_text(encoding="utf-8")
(LISTING, *_) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
PLANTED = {
    "kind": ("update(prior, seen, R=R)", "update(prior, gyro, R=R)", "Stream[Gyro]", "Range"),
    "missing": ("(track, noise=0.1)", "(track)", "noise"),
    "field": ("track.mean + K", "track.men + K", "men", "Track"),
    "setting": ("noise=0.1", 'noise="0.1"', "noise", "float"),
    "inputs": ("update(prior, seen, R=R)", "update(prior, R=R)", "argument"),
    "feed": ("track.feed(posterior)", "track.feed(innovation)", "Stream[Range]", "Track"),
}
"""By name: what is written, the mistake in its place, and words that the message must have."""


@typed_block
def grown(total: Scalar, x: Scalar, *, gain: float = 1.0, dt: float = 0.0, xp: ModuleType = np) -> Scalar:
    """The sum, with time."""
    return total + gain * dt * xp.abs(x)


@block
def grown_plainly(total: Scalar, x: Scalar, *, gain: float = 1.0, dt, xp) -> Scalar:
    """The same."""
    return total + gain * dt * xp.abs(x)


def test_a_typed_block_gives_the_same_bits_as_a_plain_one() -> None:
    @graph
    def typed(x: Stream[Scalar]):
        total = delay(0.0, name="total")
        after = grown.wired(at=x, name="sum")(total, x, gain=2.0)
        total.feed(after)
        return {"y": after}

    @graph
    def plain(x: Stream[Scalar]):
        total = delay(0.0, name="total")
        after = grown_plainly(total, x, gain=2.0, at=x, name="sum")
        total.feed(after)
        return {"y": after}

    inputs = {"x": scalars(np.array([0, 5, 30]) * MS, [3.0, -7.0, 1.0])}
    one, other = both_quick(typed.build(), inputs), simulate(plain.build(), inputs)
    np.testing.assert_array_equal(one["y"]["value"], other["y"]["value"])
    assert one["y"]["value"][-1] == pytest.approx(2.0 * (0.005 * 7.0 + 0.025))
    assert typed.build().text().replace("grown", "") == plain.build().text().replace(
        "grown_plainly", ""
    ).replace("plain", "typed")


def test_what_is_handed_in_is_no_setting_and_the_step_can_be_called_alone() -> None:
    assert grown.settings == {"gain": 1.0}
    assert grown.handed == {"dt", "xp"}
    assert grown.step(1.0, -2.0, dt=0.5) == 2.0


def _five(a: Scalar, b: Scalar, c: Scalar, d: Scalar, e: Scalar) -> Scalar:
    return a


def _bare(a, *, gain: float = 1.0) -> Scalar:  # type: ignore[no-untyped-def]
    return a


def _setting(a: Scalar, *, gain=1.0) -> Scalar:  # type: ignore[no-untyped-def]
    return a


def _timed(a: Scalar, *, dt: float) -> Scalar:
    return a


def _named(a: Scalar, *, xp: ModuleType) -> Scalar:
    return a


def _none(*, gain: float = 1.0) -> Scalar:
    return np.zeros(())


@pytest.mark.parametrize(
    ("step", "said", "fix"),
    [
        (_five, "one to four ports", "write @block"),
        (_none, "one to four ports", "write @block"),
        (_bare, "'a' has no type", "write a: "),
        (_setting, "'gain' has no type", "write gain: "),
        (_timed, "'dt' is handed in", "write dt: float = 0.0"),
        (_named, "'xp' is handed in", "write xp: Namespace = np"),
    ],
)
def test_what_checkers_cannot_check_is_refused_at_once(step: Any, said: str, fix: str) -> None:
    with pytest.raises(DeclarationError, match=said) as refused:
        typed_block(step)
    assert refused.value.path == step.__name__
    assert str(refused.value.fix).startswith(fix)


def test_a_typed_block_is_refused_where_a_plain_one_is() -> None:
    @graph
    def short(x: Stream[Scalar]):
        return grown.wired(name="sum")(x)  # type: ignore[call-arg]

    with pytest.raises(DeclarationError, match="port 'x' is not connected"):
        short.build()


def planted(folder: Path) -> dict[str, str]:
    """Write the listing, and the listing with each mistake; returns the lines that are wrong."""
    (folder / "right.py").write_text(LISTING)
    lines = {}
    for name, (right, wrong, *_) in PLANTED.items():
        assert LISTING.count(right) == 1, name
        text = LISTING.replace(right, wrong)
        (folder / f"{name}.py").write_text(text)
        (at,) = [
            k for k, (a, b) in enumerate(zip(LISTING.split("\n"), text.split("\n"), strict=True), 1) if a != b
        ]
        lines[name] = f"{name}.py:{at}:"
    return lines


def check(said: str, lines: dict[str, str]) -> None:
    """Each mistake is found where it is, in words that say what is wrong, and nothing else is."""
    errors = [line for line in said.splitlines() if re.search(r"\.py:\d+:.* error[: ]", line)]
    assert len(errors) == len(PLANTED), said
    for name, place in lines.items():
        start = next(k for k, line in enumerate(said.splitlines()) if place in line)
        message = re.split(r"\n\S*/?\w+\.py:?\n?", "\n".join(said.splitlines()[start:]).partition("\n/")[0])[
            0
        ]
        for word in PLANTED[name][2:]:
            assert word in message, (name, message)


@pytest.mark.slow
def test_mypy_finds_what_is_planted(tmp_path: Path) -> None:
    pytest.importorskip("mypy", reason="needs mypy")
    lines = planted(tmp_path)
    (tmp_path / "mypy.ini").write_text("[mypy]\nstrict = True\n")
    command = [sys.executable, "-m", "mypy", "--no-color-output", "right.py", *(f"{n}.py" for n in PLANTED)]
    environment = {**os.environ, "MYPYPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False, env=environment
    )
    check(done.stdout, lines)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("node") is None, reason="no node, which pyright runs in")
def test_pyright_finds_what_is_planted(tmp_path: Path) -> None:
    pytest.importorskip("pyright", reason="needs pyright")
    lines = planted(tmp_path)
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "."]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False)
    if not re.search(r"\d+ errors?, \d+ warnings?", done.stdout):
        pytest.skip(f"pyright does not run here: {done.stderr[-200:]}")
    check(done.stdout, lines)

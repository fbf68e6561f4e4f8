"""Every ```python block of the README and of every page of the docs runs, in order, in one namespace a page.

A block runs under the page's own file name and line numbers, so a failure is reported as docs/page.md:line
and the traceback shows the line.
"""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from typer.main import get_command

from flowgraph.cli import app
from flowgraph.data.registry import find_graph, graph_names
from flowgraph.data.settings import keyword_types
from flowgraph.study.tune import placed

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^```python\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(text: str) -> Iterator[tuple[int, str]]:
    """The first line number and the code of each python block."""
    for match in FENCE.finditer(text):
        yield text.count("\n", 0, match.start("code")) + 1, match["code"]


def run_page(page: Path, root: Path = ROOT) -> int:
    """Run the blocks of a page; returns how many ran."""
    label = page.relative_to(root)
    module = ModuleType(f"docs_{page.stem}")  # annotations and error messages look a block's module up
    sys.modules[module.__name__] = module
    ran = 0
    try:
        for line, code in blocks(page.read_text(encoding="utf-8")):
            try:
                exec(compile("\n" * (line - 1) + code, str(page), "exec"), module.__dict__)
            except Exception as error:
                lines = [line]
                trace = error.__traceback__
                while trace is not None:
                    if trace.tb_frame.f_code.co_filename == str(page):
                        lines.append(trace.tb_lineno)
                    trace = trace.tb_next
                text = f"{label}:{lines[-1]}: {type(error).__name__}: {error}\n(block at line {line})"
                raise AssertionError(text) from error
            ran += 1
    finally:
        del sys.modules[module.__name__]
    return ran


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_blocks_of_a_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # what a block writes stays out of the tree
    run_page(page)


def test_a_failing_block_is_reported_by_page_and_line(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "text\n\n```python\nx = 1\n```\n\nmore\n\n```python\nassert x == 1\n\nassert x == 2\n```\n"
    )
    with pytest.raises(AssertionError, match=r"^page\.md:12: AssertionError") as failure:
        run_page(page, root=tmp_path)
    assert "(block at line 10)" in str(failure.value)


def test_a_python_block_is_closed_and_starts_at_the_margin() -> None:
    """A fence that the pattern above would pass over in silence is an error of the page."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert len(re.findall(r"```\s*py", text)) == len(list(blocks(text))), page.name


def commands() -> Iterator[tuple[str, list[str]]]:
    """The words after `flowgraph` of each command of a page, with its place."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for fence in re.finditer(r"^```sh\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
            for line in fence[1].replace("\\\n", " ").splitlines():
                for part in line.split("&&"):
                    words = shlex.split(part, comments=True)
                    if words and words[0].rpartition("/")[2] == "flowgraph":
                        yield f"{page.name}: {line}", words[1:]


def wrong_in(words: list[str]) -> list[str]:
    """The options of a command that it has not, and the parameters to find that its graph has not."""
    command: Any = get_command(app)
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
    known = {option for parameter in command.params for option in parameter.opts}
    wrong = [w for w in words if w.startswith("-") and w.partition("=")[0] not in known]
    sought = [b.partition("=")[0] for a, b in pairwise(words) if a in ("--fit", "--find")]
    if sought and words[0] in graph_names():
        prepare = find_graph(words[0]).prepare
        assert prepare is not None
        wrong += [n for n in sought if not placed(n) and n.replace(".", "_") not in keyword_types(prepare)]
    return wrong


def test_the_commands_of_the_pages_have_the_options_that_are_written() -> None:
    found = list(commands())
    assert len(found) > 30
    assert {place: wrong for place, words in found if (wrong := wrong_in(words))} == {}


def test_a_command_with_an_option_that_is_not_there_is_found() -> None:
    assert wrong_in(["tune", "ins_eskf", "--fit", "gyro_noise=1:2", "--most", "3"]) == ["gyro_noise"]
    assert wrong_in(["run", "ins_eskf", "--dta", "sim"]) == ["--dta"]
    assert wrong_in(["tune", "ins_eskf", "--fit", "gyro_factor=1:2"]) == []

"""Every ```python block of the README and of every page of the docs runs, in order, in one namespace a page.

A block runs under the page's own file name and line numbers, so a failure is reported as docs/page.md:line
and the traceback shows the line.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

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

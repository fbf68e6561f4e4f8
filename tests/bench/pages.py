"""Pages: what they weigh, how long a browser takes until the diagram stands, and for a step of the slider.

Without Chromium and Selenium there is only what they weigh.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from statistics import median
from time import monotonic, sleep
from typing import Any

from typer.testing import CliRunner

from flowgraph.cli import app
from tests.bench.rows import Row

MOST = {"diagram": 3.0, "run": 10.0}
"""Megabytes."""

_STEPS = """
const slider = document.querySelector('input[type=range]'), taken = [];
for (let k = 1; k <= 50; k++) {
  const start = performance.now();
  slider.value = k * slider.max / 50;
  slider.dispatchEvent(new Event('input'));
  document.body.getBoundingClientRect();
  taken.push(performance.now() - start);
}
return taken;
"""


def rows(*, duration: float = 200.0, repeats: int = 5) -> list[Row]:
    """The page of rbpf_outdoor, and that of a run of ins_eskf, 200 ticks a second."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        diagram, run = Path(folder) / "diagram.html", Path(folder) / "run.html"
        _call("show", "rbpf_outdoor", "-o", str(diagram))
        _call("run", "ins_eskf", "--data", "sim", "--set", f"duration={duration}", "--html", str(run))
        for kind, file in (("diagram", diagram), ("run", run)):
            size, most = file.stat().st_size / 1e6, MOST[kind]
            name = (
                "page of rbpf_outdoor"
                if kind == "diagram"
                else f"page of {200 * duration:.0f} ticks of ins_eskf"
            )
            found.append(
                Row(name, size, most, "MB", "the most", size / most, f"ours < {most:g} MB", size < most)
            )
            found += _in_browser(name, file, repeats)
    return found


def _call(*arguments: str) -> None:
    done = CliRunner().invoke(app, list(arguments))
    if done.exit_code:
        raise RuntimeError(f"flowgraph {' '.join(arguments)}: {done.output}")


def _in_browser(name: str, file: Path, repeats: int) -> list[Row]:
    browser, driver = shutil.which("chromium"), shutil.which("chromedriver")
    try:
        from selenium.webdriver import Chrome, ChromeOptions
        from selenium.webdriver.chrome.service import Service
    except ImportError:
        browser = None
    if browser is None or driver is None:
        return [
            Row(f"{name}: first drawing", float("nan"), None, "s", "none: no chromium, or no Selenium", None)
        ]
    options = ChromeOptions()
    options.binary_location = browser
    for flag in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1280,800"):
        options.add_argument(flag)
    chrome = Chrome(options=options, service=Service(driver))
    try:
        first = [_first_drawing(chrome, file) for _ in range(repeats)]
        made = [Row(f"{name}: first drawing", median(first), None, "s", "none: no peer draws it", None)]
        if "ticks" in name:
            steps = [float(ms) for ms in chrome.execute_script(_STEPS)]
            made.append(
                Row(f"{name}: step of the slider", median(steps), 16.7, "ms", "a frame", median(steps) / 16.7)
            )
        return made
    finally:
        chrome.quit()


def _first_drawing(chrome: Any, file: Path) -> float:
    """Seconds from the start of the page to its diagram, as the page's own clock has them."""
    chrome.get(file.as_uri())
    end = monotonic() + 60
    while monotonic() < end:
        if (found := chrome.execute_script("return document.body.dataset.drawnMs")) is not None:
            return float(found) / 1e3
        sleep(0.05)
    raise TimeoutError(f"{file.name} was not drawn within a minute")

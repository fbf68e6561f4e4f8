"""The pages of the docs, and pictures of them as a person sees them, made when the site is built.

The pictures are taken by Chromium without a window, 1,280 pixels wide, once a page says that it stands. Where
there is none, a picture says so: it is no part of what the build checks.
"""

from __future__ import annotations

import io
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from flowgraph import LiveView
from flowgraph.cli import app
from flowgraph.cli.options import case_of
from flowgraph.engines.watched import simulate_watched

PAGES: dict[str, tuple[str, str, bool]] = {
    "page_rbpf_outdoor": ("show rbpf_outdoor -o", "", False),
    "page_run": ("run ins_eskf --data sim --set duration=6 --html", "#t=2", False),
    "page_run_dark": (
        "run rbpf_outdoor --data sim:thesis --set sensors=all --set duration=2 --set particles=60 --html",
        "#t=1",
        True,
    ),
}
"""By name: the command that writes the page, where it is opened, and whether it is dark."""

STUDY = """
graphs = ["ekf", "ins_eskf"]
data = ["sim"]
seeds = 4
[parameters]
duration = 3
position_noise = [0.005, 0.01, 0.05]
"""

_FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars",
    "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip

_STANDS = "return document.querySelector('[data-drawn], [data-shown], [data-ended]') !== null"


def screens() -> Iterator[tuple[str, bytes]]:
    """The pages and their pictures, by the name of the file."""
    with tempfile.TemporaryDirectory() as made, browser() as chrome:
        folder = Path(made)
        for name, (command, where, dark) in PAGES.items():
            page = folder / f"{name}.html"
            call(*command.split(), str(page))
            yield page.name, page.read_bytes()
            yield f"{name}.png", picture(chrome, page.as_uri() + where, dark=dark)
        yield from report(chrome, folder)
        yield "page_live.png", live(chrome)


def report(chrome: Any, folder: Path) -> Iterator[tuple[str, bytes]]:
    """The page of a study, its beginning and its runs."""
    (folder / "study.toml").write_text(STUDY)
    call("batch", str(folder / "study.toml"), "--out", str(folder / "study"), "--quiet")
    call("report", str(folder / "study"), "--runs", "3")
    page = folder / "study" / "report.html"
    yield "page_report.html", page.read_bytes()
    yield "page_report.png", picture(chrome, page.as_uri())
    look = "document.querySelector('.shown-runs').scrollIntoView()"
    yield "page_report_runs.png", picture(chrome, page.as_uri(), look)


def live(chrome: Any) -> bytes:
    """The page of a run that has just ended, as who comes late sees it."""
    case, _ = case_of("ins_eskf", "sim", ["duration=8"], 0)
    with LiveView(case.graph, case.inputs, title="sim, duration=8, seed 0", speed=4.0) as view:
        simulate_watched(case.graph, case.inputs, view)
        return picture(chrome, view.url)


def call(*command: str) -> None:
    """Run a command, which must succeed."""
    done = CliRunner().invoke(app, list(command))
    if done.exit_code:
        raise RuntimeError(f"flowgraph {' '.join(command)}: {done.output}")


@contextmanager
def browser() -> Iterator[Any]:
    """Chromium with its driver, or None."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if found is None or driver is None:
        yield None
        return
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = found
    for flag in _FLAGS:
        options.add_argument(flag)
    chrome = Chrome(options=options, service=Service(driver))
    try:
        size = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
        chrome.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        yield chrome
    finally:
        chrome.quit()


def picture(chrome: Any, address: str, then: str = "", *, dark: bool = False) -> bytes:
    """A PNG of a page once it stands and `then` was done, or of words where nothing can take one."""
    if chrome is None:
        return words("The build that made these docs had no Chromium, and took no picture of this page.")
    look = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
    chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": look})
    chrome.get("about:blank")  # a page that differs in its fragment alone would not be opened anew
    chrome.get(address)
    end = time.monotonic() + 60
    while not chrome.execute_script(_STANDS):
        if time.monotonic() > end:
            raise TimeoutError(f"{address} did not stand within a minute")
        time.sleep(0.05)
    chrome.execute_script(then)
    time.sleep(1.0)  # what comes into view is drawn then
    png: bytes = chrome.get_screenshot_as_png()
    return png


def words(text: str) -> bytes:
    """A PNG of a line of text."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 1))
    figure.text(0.5, 0.5, text, ha="center", va="center", fontsize=10)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()

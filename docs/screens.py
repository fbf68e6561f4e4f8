"""The pages of the docs, and pictures of them as a person sees them, made when the site is built.

The pictures are taken by Chromium without a window, 1,280 pixels wide. Where there is none, a picture says
so: it is no part of what the build checks.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from typer.testing import CliRunner

from flowgraph.cli import app

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

_FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars",
    "--window-size=1280,800", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--virtual-time-budget=5000",
)  # fmt: skip


def screens() -> Iterator[tuple[str, bytes]]:
    """The pages and their pictures, by the name of the file."""
    with tempfile.TemporaryDirectory() as folder:
        for name, (command, where, dark) in PAGES.items():
            page = Path(folder) / f"{name}.html"
            done = CliRunner().invoke(app, [*command.split(), str(page)])
            if done.exit_code:
                raise RuntimeError(f"flowgraph {command}: {done.output}")
            yield page.name, page.read_bytes()
            yield f"{name}.png", picture(page, where, dark)


def picture(page: Path, where: str, dark: bool) -> bytes:
    """A PNG of a page, or of words where nothing can take one."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        return words("The build that made these docs had no Chromium, and took no picture of this page.")
    made = page.with_suffix(".png")
    look = ["--blink-settings=preferredColorScheme=0"] if dark else []
    command = [browser, *_FLAGS, *look, f"--screenshot={made}", page.as_uri() + where]
    subprocess.run(command, capture_output=True, timeout=180, check=True)
    return made.read_bytes()


def words(text: str) -> bytes:
    """A PNG of a line of text."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 1))
    figure.text(0.5, 0.5, text, ha="center", va="center", fontsize=10)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()

"""What things show of themselves in a notebook: words stay words, and the pages are whole."""

from __future__ import annotations

import base64
import gzip
import html
import pickle
import re
import shutil
import sys
import time
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Flight,
    Graph,
    ProgressBar,
    Result,
    Scalar,
    Series,
    Stream,
    find_graph,
    graph,
    load_flight,
    lower,
    simulate,
    simulate_many,
)
from flowgraph.data.registry import Case
from flowgraph.drawing.notebook import framed
from flowgraph.pipeline.costs.report import cost_report
from flowgraph.study.report import Reported
from tests.support import scalars

EVIL = "<script>alert(1)</script>"


@graph
def doubled(x: Stream[Scalar]):
    """Twice x."""
    return {"y": x + x}


@pytest.fixture(scope="module")
def run() -> tuple[Graph, Result]:
    built = doubled.build()
    return built, simulate(built, {"x": scalars(np.arange(40) * 10**7)})


class _Whole(HTMLParser):
    """Tags that are closed, and what stands in them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.scripts = 0
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.scripts += tag == "script"
        if tag not in ("img", "br", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def pages(shown: str) -> list[str]:
    """The pages in the frames of what is shown."""
    found = []
    for inner in re.findall(r'srcdoc="([^"]*)"', shown):
        packed = re.search(r'atob\("([^"]*)"\)', html.unescape(inner))
        assert packed is not None
        found.append(gzip.decompress(base64.b64decode(packed[1])).decode())
    return found


def test_a_graph_shows_its_diagram_and_the_one_that_unfolds(run: tuple[Graph, Result]) -> None:
    bundle = run[0]._repr_mimebundle_()
    assert bundle["text/plain"] == run[0].text()
    assert bundle["image/svg+xml"].lstrip().startswith("<")
    seen = _Whole(bundle["text/html"])
    assert seen.scripts == 0
    (page,) = pages(bundle["text/html"])
    assert page.startswith("<!DOCTYPE html>")
    assert '"doubled"' in page
    assert 'sandbox="allow-scripts"' in bundle["text/html"]
    assert len(bundle["text/html"]) < 900_000  # a saved notebook holds one a graph


def test_without_a_layout_engine_a_graph_shows_its_text(
    run: tuple[Graph, Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pygraphviz", None)
    monkeypatch.setenv("PATH", "")
    bundle = run[0]._repr_mimebundle_()
    assert "image/svg+xml" not in bundle
    assert f"<pre>{html.escape(run[0].text())[:20]}" in bundle["text/html"]


def test_a_result_and_a_series_show_their_streams_and_plots(run: tuple[Graph, Result]) -> None:
    shown = run[1]._repr_html_()
    words = " ".join(_Whole(shown).text)
    assert "doubled: 40 ticks" in words
    assert "y" in words
    picture = re.search(r"data:image/png;base64,([^\"]+)", shown)
    assert picture is not None
    assert base64.b64decode(picture[1]).startswith(b"\x89PNG")
    assert "value" in " ".join(_Whole(run[1]["y"]._repr_html_()).text)
    empty = Series(np.zeros(0, np.int64), np.zeros(0), name="none")
    assert "img" not in empty._repr_html_()


def test_names_and_notes_stay_text() -> None:
    series = Series(np.arange(3), np.zeros(3), name=EVIL)
    result = Result(EVIL, EVIL, {EVIL: series}, {}, {EVIL: 1}, 3, 0.0, (f"info: {EVIL}",))
    flight = Flight(EVIL, {EVIL: series}, notes=(f"info: {EVIL}",))
    for shown in (result._repr_html_(), series._repr_html_(), flight._repr_html_()):
        assert _Whole(shown).scripts == 0
        assert EVIL in "".join(_Whole(shown).text)
    (page,) = pages(framed(EVIL))
    assert page == EVIL


def test_a_flight_and_a_case_show_what_they_hold_and_a_run_has_its_page(tmp_path: Any) -> None:
    flight = load_flight("sim", settings={"duration": "1"})
    case = find_graph("ins_eskf").case(flight)
    assert isinstance(case, Case)
    assert "specific_force [m/s^2]" in " ".join(_Whole(flight._repr_html_()).text)
    assert "the start is the truth's" in " ".join(_Whole(case._repr_html_()).text)
    page = case.page(simulate(case.graph, case.inputs), truth=flight.truth)
    assert '"position_rmse_m"' in page.text
    assert pages(page._repr_html_()) == [page.text]
    assert page.save(tmp_path / "run.html").read_text() == page.text
    assert "Page" in repr(page)


def test_a_pipeline_and_its_costs_show_themselves(run: tuple[Graph, Result]) -> None:
    pipeline = lower(run[0])
    words = "".join(_Whole(pipeline._repr_html_()).text)
    assert "pipeline doubled" in words
    assert "instructions" in words
    assert pipeline.listing().splitlines()[0] in words
    shown = cost_report(pipeline)._repr_html_()
    assert _Whole(shown).scripts == 0
    assert pages(shown) == [cost_report(pipeline).html()]


def test_a_batch_shows_itself_and_its_streams_are_attributes(run: tuple[Graph, Result]) -> None:
    batch = simulate_many(run[0], {"x": scalars([0, 10])}, seeds=range(3), engine="reference")
    assert batch.y.value.shape == (3, 2)
    assert "y" in dir(batch)
    assert "value" in dir(batch.y)
    assert "value" in dir(batch.y.run(0))
    assert "3 runs of 2 ticks" in " ".join(_Whole(batch._repr_html_()).text)
    assert repr(batch.y) == "<Runs y: 3 runs of 2 ticks, value>"
    assert repr(batch) == "<Batch of doubled (reference): 3 runs of 2 ticks, y>"
    with pytest.raises(AttributeError, match="no output is called 'z'"):
        _ = batch.z
    assert pickle.loads(pickle.dumps(batch)).y.value.shape == (3, 2)


def test_the_report_of_a_study_shows_its_page(tmp_path: Any) -> None:
    (tmp_path / "report.html").write_text("<p>all</p>")
    shown = Reported(tmp_path / "report.html", (), [{"graph": "g", "rmse": 0.5}], ("info: n",))._repr_html_()
    assert pages(shown) == ["<p>all</p>"]
    assert {"g", "0.5", "info: n"} <= set(_Whole(shown).text)


def test_a_plot_shows_itself_without_pyplot_and_can_be_sent_elsewhere(run: tuple[Graph, Result]) -> None:
    figure = run[1].plot()
    assert figure._repr_png_().startswith(b"\x89PNG")
    again = pickle.loads(pickle.dumps(figure))
    assert again._repr_png_().startswith(b"\x89PNG")


def test_a_bar_in_a_notebook_is_drawn_anew_but_not_at_each_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []

    class Cell:
        def display(self, bar: Any) -> None:
            drawn.append(bar._repr_html_())

        update = display

    monkeypatch.setattr("flowgraph.data.progress._cell_of_notebook", Cell)
    with ProgressBar("<b>", total=1000) as bar:
        for tick in range(1000):
            bar.update(tick + 1, 0)
    assert drawn[0] == '&lt;b&gt; <progress value="0" max="1000"></progress> 0/1000'
    assert drawn[-1].endswith("1000/1000")
    assert len(drawn) < 100


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("chromium") is None or shutil.which("chromedriver") is None,
    reason="no chromium with its driver",
)
def test_a_browser_unpacks_the_diagram_in_its_frame(run: tuple[Graph, Result], tmp_path: Any) -> None:
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs Selenium")
    cell = tmp_path / "cell.html"
    cell.write_text(run[0]._repr_mimebundle_()["text/html"].replace("<details>", "<details open>"))
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(word)
    driver = webdriver.chrome.service.Service(shutil.which("chromedriver"))
    browser = webdriver.Chrome(options=options, service=driver)
    try:
        browser.get(cell.as_uri())
        browser.switch_to.frame(browser.find_element("tag name", "iframe"))
        seen = "return [document.body?.innerText ?? '', document.querySelectorAll('svg').length]"
        end = time.monotonic() + 120
        while True:
            words, pictures = browser.execute_script(seen)
            if "Twice x." in words and pictures:
                break
            assert time.monotonic() < end, f"the diagram did not come: {words!r}"
            time.sleep(0.1)
    finally:
        browser.quit()

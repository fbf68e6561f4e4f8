"""The pages in a real browser: what a person sees when they unfold, search, point and move the slider.

They need Chromium and its driver, and Selenium; what accessibility asks is asked by axe-core, which
`make front` puts into out/front.
"""

from __future__ import annotations

import itertools
import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flowgraph import Scalar, Stream, block, delay, graph, match, periodic
from flowgraph.cli.options import case_of
from flowgraph.cli.pages import recorder_of, write_page
from flowgraph.data.flight import Flight
from flowgraph.data.registry import Case
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.drawing.live import LiveServer, Sender, live_page
from flowgraph.drawing.page import diagram_page
from flowgraph.drawing.run_page import describe_run, run_page, runs_of_page
from flowgraph.engines.watched import simulate_watched
from flowgraph.pipeline.costs.places import costs_by_path
from flowgraph.study import Study, run_study
from flowgraph.study.report import write_comparison, write_report
from tests.drawing.test_page import _Reader
from tests.drawing.test_run_page import flown, result_of
from tests.test_house import ROOT

selenium = pytest.importorskip("selenium", reason="Selenium, which drives the browser, is not installed")
from selenium.webdriver import Chrome, ChromeOptions  # noqa: E402
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.action_chains import ActionChains  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
AXE = ROOT / "out/front/node_modules/axe-core/axe.min.js"
FLIGHTS: dict[str, tuple[str, list[str]]] = {
    "ins_eskf": ("sim", ["duration=3"]),
    "rbpf_outdoor": ("sim:thesis", ["sensors=all", "duration=1", "particles=40"]),
}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None or DRIVER is None, reason="no chromium with chromedriver on PATH"),
]


@block
def total(before: Scalar, value: Scalar) -> Scalar:
    """The sum."""
    return before + value


@graph
def paired(a: Stream[Scalar], b: Stream[Scalar]):
    """Two sensors of one rate, paired, and a sum."""
    before = delay(7.25, name="held")
    now = total(before, a)
    before.feed(now)
    return {"sum": now, "pairs": match(a, b, tolerance="6ms", size=4, name="pairs")}


def once(found: Callable[[], Any], what: str, seconds: float = 120.0) -> Any:
    """What is found, once that is true."""
    end = time.monotonic() + seconds
    while not (now := found()):
        assert time.monotonic() < end, f"never true: {what}"
        time.sleep(0.03)
    return now


class Page:
    """A page in the browser, at 1,280 pixels."""

    def __init__(self, chrome: Chrome) -> None:
        self.chrome = chrome

    def open(self, file: Path, ready: str) -> None:
        self.chrome.get_log("performance")
        self.chrome.get(file.as_uri())
        self.until(f"return document.querySelector('{ready}') !== null")

    def ask(self, script: str, *arguments: Any) -> Any:
        return self.chrome.execute_script(script, *arguments)

    def until(self, script: str, *arguments: Any) -> Any:
        """What a script returns, once that is true."""
        return once(lambda: self.ask(script, *arguments), script)

    def find(self, selector: str) -> Any:
        return self.chrome.find_element(By.CSS_SELECTOR, selector)

    def texts(self, selector: str) -> list[str]:
        found: list[str] = self.ask(
            "return [...document.querySelectorAll(arguments[0])].map(e => e.textContent)", selector
        )
        return found

    def slide(self, share: float) -> float:
        """Move the slider to a share of the run; the time there."""
        moved: float = self.ask(
            "const s = document.querySelector('input[type=range]'); s.value = arguments[0] * Number(s.max);"
            "s.dispatchEvent(new Event('input')); return Number(s.value)",
            share,
        )
        return moved

    def is_quiet(self) -> None:
        """Nothing was said on the console, and nothing asked of any address but the file itself."""
        assert [e for e in self.chrome.get_log("browser") if e["level"] in ("SEVERE", "WARNING")] == []
        asked = []
        for entry in self.chrome.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                asked.append(message["params"]["request"]["url"])
        assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []
        assert len([url for url in asked if url.startswith("file:")]) == 1

    def is_accessible(self) -> None:
        """axe finds nothing serious."""
        if not AXE.exists():
            pytest.skip("axe-core is not there: run `make front`")
        self.ask(AXE.read_text())
        found = self.chrome.execute_async_script(
            "const done = arguments[0]; axe.run({resultTypes: ['violations']}).then(r => done(r.violations))"
        )
        serious = [v for v in found if v["impact"] in ("serious", "critical")]
        assert [(v["id"], [n["html"][:160] for n in v["nodes"][:3]]) for v in serious] == []

    def overlaps(self) -> list[tuple[str, str]]:
        """Texts of boxes in the diagram that cover each other, and texts that leave their box."""
        found: list[tuple[str, str]] = self.ask(
            """const found = [], texts = [...document.querySelectorAll('.box text, .frame > text')];
            const places = texts.map(t => t.getBoundingClientRect());
            for (let i = 0; i < texts.length; i++) {
              for (let j = 0; j < i; j++) {
                const a = places[i], b = places[j];
                if (Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1 &&
                    Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 3)
                  found.push([texts[i].textContent, texts[j].textContent]);
              }
              const box = texts[i].closest('.box')?.querySelector('.shape').getBoundingClientRect();
              if (box && (places[i].left < box.left - 1 || places[i].right > box.right + 1))
                found.push([texts[i].textContent, 'its box']);
            }
            return found"""
        )
        return found


def reader_of(file: Path) -> _Reader:
    return _Reader(file.read_text())


@pytest.fixture(scope="module")
def chrome() -> Iterator[Chrome]:
    options = ChromeOptions()
    options.binary_location = str(BROWSER)
    for flag in (
        "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1280,800",
        "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    ):  # fmt: skip
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = Chrome(options=options, service=Service(str(DRIVER)))
    driver.set_script_timeout(300)  # axe on a busy machine
    size = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    yield driver
    driver.quit()


@pytest.fixture
def page(chrome: Chrome) -> Page:
    return Page(chrome)


def look(page: Page, scheme: str) -> None:
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    page.chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Path, Case, Result]]:
    """By graph: the page of its diagram, that of a run, the case and the result."""
    folder = tmp_path_factory.mktemp("pages")
    made = {}
    for name, (spec, settings) in FLIGHTS.items():
        case, flight = case_of(name, spec, settings, 0)
        diagram, run = folder / f"{name}.html", folder / f"{name}_run.html"
        diagram_page(case.graph, diagram, costs=costs_by_path(case.graph))
        recorder = recorder_of(case)
        result = simulate_watched(case.graph, case.inputs, recorder)
        streams = case.inputs.streams if isinstance(case.inputs, Flight) else case.inputs
        recorded = {k: s for k, s in streams.items() if isinstance(s, Series)}
        report = {"position_rmse_m": 0.25, "notes": ["warning: a <b>note</b>"]}
        others: list[Any] = []
        for title in ("the first", "the second") if name == "ins_eskf" else ("the only",):
            write_page(run, others, title, case, flight.truth, recorded, result, recorder, report)
            if title == "the first":
                others = runs_of_page(run)
        made[name] = diagram, run, case, result
    return made


@pytest.mark.parametrize(("name", "scheme"), [("ins_eskf", "dark"), ("rbpf_outdoor", "light")])
def test_diagram(name, scheme, page, pages) -> None:
    file, _, case, _ = pages[name]
    assert file.stat().st_size < 3_000_000
    look(page, scheme)
    page.open(file, "[data-drawn]")
    graph = case.graph
    assert len(page.texts(".box.source")) == len(graph.sources)
    assert len(page.texts(".box.block, .box.host")) == len(graph.calls)
    assert page.overlaps() == []

    page.find("input[type=search]").send_keys("imu noise" if name == "ins_eskf" else "spread", Keys.ENTER)
    wanted = "predict" if name == "ins_eskf" else "average/spread"
    page.until("return document.querySelector('.details h2').textContent === arguments[0]", wanted)
    details = page.find(".details").text
    assert ".py:" in details
    assert "operations" in details
    page.is_accessible()

    page.ask("diagram.fit()")
    dot = page.find(".box.source .dot")
    ActionChains(page.chrome).move_to_element(dot).perform()
    tip = page.until("const t = document.querySelector('.tip'); return !t.hidden && t.textContent")
    assert "rate: " in tip
    assert "Hz" in tip
    ActionChains(page.chrome).move_to_element(page.find("h1")).perform()
    page.until("return document.querySelector('.tip').hidden")
    page.is_quiet()


def test_graphs_fold_and_unfold_by_mouse_and_by_key(page, pages) -> None:
    look(page, "light")
    page.open(pages["rbpf_outdoor"][0], "[data-drawn]")
    blocks = len(page.texts(".box.block"))
    page.ask("diagram.whole()")
    page.find(".frame .fold").send_keys(Keys.ENTER)
    page.until("return document.querySelector('.frame.shut') !== null")
    assert page.ask("return document.activeElement.getAttribute('aria-expanded')") == "false"
    assert page.texts(".frame.shut text") == ["average", "4 blocks"]
    assert len(page.texts(".box.block")) == blocks - 4
    page.find(".frame .fold").click()
    page.until("return document.querySelectorAll('.box.block').length === arguments[0]", blocks)
    page.find("button[title='Fold all graphs']").click()
    page.until("return document.querySelector('.frame.shut') !== null")
    page.ask(
        "diagram.reveal(arguments[0])",
        [n.path for n in pages["rbpf_outdoor"][2].graph.nodes].index("average/pose"),
    )
    page.until("return document.querySelector('.selected text.name')?.textContent === 'pose'")
    assert page.texts(".frame.shut") == []
    page.is_quiet()


def test_a_diagram_is_moved_enlarged_and_read_by_keys(page, pages) -> None:
    """Arrows, + and - and 0; the legend's colour is the wire's, and who points at a clock sees its wires."""
    look(page, "light")
    page.open(pages["ins_eskf"][0], "[data-drawn]")
    place = "return document.querySelector('svg.diagram > g').getAttribute('transform')"
    frame = page.find("svg.diagram")
    page.ask("document.querySelector('svg.diagram').focus()")
    places = [page.ask(place)]
    for key in (Keys.ARROW_RIGHT, "+", "-", Keys.ARROW_DOWN):
        frame.send_keys(key)
        places.append(page.ask(place))
    assert all(a != b for a, b in itertools.pairwise(places))
    frame.send_keys("0")
    fitted = page.ask(place)
    frame.send_keys("+")
    frame.send_keys("0")
    assert page.ask(place) == fitted
    colours = page.ask(
        "return [...document.querySelectorAll('.legend .clock')].map(b =>"
        " getComputedStyle(b.querySelector('.swatch')).backgroundColor)"
    )
    drawn = page.ask(
        "return [...document.querySelectorAll('.line .stroke')].map(l => getComputedStyle(l).stroke)"
    )
    assert len(set(colours)) == len(colours) > 3
    assert set(drawn) == set(colours)
    clock = page.chrome.find_elements(By.CSS_SELECTOR, ".legend .clock")[1]
    ActionChains(page.chrome).move_to_element(clock).perform()
    page.until("return document.querySelectorAll('.line.faint').length > 0")
    alone = page.ask(
        "return [...document.querySelectorAll('.line:not(.faint) .stroke')]"
        ".map(l => getComputedStyle(l).stroke)"
    )
    assert set(alone) == {colours[1]}


def test_memory_is_shown_where_it_is(page, tmp_path) -> None:
    """The bound of a queue, and the role and first value of a register, in the picture and on a click."""
    graph_ = paired.build(a=periodic("10ms"), b=periodic("10ms", phase="5ms"))
    diagram_page(graph_, tmp_path / "paired.html")
    page.open(tmp_path / "paired.html", "[data-drawn]")
    chips = page.texts("text.chip")
    assert any("queue" in words for words in chips), chips
    register = next(words for words in page.texts(".box.register") if "held" in words)
    assert "delay" in register
    page.find(".box.register .body").send_keys(Keys.ENTER)
    details = page.until("return document.querySelector('.details').innerText")
    assert "Register, delay" in details
    assert "7.25" in details
    page.is_quiet()


def test_a_port_tells_by_focus_what_it_carries(page, pages) -> None:
    page.open(pages["ins_eskf"][0], "[data-drawn]")
    page.find(".box.source .body").send_keys(Keys.TAB)
    tip = page.until("const t = document.querySelector('.tip'); return !t.hidden && t.innerText")
    assert tip.splitlines() == [
        "imu: Imu", "  gyro: real 3, rad/s, body", "  specific_force: real 3, m/s^2, body", "clock: imu",
        "rate: 200 Hz",
    ]  # fmt: skip


def test_feedback_takes_little_room(page, pages) -> None:
    page.open(pages["ins_eskf"][0], "[data-drawn]")
    size = page.ask(
        "const all = document.querySelector('svg.diagram > g').getBBox();"
        "const boxes = document.querySelector('.boxes').getBBox();"
        "return [all.width * all.height, boxes.width * boxes.height,"
        " document.querySelectorAll('.line.feedback').length]"
    )
    assert size[2] == 1
    assert size[0] < 1.3 * size[1]


def test_a_page_prints_on_white_without_its_tools(page, pages) -> None:
    look(page, "dark")
    page.open(pages["ins_eskf"][0], "[data-drawn]")
    page.chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    style = "return getComputedStyle(document.querySelector(arguments[0]))[arguments[1]]"
    assert page.ask(style, "body", "backgroundColor") == "rgb(255, 255, 255)"
    assert page.ask(style, ".tools", "display") == "none"
    page.chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    printed = page.chrome.execute_cdp_cmd("Page.printToPDF", {"landscape": True})["data"]
    assert len(printed) > 20_000


@pytest.mark.parametrize(("name", "scheme"), [("ins_eskf", "light"), ("rbpf_outdoor", "dark")])
def test_run(name, scheme, page, pages) -> None:
    _, file, case, result = pages[name]
    assert file.stat().st_size < 10_000_000
    look(page, scheme)
    page.open(file, "[data-shown]")
    assert page.texts(".notes li.wrong")[0] == "warning: a <b>note</b>"
    groups = {words.lower() for words in page.texts(".scopes h3")}
    assert {"errors", "estimate", "innovations", "consistency", "figures", "time of each block"} <= groups
    assert ("particles" in groups) == (name == "rbpf_outdoor")
    assert bool(page.texts(".plan")) == (name == "rbpf_outdoor")
    page.until("return document.querySelectorAll('.scope canvas').length > 0")
    blank = (
        "const c = document.querySelector('.scope canvas'); const d = c.getContext('2d');"
        "return new Set(new Uint32Array(d.getImageData(0, 0, c.width, c.height).data.buffer)).size"
    )
    assert page.ask(blank) > 10

    # At the time of the slider each wire shows what it carried then, and the plots what they read.
    at = page.slide(0.6)
    estimate = result[case.estimate]
    begin = min(s.time[0] for s in case.inputs.values())
    seconds = (estimate.time - begin) * 1e-9
    row = int(np.searchsorted(seconds, at + 1e-6, side="right")) - 1
    shown = page.ask(
        "return [...document.querySelectorAll('.scope')].find(s => s.textContent.startsWith('position x'))"
        ".querySelector('.reading').textContent"
    )
    read = float(shown.split("estimate ")[1].split()[0])
    assert read == pytest.approx(float(estimate["position"][row, 0]), rel=2e-3, abs=1e-4)
    wires = page.texts("text.value")
    assert len(wires) > 5
    assert all(w for w in wires)
    wide = "return [...document.querySelectorAll('text.value')].map(t => t.getBBox().width)"
    for share in (0.1, 0.4, 0.6):
        page.slide(share)
        assert max(page.ask(wide)) <= 120.0  # the room that is left beside a wire
    imu = page.ask("const d = diagram.options.values(0, 0); return [d.short, d.lines[0], d.lines[1]]")
    stamp = float(imu[1].split()[1])
    streams = case.inputs["imu"]
    k = int(np.searchsorted((streams.time - begin) * 1e-9, stamp + 1e-5, side="right")) - 1
    told = [float(x) for x in imu[2].split(":")[1].split(" rad/s")[0].split(",")]
    np.testing.assert_allclose(told, streams["gyro"][k], rtol=2e-3, atol=1e-4)
    before = page.texts("text.value")
    page.slide(0.2)
    assert page.texts("text.value") != before
    if name == "rbpf_outdoor":
        assert "40 of 40 particles" in page.find(".space .words").text
        assert "gps" in page.find(".plan .words").text

    slider = page.find("input[type=range]")
    then = float(slider.get_attribute("value"))
    slider.send_keys(Keys.ARROW_RIGHT)
    assert then < float(slider.get_attribute("value")) < then + 0.1
    page.is_accessible()
    page.is_quiet()


def test_runs_are_picked_and_compared(page, pages) -> None:
    page.open(pages["ins_eskf"][1], "[data-shown]")
    assert page.texts("select[aria-label=Run] option") == ["the first", "the second"]
    page.ask(
        "const s = document.querySelector('select[aria-label=\"Compare with\"]'); s.value = 1;"
        "s.dispatchEvent(new Event('change'))"
    )
    page.until("return document.querySelectorAll('.figures thead th').length === 2")
    assert page.texts(".figures thead th") == ["the first", "the second"]
    assert page.texts(".figures tbody td") == ["0.25", "0.25"]
    page.is_quiet()


def test_a_way_far_from_the_origin_is_in_the_picture(page, pages, tmp_path) -> None:
    belief, truth = flown(300)
    far = np.array([5e4, -3e4, 800.0])
    way = np.cumsum(belief["position"], axis=0) + far
    moved = Series(belief.time, belief.values.replace(position=way), name="belief")
    still = Series(truth.time, truth.values.replace(position=way + 0.1), name="truth")
    run = describe_run(
        pages["ins_eskf"][2].graph, result_of(belief=moved), title="far", estimate="belief", truth=still
    )
    run_page([run], tmp_path / "far.html")
    look(page, "light")
    page.open(tmp_path / "far.html", "[data-shown]")
    page.slide(0.5)

    def blue() -> int:
        """Pixels of the line of the estimate."""
        seen = page.find(".frame3d canvas").screenshot_as_png
        picture = cv2.imdecode(np.frombuffer(seen, np.uint8), 1)
        assert picture is not None
        return int((picture[..., 0].astype(int) - picture[..., 2] > 60).sum())

    once(lambda: blue() > 100, "a line in the picture")


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The page of a study with two of its runs, and of its comparison with itself."""
    pytest.importorskip("pyarrow")
    folder = tmp_path_factory.mktemp("study")
    noises = [0.005, 0.01, 0.05]
    study = Study(
        graphs=["ekf", "ins_eskf"], data=["sim"], seeds=2,
        parameters={"duration": 1.5, "imu.rate": 50, "position_noise": noises},
    )  # fmt: skip
    run_study(study, folder)
    return {
        "study": write_report(folder, runs=3).page,
        "comparison": write_comparison(folder, folder, folder / "both").page,
    }


def test_a_report_leads_to_its_runs(page: Page, reports: dict[str, Path]) -> None:
    assert reports["study"].stat().st_size < 10_000_000
    look(page, "dark")
    page.open(reports["study"], "[data-shown]")
    assert page.ask("return [...document.querySelectorAll('.chart canvas')].length") == 2
    assert page.ask("return getComputedStyle(document.querySelector('figure img')).display") == "none"
    titles = page.texts("select[aria-label=Run] option")
    assert len(titles) == 3
    chart = reader_of(reports["study"]).data("charts")[0]
    dot = next(d for s in chart["series"] for d in s["dots"] if d["run"] not in (0, None))
    place = page.ask(
        "const [x, y] = arguments, plot = document.querySelector('.chart .u-over');"
        "plot.scrollIntoView({block: 'center'}); const box = plot.getBoundingClientRect();"
        "return [box.width, box.height]",
        dot["x"], dot["y"],
    )  # fmt: skip
    assert place[0] > 600
    found = page.ask(
        "const plot = document.querySelector('.chart .u-over'), box = plot.getBoundingClientRect();"
        "const told = document.querySelector('.chart .words');"
        "for (let y = 0; y < box.height; y += 3) for (let x = 0; x < box.width; x += 6) {"
        "  const at = {clientX: box.left + x, clientY: box.top + y, bubbles: true};"
        "  plot.dispatchEvent(new MouseEvent('mousemove', at));"
        "  if (told.textContent === arguments[0]) {"
        "    for (const kind of ['mousedown', 'mouseup', 'click'])"
        "      plot.dispatchEvent(new MouseEvent(kind, at));"
        "    return true; } }"
        "return false",
        dot["words"],
    )
    assert found
    page.until("return document.querySelector('main').dataset.shown === arguments[0]", str(dot["run"]))
    assert page.ask("return document.querySelector('select[aria-label=\"Compare with\"]').value") == "0"
    assert len(page.texts(".figures thead th")) == 2
    page.slide(0.5)
    assert len(page.texts("text.value")) > 5

    heads = page.texts(".table button.sort")
    column = heads.index("q50")
    page.ask("document.querySelectorAll('.table button.sort')[arguments[0]].click()", column)
    sorted_ = [float(x) for x in page.texts(f".table table tr td:nth-child({column + 1})")[: len(titles)]]
    assert sorted_ == sorted(sorted_)
    assert page.ask("return document.querySelector('th[aria-sort]').textContent") == "q50"
    page.is_accessible()
    page.is_quiet()


def test_a_comparison_has_its_names_whole(page: Page, reports: dict[str, Path]) -> None:
    look(page, "light")
    page.open(reports["comparison"], "[data-charted]")
    names = reader_of(reports["comparison"]).data("charts")[0]["y"]["names"]
    assert len(names) > 10
    page.until("return document.querySelectorAll('.chart canvas').length === 1")
    longest = page.ask(
        "const c = document.createElement('canvas').getContext('2d'); c.font = '11px system-ui';"
        "return Math.max(...arguments[0].map(n => c.measureText(n).width))",
        names,
    )
    room = page.ask(
        "const p = document.querySelector('.chart .u-over').getBoundingClientRect(),"
        " h = document.querySelector('.chart .canvas').getBoundingClientRect(); return p.left - h.left"
    )
    assert longest < room - 8
    page.is_accessible()
    page.is_quiet()


def test_a_report_prints_with_its_pictures(page: Page, reports: dict[str, Path]) -> None:
    page.open(reports["comparison"], "[data-charted]")
    page.chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    style = "return getComputedStyle(document.querySelector(arguments[0])).display"
    assert page.ask(style, "figure img") == "block"
    assert page.ask(style, ".chart") == "none"
    page.chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


def test_a_run_is_watched_while_it_goes_on(page, pages) -> None:
    case = pages["ins_eskf"][2]
    look(page, "light")
    with LiveServer(live_page(case.graph, case.inputs, "a run")) as server:
        page.chrome.get_log("performance")
        page.chrome.get(server.url)
        assert server.wait(True, 120.0)
        simulate_watched(case.graph, case.inputs, Sender(server, case.graph, case.inputs, speed=2.0))
        page.until("return document.querySelector('[data-ended]') !== null")
        assert page.find("output").text.startswith("ended at 3.000 s")
        page.until("return document.querySelectorAll('text.value').length > 5")
        assert all(page.texts("text.value"))
        assert any(words.startswith("belief: position [m]") for words in page.texts(".scope h4"))
        page.is_accessible()
        assert [e for e in page.chrome.get_log("browser") if e["level"] == "SEVERE"] == []
        asked = [json.loads(e["message"])["message"] for e in page.chrome.get_log("performance")]
        urls = {
            m["params"]["request"]["url"] for m in asked if m["method"] == "Network.requestWillBeSent"
        } | {m["params"]["url"] for m in asked if m["method"] == "Network.webSocketCreated"}
        assert {url for url in urls if not url.startswith("data:")} == {
            server.url, server.url.replace("http", "ws") + "live",
        }  # fmt: skip
        page.chrome.get("about:blank")
        assert server.wait(False, 120.0)

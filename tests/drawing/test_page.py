"""Pages of graphs: what is in them, that all that people write stays text, and what they weigh."""

from __future__ import annotations

import html.parser
import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowgraph import Graph, Stream, aperiodic, block, collect, delay, graph, latest, match, periodic
from flowgraph.drawing.draw import draw
from flowgraph.drawing.model import array_words, describe
from flowgraph.drawing.page import data_text, diagram_page
from flowgraph.errors import DeclarationError, OutputError
from flowgraph.pipeline.costs.places import costs_by_path
from flowgraph.types import Scalar
from tests.drawn import Fix, Imu, core

HOSTILE = 'a</script><script>alert("x")</script>\'"\n<!-- ]]> &lt; \\ \u2028 \x07 é'


@block
def smooth(state: Any, value: Scalar, *, gain: float = 0.5):
    """x' = x + gain (value - x).

    Source: a book, p. 3.
    """
    return state + gain * (value - state), state


@smooth.init
def _(value, *, gain):
    return np.float64(2.5)


@graph
def inner(value: Stream[Scalar]):
    return smooth(value, name="smooth")


@graph
def looped(value: Stream[Scalar], other: Stream[Scalar], *, start: float = 1.0):
    """A loop."""
    before = delay(start, name="before")
    kept = latest(other, init=7.0, name="kept")
    made = inner(value)
    both = made + before + kept
    before.feed(both)
    collect(match(value, other, tolerance="1ms", size=4, name="pairs").map(lambda p: p[0]), "paired")
    return {"both": both}


def built() -> Graph:
    return looped.build(value=periodic("5ms"), other=aperiodic(max_rate=10))


class _Reader(html.parser.HTMLParser):
    """The elements of a page and what stands in each script."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.text: list[str] = []
        self._open: dict[str, str | None] | None = None
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._open = dict(attrs) if tag == "script" else None

    def handle_endtag(self, tag: str) -> None:
        self._open = None

    def handle_data(self, data: str) -> None:
        if self._open is None:
            self.text.append(data)
        else:
            self.scripts.append((self._open, data))

    def data(self, name: str) -> Any:
        return json.loads("".join(text for attributes, text in self.scripts if attributes.get("id") == name))


def by_path(made: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {node["path"]: node for node in made["nodes"] if node is not None}


def test_all_that_a_reader_asks_is_in_the_description() -> None:
    made = describe(built(), costs_by_path(built()))
    nodes = by_path(made)
    assert made["name"] == "looped"
    assert made["settings"] == [["start", "1.0"]]
    assert [s["path"] for s in made["scopes"]] == ["inner"]

    smoothed = nodes["inner/smooth"]
    assert smoothed["doc"] == "x' = x + gain (value - x).\n\nSource: a book, p. 3."
    assert re.fullmatch(r"tests/drawing/test_page\.py:\d+", smoothed["source"])
    line = int(smoothed["source"].rpartition(":")[2])
    assert Path(__file__).read_text().splitlines()[line - 1 : line + 1] == [
        "@block",
        "def smooth(state: Any, value: Scalar, *, gain: float = 0.5):",
    ]
    assert smoothed["settings"] == [["gain", "0.5"]]
    assert smoothed["state"]["initially"] == [["value", "2.5"]]
    assert smoothed["costs"]["operations"] == 4  # three of the step, and the choice of the new state
    assert nodes["before"]["role"] == "delay"
    assert nodes["before"]["initially"] == [["value", "1"]]
    assert {"format": "float64", "bytes": 8}.items() <= nodes["before"]["costs"].items()
    assert nodes["kept"]["initial"] == "7"
    assert nodes["pairs"]["queue"] == "queues ≤ 4, within 1 ms"
    clocks = {clock["words"]: clock["rate"] for clock in made["clocks"]}
    assert clocks["value"] == "200 Hz"
    assert clocks["other"] == "≤ 10 Hz"

    edges = [e for e in made["edges"] if e["feedback"]]
    assert [made["nodes"][e["to"]]["path"] for e in edges] == ["before"]


def test_units_frames_and_shapes_of_a_port() -> None:
    made = describe(drawn())
    source = by_path(made)["imu"]["outs"][0]
    gyro = made["types"][source["type"]]["leaves"][0]
    assert gyro == {"name": "gyro", "shape": [3], "dtype": "real", "unit": "rad/s", "frame": "body"}


def drawn() -> Graph:
    @graph
    def around(imu: Stream[Imu], fix: Stream[Fix]):
        belief, _ = core(imu, fix)
        return {"belief": belief}

    return around.build(imu=periodic("5ms"), fix=aperiodic(max_rate=10))


def test_a_page_is_one_file_that_asks_for_nothing(tmp_path: Path) -> None:
    file = tmp_path / "folder" / "graph.html"
    assert built().draw(str(file)) == file
    page = file.read_text()
    assert len(page.encode()) < 3_000_000
    reader = _Reader(page)
    asked = [a for _, attributes in reader.tags for k, a in attributes.items() if k in ("src", "href")]
    assert asked == ["data:,"]
    policy = next(
        a["content"] for tag, a in reader.tags if tag == "meta" and "content" in a and "http-equiv" in a
    )
    assert policy is not None
    assert policy.startswith("default-src 'none';")
    assert "url(" not in page[: page.index("<body")]
    assert reader.data("graph") == describe(built())
    assert "Eclipse Public License" in page


@pytest.mark.parametrize("where", ["name", "doc", "setting", "block", "output"])
def test_what_people_write_is_text(where: str) -> None:
    """In a page and in an SVG: no element comes of it, and it can be read as it was written."""
    plain = "plain"
    texts = {k: HOSTILE if k == where else plain for k in ("name", "doc", "setting", "block", "output")}

    @block
    def step(value: Scalar, *, label: str):
        return value

    step.__doc__ = texts["doc"]

    def hostile(value: Stream[Scalar]):
        collect(step(value, label=texts["setting"], name=texts["block"]), texts["output"])

    hostile.__doc__ = texts["doc"]
    hostile.__name__ = texts["name"]
    try:
        one = graph(hostile).build(value=periodic("5ms"))
    except DeclarationError:
        assert where == "block"  # a path in messages and files; refused, it is in no page
        return
    reader = _Reader(str(diagram_page(one)))
    assert [tag for tag, _ in reader.tags].count("script") == 3
    assert "alert" not in [tag for tag, _ in reader.tags]
    made = reader.data("graph")
    found = {
        "name": made["name"],
        "doc": made["doc"],
        "block": made["nodes"][1]["path"],
        "setting": made["nodes"][1]["settings"][0][1],
        "output": made["nodes"][2]["name"],
    }
    want = repr(HOSTILE) if where == "setting" else HOSTILE
    assert found[where].split() == want.split()
    svg = ET.fromstring(str(draw(one)))  # it is an SVG still, and has no element that a script could be in
    assert not [e for e in svg.iter() if e.tag.rpartition("}")[2] in ("script", "foreignObject")]
    if where in ("block", "output"):
        assert "alert" in "".join(svg.itertext())


def test_json_in_a_page_ends_no_script() -> None:
    text = data_text({HOSTILE: HOSTILE})
    assert json.loads(text) == {HOSTILE: HOSTILE}
    assert not set(text) & set("<>&\u2028\n")


def test_folded_as_asked() -> None:
    assert _Reader(str(diagram_page(built(), fold=0))).data("begin") == {"folded": ["inner"]}
    assert _Reader(str(diagram_page(built(), rankdir="TB"))).data("begin") == {"down": True}
    with pytest.raises(DeclarationError, match="fold is a depth"):
        diagram_page(built(), fold=-1)


def test_a_page_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        diagram_page(built(), tmp_path / "file" / "graph.html")


def test_why_a_graph_has_no_costs() -> None:
    @block(host=True)
    def show(value: Scalar) -> Scalar:
        return value

    @graph
    def hosted(value: Stream[Scalar]):
        return {"shown": show(value)}

    found = costs_by_path(hosted.build(value=periodic("5ms")))
    assert list(found) == [""]
    assert found[""]["cannot be lowered"].startswith("show: ")


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.float64(2.5), "2.5"),
        (np.array([1.0, 2.0]), "[1, 2]"),
        (3 * np.eye(15), "15 × 15, 3 on the diagonal"),
        (np.zeros((4, 100)), "4 × 100, all 0"),
        (np.arange(12.0), "12, from 0 to 11"),
        (np.full(20, np.nan), "20, none a number"),
        (np.zeros((0, 3)), "[]"),
    ],
)
def test_arrays_in_few_characters(array: np.ndarray, words: str) -> None:
    assert array_words(array) == words

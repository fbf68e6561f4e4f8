"""The block diagram: what it shows, that it nests and escapes, and that it needs no `dot` program."""

from __future__ import annotations

import builtins
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    DeclarationError,
    Flight,
    FlowgraphError,
    Graph,
    MissingDependencyError,
    Series,
    Stream,
    UnknownNameError,
    aperiodic,
    every,
    graph,
    latest,
    match,
    merge,
    periodic,
    sink,
)
from flowgraph.data.arrival import delayed
from flowgraph.drawing.draw import dot_source, draw, to_networkx
from flowgraph.drawing.page import diagram_page
from flowgraph.types import Scalar
from tests.drawn import Fix, Imu, core

SVG = "{http://www.w3.org/2000/svg}"


@graph
def middle(imu: Stream[Imu], fix: Stream[Fix]):
    return core(imu, fix)


@graph
def filter_graph(imu: Stream[Imu], fix: Stream[Fix]):
    """A small filter & its <display>."""
    belief, innovation = middle(every(5, imu), fix)
    sink(innovation, print, name="display")
    return {"belief": belief}


def built() -> Graph:
    return filter_graph.build(imu=periodic("5ms"), fix=aperiodic(max_rate=10))


def svg_of(graph: Graph, **options: Any) -> ET.Element:
    return ET.fromstring(str(draw(graph, **options)))


def groups(svg: ET.Element, kind: str) -> dict[str, ET.Element]:
    """The groups of one class ("node", "edge", "cluster") by title."""
    found = [g for g in svg.iter(f"{SVG}g") if g.get("class") == kind]
    return {g.findtext(f"{SVG}title", ""): g for g in found}


def words(element: ET.Element) -> list[str]:
    return ["".join(t.itertext()).strip().replace("\xa0", " ") for t in element.iter(f"{SVG}text")]


def test_the_svg_names_sources_blocks_registers_and_outputs():
    svg = svg_of(built())
    assert set(groups(svg, "node")) == {
        "imu", "fix", "every", "middle/core/belief", "middle/core/control", "middle/core/predict",
        "middle/core/aid", "display", "output: belief",
    }  # fmt: skip
    text = words(svg)
    for name in (
        "filter_graph",
        "A small filter & its <display>.",
        "imu",
        "predict",
        "aid",
        "display",
        "belief",
    ):
        assert name in text


def test_wires_say_type_and_clock():
    text = words(svg_of(built()))
    assert "Imu, 200 Hz" in text
    assert "Fix, ≤ 10 Hz" in text
    assert "every(5, imu)" in " ".join(text)


def test_a_block_says_at_which_clock_it_fires_where_the_inputs_do_not():
    nodes = groups(svg_of(built()), "node")
    assert "at every(5, imu) | fix" in words(nodes["middle/core/predict"])
    assert not any(w.startswith("at ") for w in words(nodes["middle/core/aid"]))


def test_ports_are_named_where_there_are_several():
    nodes = groups(svg_of(built()), "node")
    assert sorted(words(nodes["middle/core/aid"])) == ["aid", "belief", "measured?", "out", "prior"]
    assert words(nodes["every"])[0] == "every"
    assert "x" not in words(nodes["every"])


def test_registers_name_their_role_and_initial_value():
    nodes = groups(svg_of(built()), "node")
    assert words(nodes["middle/core/belief"]) == ["belief", "delay, init zeros"]
    assert words(nodes["middle/core/control"]) == ["control", "latest, init given"]
    assert "state int32, init 0" in words(nodes["every"])


def test_the_feedback_edge_is_dashed_and_no_other():
    edges = groups(svg_of(built()), "edge")
    dashed = {
        t for t, g in edges.items() if any("stroke-dasharray" in p.attrib for p in g.iter(f"{SVG}path"))
    }
    assert len(dashed) == 1
    (title,) = dashed
    assert "middle/core/belief" in title
    assert "middle/core/aid" in title


def test_an_optional_input_has_a_hollow_arrow():
    lines = dot_source(built()).splitlines()
    (fix,) = [line for line in lines if line.startswith('"fix"') and "->" in line]
    assert 'arrowhead="onormal"' in fix
    assert sum("onormal" in line for line in lines) == 1


def test_a_delay_that_is_no_feedback_keeps_the_direction_of_flow():
    @graph
    def difference(x: Stream[Scalar]):
        return x - x.delay(0.0, name="before")

    (edge,) = [
        line for line in dot_source(difference.build()).splitlines() if "dashed" in line and "->" in line
    ]
    assert edge.startswith('"x":e -> "before"')
    assert "dir=" not in edge


def test_clusters_nest():
    pygraphviz = pytest.importorskip("pygraphviz")
    drawn = pygraphviz.AGraph(string=dot_source(built()))
    (outer,) = drawn.subgraphs()
    assert outer.name == "cluster middle"
    (inner,) = outer.subgraphs()
    assert inner.name == "cluster middle/core"
    assert set(inner.nodes()) == {f"middle/core/{n}" for n in ("belief", "control", "predict", "aid")}
    assert set(groups(svg_of(built()), "cluster")) == {"cluster middle", "cluster middle/core"}


def test_fold_draws_nested_graphs_as_one_box():
    folded = svg_of(built(), fold=0)
    assert set(groups(folded, "node")) == {"imu", "fix", "every", "middle", "display", "output: belief"}
    assert words(groups(folded, "node")["middle"]) == ["middle", "2 blocks"]
    assert groups(folded, "cluster") == {}
    assert set(groups(svg_of(built(), fold=1), "cluster")) == {"cluster middle"}
    assert "middle/core" in groups(svg_of(built(), fold=1), "node")
    assert dot_source(built(), fold=2) == dot_source(built())


def test_links_into_a_folded_box_that_carry_the_same_are_one():
    @graph
    def twice(x: Stream[Scalar]):
        return x.map(lambda v: v + 1) + x

    @graph
    def outer(x: Stream[Scalar]):
        return twice(x)

    edges = [line for line in dot_source(outer.build(), fold=0).splitlines() if "->" in line]
    assert len(edges) == 2


@pytest.mark.parametrize("rankdir", ["LR", "TB", "RL", "BT"])
def test_all_directions_are_laid_out(rankdir):
    assert set(groups(svg_of(built(), rankdir=rankdir), "node")) == set(groups(svg_of(built()), "node"))


def test_queue_bounds_are_shown():
    @graph
    def paired(a: Stream[Scalar], b: Stream[Scalar]):
        return match(a, b, tolerance="5ms", size=6)

    nodes = groups(svg_of(paired.build()), "node")
    assert "queues ≤ 6, within 5 ms" in words(nodes["match"])


def test_a_source_that_only_fires_something_is_connected():
    @graph
    def sampled(x: Stream[Scalar], when: Stream[Scalar]):
        return merge(latest(x, init=0.0, at=when).map(lambda v: 2 * v), x, tie="left")

    dotted = [line for line in dot_source(sampled.build()).splitlines() if "dotted" in line and "->" in line]
    assert len(dotted) == 1
    assert '"when":e -> "sample"' in dotted[0]


@pytest.mark.parametrize("name", ['a<b>&"c"|d', "back\\slash\\", "{x}", "&lt;", "ünïcode →", "]]>"])
def test_any_name_is_drawn_as_it_is_written(name):
    @graph
    def odd(x: Stream[Scalar]):
        return {name: x.map(lambda v: v + 1, name=name)}

    svg = svg_of(odd.build())
    assert words(svg).count(name) == 2  # the block and the output


def test_the_tooltip_is_the_first_line_of_the_docstring():
    tips = [a.get("{http://www.w3.org/1999/xlink}title") for a in svg_of(built()).iter(f"{SVG}a")]
    assert "middle/core/predict: Carry the belief to now." in tips
    assert "fix → middle/core/aid.measured: Fix, ≤ 10 Hz" in tips


@pytest.mark.parametrize(
    ("ending", "start"),
    [(".svg", b"<?xml"), (".png", b"\x89PNG"), (".pdf", b"%PDF"), (".gv", b"digraph"), (".dot", b"digraph")],
)
def test_the_ending_says_what_is_written(tmp_path, ending, start):
    file = tmp_path / "new" / "folder" / f"diagram{ending}"
    assert draw(built(), file) == file
    assert file.read_bytes().startswith(start)


def test_drawing_needs_no_dot_program(tmp_path, monkeypatch):
    pytest.importorskip("pygraphviz")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "predict" in words(svg_of(built()))
    for ending in ("png", "pdf"):
        assert Path(draw(built(), tmp_path / f"d.{ending}")).stat().st_size > 1000


def test_with_a_dot_program_the_graphviz_package_is_used(monkeypatch):
    import graphviz

    calls = []

    def pipe(self, **options):
        calls.append(options["format"])
        return b"<svg/>"

    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/dot")
    monkeypatch.setattr(graphviz.Source, "pipe", pipe)
    assert draw(built()) == "<svg/>"
    assert calls == ["svg"]


def test_without_any_layout_engine_the_error_says_what_to_install(monkeypatch):
    true_import = builtins.__import__

    def without(name, *args, **more):
        if name == "pygraphviz":
            raise ImportError(name)
        return true_import(name, *args, **more)

    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError) as caught:
        draw(built())
    assert "pip install pygraphviz" in str(caught.value)


BROKEN = "#!/bin/sh\n/bin/cat >/dev/null\necho 'Format: \"svg\" not recognized.' >&2\nexit 1\n"


@pytest.mark.parametrize("script", [BROKEN, "#!/bin/sh\nkill -9 $$\n", "no program at all"])
def test_a_dot_program_that_fails_is_replaced_or_named(script, tmp_path, monkeypatch):
    dot = tmp_path / "dot"
    dot.write_text(script)
    dot.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))  # and no other dot
    pytest.importorskip("pygraphviz")
    assert str(draw(built())).startswith("<svg")
    monkeypatch.setitem(sys.modules, "pygraphviz", None)
    with pytest.raises(MissingDependencyError, match="nothing here can lay out") as caught:
        draw(built())
    assert "a dot program that fails" in str(caught.value)
    if script == BROKEN:
        assert "not recognized" in str(caught.value)


def test_a_chain_too_long_for_a_png_is_refused_and_an_svg_is_not(tmp_path):
    @graph
    def chain(x: Stream[Scalar]):
        for k in range(150):
            x = x.map(lambda v: v + 1, name=f"a_step_whose_name_is_long_{k}")
        return x

    built = chain.build(x=periodic("5ms"))
    with pytest.raises(DeclarationError, match="too large for a PNG"):
        draw(built, tmp_path / "chain.png")
    assert not (tmp_path / "chain.png").exists()
    draw(built, tmp_path / "chain.svg")


def test_an_unknown_ending_lists_the_valid_ones(tmp_path):
    with pytest.raises(FlowgraphError) as caught:
        draw(built(), tmp_path / "diagram.jpeg")
    assert isinstance(caught.value, UnknownNameError)
    assert "one of .dot, .gv, .html, .pdf, .png, .svg" in str(caught.value)
    assert "'.jpeg'" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_direction_and_a_negative_fold_are_refused():
    with pytest.raises(UnknownNameError, match="no rankdir is called 'left'"):
        draw(built(), rankdir="left")
    with pytest.raises(DeclarationError, match="fold is a depth of nesting"):
        draw(built(), fold=-1)


def test_networkx_has_the_whole_graph_and_its_only_cycles_are_feedback():
    import networkx

    made = to_networkx(built())
    assert made.nodes["imu"] == {"kind": "source", "type": "Imu", "clock": "imu", "outputs": ()}
    assert made.nodes["middle/core/aid"]["outputs"] == ("belief",)
    assert made.nodes["middle/core/belief"]["kind"] == "delay"
    assert made.nodes["every.state"]["kind"] == "state"
    (edge,) = made.get_edge_data("fix", "middle/core/aid").values()
    assert edge == {
        "type": "Fix", "clock": "fix", "output": "", "port": "measured", "optional": True, "feedback": False,
    }  # fmt: skip
    back = [(u, v) for u, v, f in made.edges(data="feedback") if f]
    assert set(back) == {("middle/core/aid", "middle/core/belief"), ("every", "every.state")}
    assert not networkx.is_directed_acyclic_graph(made)
    made.remove_edges_from(back)
    assert networkx.is_directed_acyclic_graph(made)


def test_importing_flowgraph_and_describing_a_graph_load_no_drawing_library():
    program = (
        "import sys, flowgraph, flowgraph.drawing.draw, flowgraph.drawing.text, flowgraph.drawing.plot\n"
        "print([m for m in ('graphviz', 'pygraphviz', 'networkx', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_source_whose_values_arrive_late_says_so_in_every_drawing():
    @graph
    def read(early: Stream[Scalar], fixed: Stream[Scalar], loose: Stream[Scalar]):
        return {"early": early, "fixed": fixed, "loose": loose}

    made, times = read.build(), np.arange(3) * 10**9
    late = {
        "early": Series(times, np.zeros(3)),
        "fixed": delayed(Series(times, np.zeros(3)), "135ms"),
        "loose": delayed(Series(times, np.zeros(3)), np.array([0, 10**8, 2 * 10**8])),
    }
    said = {"fixed": "0.135 s late", "loose": "0 to 0.2 s late"}
    nodes = groups(svg_of(made, inputs=late), "node")
    assert {n: words(nodes[n])[1:] for n in late} == {
        "early": [],
        "fixed": [said["fixed"]],
        "loose": [said["loose"]],
    }
    lines = made.text(inputs=late).splitlines()
    assert [next(line for line in lines if f"▷ {n} " in line).split("aperiodic")[1] for n in late] == [
        "", ", 0.135 s late", ", 0 to 0.2 s late",
    ]  # fmt: skip
    page = str(diagram_page(made, inputs=Flight("f", late)))
    assert all(f"aperiodic, {words}" in page for words in said.values())
    assert "late" not in made.text()

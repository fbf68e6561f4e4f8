"""What other packages offer is found by name; what cannot be imported is named and breaks nothing else."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from typer.testing import CliRunner

from flowgraph import DeclarationError, PluginError, UnknownNameError, find_graph, load_flight
from flowgraph.cli import app
from flowgraph.data.registry import KINDS, find_bench, find_entry, graph_names, installed
from flowgraph.engines.registry import find_engine, find_pipeline_engine, writers
from tests.support import Install

GOOD = '''
from flowgraph import Report, Scalar, Series, Stream, graph


@graph
def doubled(x: Stream[Scalar]):
    """Twice what comes."""
    return x * 2.0


def halves(*, count: int = 2) -> Report:
    """Halve numbers."""
    return Report([{"half": n / 2} for n in range(count)])
'''


def invoke(*arguments: str):
    return CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"}).invoke(app, arguments)


CAUSES = {
    "raise ImportError('first line\\nsecond line')": "ImportError: first line second line",
    "import no_such_library_here": "ModuleNotFoundError: No module named 'no_such_library_here'",
    "def (": "SyntaxError: invalid syntax",
    "1 / 0": "ZeroDivisionError: division by zero",
    "raise SystemExit('bye')": "SystemExit: bye",
    "other = 1": "AttributeError: module 'broken_module' has no attribute 'thing'",
}


@pytest.mark.parametrize(("text", "cause"), CAUSES.items())
@pytest.mark.parametrize(
    ("group", "find"),
    [
        ("flowgraph.graphs", find_graph),
        ("flowgraph.flights", lambda name: load_flight(f"{name}:anything")),
        ("flowgraph.benches", find_bench),
        ("flowgraph.engines", find_engine),
    ],
)
def test_what_cannot_be_imported_is_an_error_of_ours(install: Install, group, find, text, cause):
    install("broken-plug", {"broken_module": text}, {group: {"broken": "broken_module:thing"}})
    with pytest.raises(PluginError) as caught:
        find("broken")
    error = caught.value
    assert error.path == "broken"
    assert error.message == f"this {KINDS[group]} cannot be loaded"
    assert error.expected == "broken_module:thing of broken-plug"
    assert str(error.got).startswith(cause)
    assert "\n" not in str(error.got)
    assert error.fix == "mend broken-plug, or uninstall it"
    assert type(error.__cause__).__name__ == cause.partition(":")[0]


def test_what_another_package_offers_is_found_as_ours_is(install: Install):
    groups = {
        "flowgraph.graphs": {"doubled": "good_module:doubled"},
        "flowgraph.benches": {"h": "good_module:halves"},
    }
    install("good-plug", {"good_module": GOOD}, groups)
    assert {"doubled", "ins_eskf"} <= set(graph_names())
    assert find_graph("doubled").__doc__ == "Twice what comes."
    assert invoke("list").stdout.count("Twice what comes") == 1
    assert '"half": 0.5' in invoke("bench", "h", "--json").stdout


def test_a_broken_package_is_named_and_the_rest_is_listed(install: Install):
    before = json.loads(invoke("list", "--json").stdout)
    groups = {group: {f"broken_{k}": "broken_module:thing"} for k, group in enumerate(KINDS)}
    install("broken-plug", {"broken_module": "import no_such_library_here"}, groups)
    reason = "ModuleNotFoundError: No module named 'no_such_library_here'"
    expected = [
        f"warning: broken_{k}: this {kind} cannot be loaded: broken_module:thing of broken-plug: {reason}"
        for k, kind in enumerate(KINDS.values())
    ]
    for arguments in (("list",), ("list", "--json")):
        done = invoke(*arguments)
        assert done.exit_code == 0
        assert done.stderr.splitlines() == expected
    assert json.loads(done.stdout) == before
    benches = invoke("bench")
    assert benches.exit_code == 0
    assert "apriltag" in benches.stdout
    assert benches.stderr.splitlines() == [expected[list(KINDS).index("flowgraph.benches")]]
    assert installed("flowgraph.graphs")[0].keys() == {row["graph"] for row in before["rows"]}


def test_a_broken_engine_is_in_no_other_engines_way(install: Install):
    before = writers()
    install(
        "broken-plug", {"broken_module": "1 / 0"}, {"flowgraph.engines": {"broken": "broken_module:thing"}}
    )
    assert writers() == before
    with pytest.raises(UnknownNameError) as caught:
        find_pipeline_engine("python")
    assert caught.value.valid == ["c", "fixed", "hls", "numpy", "reference", "verilog", "xla"]
    with pytest.raises(PluginError):
        find_pipeline_engine("broken")


def test_a_command_that_needs_a_broken_package_says_so(install: Install):
    install(
        "broken-plug", {"broken_module": "1 / 0"}, {"flowgraph.graphs": {"broken": "broken_module:thing"}}
    )
    done = invoke("show", "broken")
    assert done.exit_code == 1
    assert done.stdout == ""
    assert done.stderr.startswith("error: broken: this graph cannot be loaded\n")
    assert "ZeroDivisionError: division by zero" in done.stderr


@pytest.mark.parametrize(("group", "kind"), KINDS.items())
def test_an_unknown_name_lists_what_there_is(group, kind):
    finders: dict[str, Callable[[str], Any]] = {
        "graph": find_graph,
        "kind of flight": load_flight,
        "bench": find_bench,
        "engine": find_engine,
        "way to make a case": lambda name: find_entry("flowgraph.cases", name),
    }
    find = finders[kind]
    with pytest.raises(UnknownNameError, match=f"no {kind} is called 'nothing'") as caught:
        find("nothing")
    assert caught.value.valid == sorted(installed(group)[0])


@pytest.mark.parametrize("seed", [-1, 1.5, "a", 2**64, True])
def test_a_seed_is_that_of_a_run(seed):
    with pytest.raises(DeclarationError, match="this is no seed"):
        load_flight("sim", seed=seed)

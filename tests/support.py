"""What several test files share: small inputs, and the comparison of engines."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from flowgraph import Graph, Result, Series, simulate

Install = Callable[[str, Mapping[str, str], Mapping[str, Mapping[str, str]]], None]
"""The fixture `install`: (distribution, text by module, {group: {name: "module:object"}})."""

MS = 1_000_000
ENGINES = ("python", "reference", "xla", "c", "numpy")


def scalars(times: Any, values: Any = None) -> Series:
    """Real scalars at times in ns; the k-th is k + 1 where no values are given."""
    stamps = np.asarray(times, dtype=np.int64)
    return Series(stamps, np.arange(1.0, len(stamps) + 1) if values is None else np.asarray(values, float))


def pairs(series: Series) -> list[tuple[int, Any]]:
    """Time and value of each event of a series of scalars."""
    return list(zip(series.time.tolist(), series["value"].tolist(), strict=True))


def same(a: Result, b: Result, *, exact: bool = True) -> None:
    """Outputs, times, state and counts of two results agree, to the same bits or within 1e-9 max(1, |x|)."""
    assert list(a.series) == list(b.series)
    assert a.ticks == b.ticks
    assert dict(a.stats) == dict(b.stats)
    for name in a.series:
        np.testing.assert_array_equal(a[name].time, b[name].time, err_msg=f"times of {name}")
        for leaf, left in a[name].leaves.items():
            close(left, b[name].leaves[leaf], f"{name}.{leaf}", exact)
    same_state(a.state, b.state, exact=exact)


def same_state(a: Mapping[str, Any], b: Mapping[str, Any], *, exact: bool = True) -> None:
    """Two state trees agree."""
    flat_a, flat_b = flat_state(a), flat_state(b)
    assert list(flat_a) == list(flat_b)
    for name, left in flat_a.items():
        assert np.asarray(left).dtype == np.asarray(flat_b[name]).dtype, name
        close(left, flat_b[name], name, exact)


def flat_state(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The arrays of a state tree by joined name."""
    found: dict[str, Any] = {}
    for name, part in tree.items():
        if isinstance(part, Mapping):
            found.update(flat_state(part, f"{prefix}{name}: "))
        else:
            found[prefix + name] = part
    return found


def close(a: Any, b: Any, name: str, exact: bool) -> None:
    if exact or np.asarray(a).dtype.kind != "f":
        np.testing.assert_array_equal(a, b, err_msg=name)
    else:
        assert np.shape(a) == np.shape(b)
        bound = 1e-9 * np.maximum(1.0, np.abs(np.asarray(a)))
        assert (np.abs(np.asarray(a) - np.asarray(b)) <= bound).all(), name


def both_quick(graph: Graph, inputs: Any, **options: Any) -> Result:
    """The result, the same to the bit in the two engines that compile nothing."""
    one, other = (simulate(graph, inputs, engine=e, **options) for e in ENGINES[:2])
    same(one, other)
    return one


def all_engines(graph: Graph, inputs: Any, **options: Any) -> Result:
    """The result, the same in all engines."""
    results = [simulate(graph, inputs, engine=e, **options) for e in ENGINES]
    same(results[0], results[1])
    for other in results[2:]:
        same(results[0], other, exact=False)
    return results[0]


def isolated(
    program: str, *arguments: str, blocked: tuple[str, ...] = ()
) -> subprocess.CompletedProcess[str]:
    """Run a program in a fresh Python in which the `blocked` modules cannot be imported."""
    guard = (
        "import sys\n"
        "class _Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        for blocked in {blocked!r}:\n"
        "            if name == blocked or name.startswith(blocked + '.'):\n"
        "                raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "        return None\n"
        "sys.meta_path.insert(0, _Blocked())\n"
    )
    command = [sys.executable, "-c", guard + program, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)

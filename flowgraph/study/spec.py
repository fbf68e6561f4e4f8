"""A study as data: which graphs run on which flights, with which seeds and parameters, and how.

A study is written in TOML, or as keyword arguments of `Study`; both go through the same checks, and an error
names the key. Every range and every sample is then spelled out: the resolved form lists each seed and each
value, is itself a study, and is kept beside the results. So what was run can be read, and run again, without
knowing how it was drawn.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
import sys
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import InitVar, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.files import text_of
from flowgraph.data.joint import parts_of
from flowgraph.data.own import is_in_file, kind_and_place
from flowgraph.data.registry import find_graph, flight_names, flight_settings
from flowgraph.data.settings import parsed_settings, text
from flowgraph.engines.options import DTYPES, RunOptions
from flowgraph.engines.registry import engine_names, find_engine
from flowgraph.errors import DataError, DeclarationError, FlowgraphError, UnknownNameError
from flowgraph.study.places import absolute, beside, placed_graphs
from flowgraph.study.toml_text import toml_of

Value = bool | int | float | str
Point = Mapping[str, Value]
"""One value a parameter, by name."""

RESERVED = ("graph", "data", "seed", "error", "key", "ticks")
"""Columns of the table that no parameter may be called."""

CHUNK = 32
MOST_RUNS = 10**7
MOST_BYTES = 2**26
"""Of a study's file."""

SCALES = ("linear", "log")


@dataclass(frozen=True)
class Study:
    """Graphs x data x seeds x parameters, and how to run them.

    Args:
        graphs: names, as `flowgraph list` gives them, or FILE.py:NAME; kept with absolute paths.
        data: flights, such as "sim" or "euroc:PATH"; kept with absolute paths.
        seeds: how many (0, 1, ...), or which.
        parameters: settings of graphs or flights by name: one value, a list, `{"linspace": [first, last,
            count]}` or `{"logspace": [first, last, count]}`, whose ends are values. All combinations are run.
            A mapping under the name of a graph holds those of that graph alone.
        sample: points drawn instead of a grid: `{"method": "random" or "sobol", "count": n, "seed": 0,
            "parameters": {name: {"low": a, "high": b, "scale": "linear" or "log"}}}`.
        points: points spelled out, a mapping each. Each goes with each combination of `parameters`.
        engine, dtype: as for `simulate`.
        shard: as for `simulate_many`: among how many devices the runs that go together are shared out, or
            their particles.
        metrics: names of the measures to keep, the first being the one to compare by; all if left out.
        chunk: how many runs go together where the engine can; also the unit of resuming.
        keep: whether to keep whole trajectories.
        out: the folder for results.
        checked: whether each graph is asked for its settings. What only reads results does not ask, for that
            runs the files that graphs and flights are in.

    Raises:
        DeclarationError, UnknownNameError: naming the key.
    """

    graphs: Sequence[str]
    data: Sequence[str]
    seeds: int | Sequence[int] = 1
    parameters: Mapping[str, Any] = field(default_factory=dict)
    sample: Mapping[str, Any] | None = None
    points: Sequence[Point] = ()
    engine: str = "python"
    dtype: str = "float64"
    shard: Mapping[str, int] | None = None
    metrics: Sequence[str] | None = None
    chunk: int = CHUNK
    keep: bool = False
    out: str | None = None
    checked: InitVar[bool] = True

    def __post_init__(self, checked: bool) -> None:
        put: Callable[[str, Any], None] = functools.partial(object.__setattr__, self)
        graphs, parameters = placed_graphs(_names("graphs", self.graphs), self.parameters, Path.cwd())
        put("graphs", tuple(graphs))
        put("parameters", parameters)
        put("data", tuple(absolute(spec, Path.cwd()) for spec in _names("data", self.data)))
        put("seeds", _seeds(self.seeds))
        put("metrics", None if self.metrics is None else _names("metrics", self.metrics))
        _one_of("engine", self.engine, engine_names())
        _one_of("dtype", self.dtype, DTYPES)
        offered = find_engine(self.engine).dtypes
        if self.dtype not in offered:
            wanted = f"{' or '.join(offered)}, for the {self.engine.capitalize()} engine has no other"
            raise _wrong("dtype", wanted, self.dtype)
        put("shard", self._shared())
        if type(self.chunk) is not int or not 1 <= self.chunk <= 2**16:
            raise _wrong("chunk", "a whole number from 1 to 65536", self.chunk)
        if type(self.keep) is not bool:
            raise _wrong("keep", "true or false", self.keep)
        if self.out is not None and not isinstance(self.out, str):
            raise _wrong("out", "the name of a folder", self.out)
        points = [_point(f"points[{k}]", p) for k, p in enumerate(_listed("points", self.points))]
        put("points", _different(points + _drawn(self.sample)))
        put("sample", None)
        grid = _grid(self.parameters, self.graphs)
        put("parameters", grid)
        self._check_names()
        if checked:
            self._check_runs()

    def _shared(self) -> dict[str, int] | None:
        """The share as asked, where the engine has any; how many devices there are is seen when it runs."""
        if not self.shard and isinstance(self.shard, Mapping | None):
            return None
        find_engine(self.engine).check(RunOptions(engine=self.engine, dtype=self.dtype, shard=self.shard))
        assert self.shard is not None
        return dict(self.shard)

    def _check_names(self) -> None:
        for spec in self.data:
            for part in parts_of(spec, flight_names()):
                kind, _ = kind_and_place(part)
                if not is_in_file(kind):
                    _one_of("data", kind, flight_names(), kind="kind of flight")
        swept = {
            name for name, _ in self.parameters.items() if not isinstance(self.parameters[name], Mapping)
        }
        for k, point in enumerate(self.points):
            for name in point:
                if name in swept:
                    raise _wrong(f"points[{k}].{name}", "a parameter of one kind", "a grid has it too")

    def _check_runs(self) -> None:
        for graph in self.graphs:
            prepare = find_graph(graph).prepare
            if prepare is None:
                raise _wrong("graphs", "graphs that can be prepared for a flight", graph)
            sizes = {n: len(v) for n, v in self._axes(graph).items()}
            count = math.prod(sizes.values()) * max(len(self.points), 1)
            count *= len(self.each_seed) * len(self.data)
            if count > MOST_RUNS:
                raise _wrong("parameters", f"at most {MOST_RUNS} runs a graph", f"{count} of {graph}")
            for spec in self.data:
                also = flight_settings(spec)
                for name, values in self._axes(graph).items():
                    for value in values:
                        given = {name: text(value)}
                        parsed_settings(prepare, given, also=also, path=f"parameters, {graph}")
                for k, point in enumerate(self.points):
                    given = {n: text(v) for n, v in point.items()}
                    parsed_settings(prepare, given, also=also, path=f"points[{k}], {graph}")

    def _axes(self, graph: str) -> dict[str, tuple[Value, ...]]:
        shared = {n: v for n, v in self.parameters.items() if not isinstance(v, Mapping)}
        return {**shared, **self.parameters.get(graph, {})}

    @property
    def each_seed(self) -> tuple[int, ...]:
        """The seeds, one by one."""
        return typing.cast("tuple[int, ...]", self.seeds)

    def combinations(self, graph: str) -> Iterator[dict[str, Value]]:
        """All points at which a graph is run, in a fixed order."""
        axes = self._axes(graph)
        for values in itertools.product(*axes.values()):
            for point in self.points or ({},):
                yield {**dict(zip(axes, values, strict=True)), **point}

    def names(self) -> list[str]:
        """The parameters of any graph, in order."""
        found: dict[str, None] = {}
        for graph in self.graphs:
            found.update(dict.fromkeys(self._axes(graph)))
        for point in self.points:
            found.update(dict.fromkeys(point))
        return list(found)

    def resolved(self) -> dict[str, Any]:
        """The study with every seed, value and point spelled out, as plain JSON; itself a study."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        found: dict[str, Any] = json.loads(json.dumps(plain))
        return {n: v for n, v in found.items() if v is not None}

    @classmethod
    def load(cls, file: str | Path, *, checked: bool = True) -> Study:
        """Read a study from a `.toml` file, or from the `.json` of a resolved one. Its paths start there.

        Args:
            file: to read.
            checked: as of `Study`.

        Raises:
            DataError: where it cannot be read; DeclarationError, UnknownNameError: naming the key.
        """
        path = Path(file)
        try:
            content = text_of(path, most=MOST_BYTES)
            found = json.loads(content) if path.suffix == ".json" else toml_of(content)
        except (OSError, ValueError, RecursionError) as error:
            raise DataError(
                "no study can be read here",
                path=str(path),
                expected="a study in TOML, or the study.json beside results",
                got=f"{type(error).__name__}: {error}"[:300],
                fix='the smallest one: graphs = ["ekf"], data = ["sim"], a line each',
            ) from None
        if not isinstance(found, dict):
            raise _wrong(str(path), "a table of keys", type(found).__name__)
        folder = path.resolve().parent
        if isinstance(found.get("data"), list):
            found["data"] = [beside(spec, folder) for spec in found["data"]]
        if isinstance(found.get("graphs"), list):
            parameters = found.get("parameters", {})
            found["graphs"], found["parameters"] = placed_graphs(found["graphs"], parameters, folder)
        if isinstance(found.get("out"), str):
            found["out"] = str(folder / found["out"])
        try:
            return cls.from_mapping(found, checked=checked)
        except FlowgraphError as error:
            error.path = f"{path}, {error.path}" if error.path else str(path)
            raise

    @classmethod
    def from_mapping(cls, given: Mapping[str, Any], *, checked: bool = True) -> Study:
        """A study from the keys of its file."""
        valid = [f.name for f in fields(cls)]
        for name in given:
            if name not in valid:
                raise UnknownNameError("key of a study", name, valid)
        for name in ("graphs", "data"):
            if name not in given:
                raise _wrong(name, "a list of names", "nothing")
        return cls(**given, checked=checked)


_EXAMPLES = {
    "graphs": 'graphs = ["ekf"]',
    "data": 'data = ["sim"]',
    "seeds": "seeds = 20",
    "metrics": 'metrics = ["position_rmse_m"]',
    "chunk": "chunk = 64",
    "keep": "keep = true",
    "out": 'out = "results"',
    "dtype": 'dtype = "float64"',
    "sample": "[sample] with count = 64 and, in [sample.parameters], gate = {low = 5, high = 50}",
    "points": "[[points]] with position_noise = 0.01",
    "parameters": "[parameters] with position_noise = [0.01, 0.02] or {logspace = [0.005, 0.05, 5]}",
}
"""What may stand under each key of a study, for the fixes of errors."""


def _wrong(key: str, expected: str, got: object) -> DeclarationError:
    example = _EXAMPLES.get(key.partition(".")[0].partition("[")[0])
    return DeclarationError(
        "this key of the study is not usable",
        path=key,
        expected=expected,
        got=repr(got),
        fix=f"mend {key}" + ("" if example is None else f"; for example {example}"),
    )


def _one_of(key: str, given: object, valid: Sequence[str], *, kind: str | None = None) -> None:
    if given not in valid:
        raise UnknownNameError(kind or key, given, valid, path=key)


def _listed(key: str, given: Any) -> list[Any]:
    if isinstance(given, str | Mapping) or not isinstance(given, Sequence):
        raise _wrong(key, "a list", given)
    return list(given)


def _names(key: str, given: Any) -> tuple[str, ...]:
    found = _listed(key, given)
    if not found:
        raise _wrong(key, "at least one name", given)
    for name in found:
        if not isinstance(name, str) or not name:
            raise _wrong(key, "names", name)
    if len(set(found)) < len(found):
        raise _wrong(key, "each name once", given)
    return tuple(found)


def _seeds(given: Any) -> tuple[int, ...]:
    expected = "how many, or a list of different whole numbers from 0 to 2^64 - 1"
    if type(given) is int:
        if not 1 <= given <= MOST_RUNS:
            raise _wrong("seeds", expected, given)
        return tuple(range(given))
    if not isinstance(given, list | tuple | range):
        raise _wrong("seeds", expected, given)
    found = [given[k] for k in range(len(given))]
    bad = [s for s in found if type(s) is not int or not 0 <= s < 2**64]
    if bad or not found or len(set(found)) < len(found):
        raise _wrong("seeds", expected, bad[0] if bad else given)
    return tuple(found)


def _value(key: str, given: Any) -> Value:
    if isinstance(given, np.generic):
        given = given.item()
    if not isinstance(given, bool | int | float | str):
        raise _wrong(key, "a number, a text, or true or false", given)
    if isinstance(given, float) and not math.isfinite(given):
        raise _wrong(key, "a finite number", given)
    return given


def _point(key: str, given: Any) -> dict[str, Value]:
    if not isinstance(given, Mapping) or not given:
        raise _wrong(key, "a value for each parameter, by name", given)
    return {_name(key, n): _value(f"{key}.{n}", v) for n, v in given.items()}


def _name(key: str, name: Any) -> str:
    if not isinstance(name, str) or name in RESERVED or name.endswith("_s"):
        raise _wrong(
            f"{key}.{name}", f"another name: the table has columns {', '.join(RESERVED)} and *_s", name
        )
    return name


def _grid(given: Any, graphs: Sequence[str]) -> dict[str, Any]:
    if not isinstance(given, Mapping):
        raise _wrong("parameters", "values by name", given)
    found: dict[str, Any] = {}
    for name, values in given.items():
        key = f"parameters.{name}"
        if name in graphs and isinstance(values, Mapping):
            found[name] = {_name(key, n): _axis(f"{key}.{n}", v) for n, v in values.items()}
        else:
            found[_name("parameters", name)] = _axis(key, values)
    return found


def _axis(key: str, given: Any) -> tuple[Value, ...]:
    """The values of one parameter, in order."""
    if isinstance(given, Mapping):
        if len(given) != 1 or next(iter(given)) not in ("linspace", "logspace"):
            raise _wrong(key, "{linspace = [first, last, count]} or {logspace = ...}", dict(given))
        ((kind, ends),) = given.items()
        key = f"{key}.{kind}"
        numbers = _listed(key, ends)
        if len(numbers) != 3 or not all(_number(x) for x in numbers) or type(numbers[2]) is not int:
            raise _wrong(key, "[first, last, count]", ends)
        if not 1 <= numbers[2] <= MOST_RUNS:
            raise _wrong(key, "a count from 1", numbers[2])
        if kind == "logspace" and min(numbers[:2]) <= 0:
            raise _wrong(key, "positive ends, which are values and not exponents", ends)
        spread = np.linspace if kind == "linspace" else np.geomspace
        made = spread(float(numbers[0]), float(numbers[1]), numbers[2]).tolist()
        if len(set(made)) < len(made):
            raise _wrong(key, "ends that differ, or a count of 1", ends)
        return tuple(made)
    if isinstance(given, np.ndarray):
        given = given.tolist()
    values = [given] if isinstance(given, str) or not isinstance(given, Sequence) else list(given)
    found = tuple(_value(key, v) for v in values)
    if not found or len(set(map(_same, found))) < len(found):
        raise _wrong(key, "values that differ, one or more", given)
    return found


def _same(value: Value) -> object:
    """What two values have in common that mean the same: 1, 1.0 and "1" are one number."""
    written = text(value)
    for kind in (int, float):
        try:
            return kind(written)
        except ValueError:
            pass
    return written


def _different(points: list[dict[str, Value]]) -> tuple[dict[str, Value], ...]:
    """Points, of which each would be run, and counted, as often as it is there."""
    seen: dict[Any, int] = {}
    for k, point in enumerate(points):
        first = seen.setdefault(frozenset((n, _same(v)) for n, v in point.items()), k)
        if first != k:
            raise _wrong(f"points[{k}]", f"each point once; points[{first}] is the same", point)
    return tuple(points)


def _number(x: object) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool) and abs(x) <= sys.float_info.max


def _drawn(given: Any) -> list[dict[str, Value]]:
    """The points of a random or Sobol sample."""
    if given is None:
        return []
    if not isinstance(given, Mapping):
        raise _wrong("sample", "a table", given)
    for name in given:
        _one_of(f"sample.{name}", name, ("method", "count", "seed", "parameters"), kind="key of a sample")
    method, count, seed = given.get("method", "sobol"), given.get("count"), given.get("seed", 0)
    _one_of("sample.method", method, ("random", "sobol"), kind="method of sampling")
    if type(count) is not int or not 1 <= count <= MOST_RUNS:
        raise _wrong("sample.count", "a whole number from 1", count)
    if type(seed) is not int or not 0 <= seed < 2**64:
        raise _wrong("sample.seed", "a whole number from 0", seed)
    ranges = given.get("parameters")
    if not isinstance(ranges, Mapping) or not ranges:
        raise _wrong("sample.parameters", "{low = ..., high = ...} for each parameter, by name", ranges)
    unit = _unit(method, count, len(ranges), seed)
    columns = {
        _name("sample.parameters", name): _spread(f"sample.parameters.{name}", span, unit[:, k])
        for k, (name, span) in enumerate(ranges.items())
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _unit(method: str, count: int, size: int, seed: int) -> np.ndarray:
    """Points (count, size) in the unit cube; those of a Sobol sequence start alike for any count."""
    if method == "random":
        return np.random.default_rng(seed).random((count, size))
    from scipy.stats import qmc  # a second that only these draws need

    bits = max(1, math.ceil(math.log2(count)))
    drawn = qmc.Sobol(size, scramble=True, rng=np.random.default_rng(seed)).random_base2(bits)
    return np.asarray(drawn[:count])


def _spread(key: str, span: Any, unit: np.ndarray) -> list[float]:
    if not isinstance(span, Mapping) or not {"low", "high"} <= set(span) <= {"low", "high", "scale"}:
        raise _wrong(key, "{low = ..., high = ..., scale = linear or log}", span)
    low, high, scale = span["low"], span["high"], span.get("scale", "linear")
    _one_of(f"{key}.scale", scale, SCALES, kind="scale")
    if not (_number(low) and _number(high)) or low >= high or (scale == "log" and low <= 0):
        raise _wrong(key, "low below high" + (", both positive" if scale == "log" else ""), dict(span))
    if scale == "linear":
        return [float(x) for x in low + (high - low) * unit]
    return [float(x) for x in np.exp(math.log(low) + (math.log(high) - math.log(low)) * unit)]

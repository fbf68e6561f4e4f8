"""The JSON form of a pipeline: written whole, and checked value by value when it is read.

What is read is refused with its place unless it keeps to the schema, assigns each value once and before its
use, names only what exists, and holds instructions that run and give what they claim. A description that was
read plays; it does not fail in the middle.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any, NoReturn

import numpy as np

from flowgraph.data.finite import finite
from flowgraph.errors import DeclarationError, PipelineError
from flowgraph.language.block import Limit
from flowgraph.language.clock import Timing
from flowgraph.pipeline.evaluate import evaluate
from flowgraph.pipeline.formats import Formats
from flowgraph.pipeline.pipeline import (
    FORMAT,
    READ,
    VERSION,
    Cell,
    Fault,
    HostStage,
    Leaf,
    Pipeline,
    Port,
    RandomSite,
    Register,
    Stage,
    kind_of,
    schema,
    spec_of,
    type_of_leaves,
)
from flowgraph.recorder.ops import OPS, Spec
from flowgraph.recorder.replay import Body
from flowgraph.recorder.trace import Instruction
from flowgraph.types import DTYPES, leaves_of

_TRIED = 2**20
"""Elements of the largest result for which an instruction is tried out when it is read."""

_MOST = 2**31
"""Elements of the largest value: a description is small whatever it claims, and a run makes room for all."""


def _refuse(message: str, path: str, expected: object, got: object) -> NoReturn:
    raise PipelineError(message, path=path, expected=expected, got=got, fix="lower the graph again")


# -- writing -----------------------------------------------------------------------------------------


def to_json(pipeline: Pipeline) -> dict[str, Any]:
    """The whole description as plain JSON values."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": pipeline.name,
        "doc": pipeline.doc,
        "time": pipeline.time,
        "seed": pipeline.seed,
        "inputs": [_port(p) for p in pipeline.inputs],
        "outputs": [_port(p) for p in pipeline.outputs],
        "registers": [_plain(r) for r in pipeline.registers],
        "constants": [
            {"value": n, "shape": list(a.shape), "dtype": kind_of(a), "data": _numbers(a)}
            for n, a in pipeline.constants.items()
        ],
        "stages": [_stage(s) for s in pipeline.stages],
        "faults": [_plain(f) for f in pipeline.faults],
        "random": [_plain(r) for r in pipeline.random],
        "limits": [{**limit._asdict(), "numbers": list(limit.numbers)} for limit in pipeline.limits],
        **({} if pipeline.formats is None else {"formats": pipeline.formats.to_json()}),
        **({"host": [_plain(stage) for stage in pipeline.host]} if pipeline.host else {}),
        "totals": pipeline.totals(),
        "latency": pipeline.latency(),
    }


def _port(port: Port) -> dict[str, Any]:
    return {
        "name": port.name,
        "type": port.type,
        "clock": port.clock,
        "timing": None if port.timing is None else _timing(port.timing),
        "present": port.present,
        "leaves": [_plain(leaf) for leaf in port.leaves],
    }


def _timing(timing: Timing) -> dict[str, Any]:
    rate = timing.max_rate
    return {
        "period": timing.period,
        "phase": timing.phase,
        "jitter": None if timing.period is None else timing.jitter,
        "max_rate": None if rate is None or math.isinf(rate) else rate,
    }


def _stage(stage: Stage) -> dict[str, Any]:
    return {
        "path": stage.path,
        "block": stage.block,
        "enable": stage.enable,
        "reads": list(stage.reads),
        "writes": list(stage.writes),
        "axis": stage.axis,
        "instructions": [_instruction(i) for i in stage.instructions],
    }


def _instruction(i: Instruction) -> dict[str, Any]:
    record: dict[str, Any] = {"value": i.out, "op": i.op, "args": list(i.args)}
    if i.attrs:
        record["attrs"] = i.attrs
    return record | {"shape": list(i.spec.shape), "dtype": i.spec.dtype, "line": i.line}


def _plain(record: Any) -> Any:
    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: clean(v) for k, v in value.items()}
        if isinstance(value, list | tuple):
            return [clean(v) for v in value]
        return _numbers(value) if isinstance(value, np.ndarray | np.generic) else value

    return clean(asdict(record))


def _numbers(array: Any) -> Any:
    """Nested lists; numbers that JSON lacks as text."""
    flat = np.asarray(array)
    if not finite(flat):
        spelled = np.array([x if math.isfinite(x) else str(x) for x in flat.ravel().tolist()], dtype=object)
        return spelled.reshape(flat.shape).tolist()
    return flat.tolist()


# -- reading -----------------------------------------------------------------------------------------


def from_json(data: Any, *, path: str = "pipeline") -> Pipeline:
    """A pipeline from `to_json`'s form.

    Raises:
        PipelineError: saying where it is malformed.
    """
    _check_version(data, path)
    _check_schema(data, path)
    _check_names(f"{path}: constants", (str(c["value"]) for c in data["constants"]))
    pipeline = Pipeline(
        name=data["name"],
        doc=data["doc"],
        time=data["time"],
        seed=data["seed"],
        inputs=tuple(_read_port(p, path) for p in data["inputs"]),
        outputs=tuple(_read_port(p, path) for p in data["outputs"]),
        registers=tuple(
            Register(
                r["path"],
                r["role"],
                tuple(_read_cell(c, f"{path}: register {r['path']}") for c in r["cells"]),
            )
            for r in data["registers"]
        ),
        constants={
            c["value"]: _array(c["data"], c["shape"], c["dtype"], f"{path}: constant {c['value']}")
            for c in data["constants"]
        },
        stages=tuple(_read_stage(s) for s in data["stages"]),
        faults=tuple(Fault(**f) for f in data["faults"]),
        random=tuple(RandomSite(**{**r, "shape": tuple(r["shape"])}) for r in data["random"]),
        limits=tuple(Limit(**{**r, "numbers": tuple(r["numbers"])}) for r in data.get("limits", ())),
        host=tuple(
            HostStage(**{**r, "reads": tuple(r["reads"]), "feeds": tuple(r["feeds"])})
            for r in data.get("host", ())
        ),
        formats=_read_formats(data.get("formats"), path),
    )
    _check_ports(pipeline, path)
    _check_values(pipeline, path)
    _check_formats(pipeline, path)
    _check_sums(pipeline, data, path)
    return pipeline


def _read_formats(r: Mapping[str, Any] | None, path: str) -> Formats | None:
    if r is None:
        return None
    try:
        return Formats.from_json(r)
    except (KeyError, TypeError, ValueError, DeclarationError) as error:
        _refuse("the number formats are malformed", f"{path}: formats", "formats of quantise", error)


def _read_port(r: Mapping[str, Any], path: str) -> Port:
    leaves = tuple(
        Leaf(**{**leaf, "shape": tuple(leaf["shape"]), "axes": tuple(leaf["axes"])}) for leaf in r["leaves"]
    )
    timing = None if r["timing"] is None else _read_timing(r["timing"], f"{path}: input {r['name']}")
    return Port(r["name"], r["type"], r["clock"], r["present"], leaves, timing)


def _read_timing(r: Mapping[str, Any], where: str) -> Timing:
    period, phase, jitter, rate = (r[n] for n in ("period", "phase", "jitter", "max_rate"))
    sound = (phase is None) if period is None else (jitter is not None and (phase is None or phase < period))
    if not sound or not (rate is None or 0.0 < 1e9 / rate < math.inf):
        _refuse(
            "this timing cannot be kept",
            where,
            "a phase below the period and a jitter, or neither period nor phase; a finite rate",
            json.dumps(r),
        )
    return Timing(period, phase, jitter or 0, rate)


def _read_cell(r: Mapping[str, Any], where: str) -> Cell:
    reset = _array(r["reset"], r["shape"], r["dtype"], f"{where}, cell {r['name']}")
    return Cell(**{**r, "shape": tuple(r["shape"]), "axes": tuple(r["axes"]), "reset": reset})


def _read_stage(r: Mapping[str, Any]) -> Stage:
    return Stage(
        r["path"],
        r["block"],
        r["enable"],
        tuple(r["reads"]),
        tuple(r["writes"]),
        tuple(_read_instruction(i) for i in r["instructions"]),
        r["axis"],
    )


def _read_instruction(r: Mapping[str, Any]) -> Instruction:
    spec = Spec(tuple(r["shape"]), r["dtype"])
    attrs = r.get("attrs", {})
    if isinstance(attrs.get("body"), dict):
        attrs = {**attrs, "body": Body(attrs["body"])}
    return Instruction(r["op"], tuple(r["args"]), attrs, r["value"], spec, r["line"])


_SPELLED = {"nan", "inf", "-inf"}


def _array(data: Any, shape: list[int], dtype: str, where: str) -> np.ndarray:
    try:
        items = np.asarray(data, dtype=object)
        for x in items.ravel().tolist():
            kinds = {"real": float | int, "bool": bool}.get(dtype, int)
            if not (dtype == "real" and x in _SPELLED) and (
                not isinstance(x, kinds) or isinstance(x, bool) != (dtype == "bool")
            ):
                raise TypeError(f"{x!r}")
        array: np.ndarray = items.astype(DTYPES[dtype]).reshape(shape)
        return array
    except (ValueError, TypeError, OverflowError) as error:
        _refuse("numbers are malformed", where, f"{dtype} of shape {tuple(shape)}", str(error))


# -- checking ----------------------------------------------------------------------------------------


def _check_version(data: Any, path: str) -> None:
    if not isinstance(data, dict) or data.get("format") != FORMAT or data.get("version") not in READ:
        raise PipelineError(
            "this is not a pipeline of a known version",
            path=path,
            expected=f"format {FORMAT!r}, version {VERSION} or before",
            got={k: data.get(k) for k in ("format", "version")}
            if isinstance(data, dict)
            else type(data).__name__,
            fix="lower the graph again with this version of flowgraph",
        )


def _check_schema(data: Any, path: str) -> None:
    import jsonschema  # slow to import, and only needed to read a description

    first = next(iter(jsonschema.Draft202012Validator(schema()).iter_errors(data)), None)
    if first is not None:
        place = "/".join(map(str, first.absolute_path)) or "the top"
        _refuse(
            "the description does not keep to its schema",
            f"{path}, at {place}",
            json.dumps(first.schema)[:200],
            first.message[:200],
        )


def _check_names(where: str, names: Iterable[str]) -> None:
    twice = sorted(n for n, k in Counter(names).items() if k > 1)
    if twice:
        _refuse("a name is used twice", where, "each once", ", ".join(twice))


def _check_ports(pipeline: Pipeline, path: str) -> None:
    """Names are used once, name what exists, and together make a type."""
    _check_names(f"{path}: inputs", (p.name for p in pipeline.inputs))
    _check_names(f"{path}: outputs", (p.name for p in pipeline.outputs))
    _check_names(f"{path}: registers", (r.path for r in pipeline.registers))
    parts: list[tuple[str, Any]] = [(f"input {p.name}", p.leaves) for p in pipeline.inputs]
    parts += [(f"output {p.name}", p.leaves) for p in pipeline.outputs]
    parts += [(f"register {r.path}", r.cells) for r in pipeline.registers]
    for where, leaves in parts:
        names = [leaf.name for leaf in leaves]
        _check_names(f"{path}: {where}", names)
        if [n for n, _ in leaves_of(type_of_leaves(where, leaves))] != names:
            _refuse("these fields make no value", f"{path}: {where}", "fields in order", ", ".join(names))
    paths = {r.path for r in pipeline.registers}
    for stage in pipeline.stages:
        absent = [n for n in (*stage.reads, *stage.writes) if n not in paths]
        if absent:
            _refuse(
                "a stage names a register that does not exist",
                f"{path}: stage {stage.path}",
                "one of " + ", ".join(sorted(paths)) if paths else "none",
                absent[0],
            )


def _check_values(pipeline: Pipeline, path: str) -> None:
    """Every value is assigned once, before it is used, with the shape that its instruction gives."""
    given = pipeline.given()
    specs = dict(given)
    if len(specs) < len(given):
        twice = sorted(n for n, k in Counter(n for n, _ in given).items() if k > 1)
        _refuse("a value is assigned twice", path, "one number a value", twice)
    _check_size(path, given)
    for stage in pipeline.stages:
        for i in stage.instructions:
            _check_size(f"{path}: stage {stage.path}", [(i.out, i.spec)])
            _check_instruction(i, specs, f"{path}: stage {stage.path}, value {i.out}")
            specs[i.out] = i.spec
    flag, stamp = Spec((), "bool"), Spec((), "int64")
    ends = [(f"output {o.name}", leaf.value, spec_of(leaf)) for o in pipeline.outputs for leaf in o.leaves]
    ends += [(f"output {o.name}", o.present, flag) for o in pipeline.outputs]
    ends += [(f"register {r.path}", c.write, spec_of(c)) for r in pipeline.registers for c in r.cells]
    ends += [(f"stage {s.path}", s.enable, flag) for s in pipeline.stages]
    ends += [(f"random site {s.name}", s.value, Spec(s.shape, "real")) for s in pipeline.random]
    for where, n, wanted in ends:
        if specs.get(n) != wanted:
            _refuse(
                f"value {n} is never assigned" if n not in specs else f"value {n} is of another kind",
                f"{path}: {where}",
                wanted,
                specs.get(n, "nothing"),
            )
    cells = {(r.path, c.name): spec_of(c) for r in pipeline.registers for c in r.cells}
    for fault in pipeline.faults:
        if cells.get((fault.register, fault.cell)) != stamp:
            _refuse(
                "a fault is kept nowhere",
                f"{path}: fault of {fault.path}",
                "a register cell that exists and holds one int64",
                f"{fault.register}, {fault.cell}",
            )


def _check_formats(pipeline: Pipeline, path: str) -> None:
    """Formats are of real values, and broadcast to their shapes."""
    formats = pipeline.formats
    for n, fraction in {} if formats is None else formats.fractions.items():
        spec = pipeline.specs.get(n, Spec((), "none"))
        try:
            fits = np.broadcast_shapes(fraction.shape, spec.shape) == spec.shape and spec.dtype == "real"
        except ValueError:
            fits = False
        if not fits:
            _refuse("a number format fits no value", f"{path}: formats, value {n}", spec, fraction.shape)


def _check_size(where: str, values: Iterable[tuple[int, Spec]]) -> None:
    for n, spec in values:
        if math.prod(spec.shape) > _MOST:
            _refuse("a value is too large", f"{where}, value {n}", f"up to {_MOST} elements", spec)


def _check_instruction(i: Instruction, specs: Mapping[int, Spec], where: str) -> None:
    if i.op not in OPS or i.out in specs or any(a not in specs for a in i.args):
        _refuse(
            "an instruction is malformed",
            where,
            "a known operation on values assigned before",
            f"{i.op}{list(i.args)}",
        )
    op = OPS[i.op]
    given = [specs[a] for a in i.args]
    if len(given) != op.count if op.count is not None else not given:
        _refuse(
            "an instruction has too few or too many arguments",
            where,
            f"{i.op} of {op.count or 'one or more'}",
            f"{i.op}{list(i.args)}",
        )
    kinds = [s.dtype for s in given]
    bad = {
        "same": len(set(kinds)) > 1,
        "real": set(kinds) != {"real"},
        "bool": set(kinds) != {"bool"},
        "int": "real" in kinds,
    }
    if bad.get(op.operands, i.op == "where" and (kinds[0] != "bool" or kinds[1] != kinds[2])):
        wanted = "a bool, and two of one kind" if i.op == "where" else f"arguments of kind: {op.operands}"
        _refuse("an instruction's arguments are of another kind", where, f"{i.op} of {wanted}", kinds)
    try:
        derived = op.rule(*given, **i.attrs)
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
        _refuse("an instruction does not fit its arguments", where, f"{i.op} that can run", error)
    if derived != i.spec:
        _refuse("an instruction's result does not have the shape it claims", where, derived, i.spec)
    if max((math.prod(s.shape) for s in (*given, i.spec)), default=0) <= _TRIED:
        _try(i, given, where)


def _try(i: Instruction, given: list[Spec], where: str) -> None:
    """Run an instruction once, on ones or on unit matrices: attributes that no shape rule reads show here."""
    args: list[Any] = [np.broadcast_to(np.ones((), DTYPES[s.dtype]), s.shape) for s in given]
    if i.op in ("cholesky", "solve"):
        args[0] = np.broadcast_to(np.eye(given[0].shape[-1]), given[0].shape)
    try:
        made = np.asarray(evaluate(i, *args))
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError) as error:
        _refuse("an instruction cannot be run", where, f"{i.op} with attributes that it knows", error)
    if Spec(made.shape, kind_of(made)) != i.spec:
        _refuse("an instruction gives something else", where, i.spec, Spec(made.shape, kind_of(made)))


def _check_sums(pipeline: Pipeline, data: Mapping[str, Any], path: str) -> None:
    for name, found in (("totals", pipeline.totals()), ("latency", pipeline.latency())):
        if data[name] != found:
            _refuse(f"the {name} are not those of the content", f"{path}, at {name}", found, data[name])

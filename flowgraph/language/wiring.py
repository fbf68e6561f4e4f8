"""Wiring a block: its ports matched, types and clocks checked, its step recorded, its outputs given clocks.

All of it happens at the call, so an error points at the line of the graph function that is wrong.
"""

from __future__ import annotations

import itertools
import typing
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from flowgraph.errors import ClockError, DeclarationError, LoweringError, TypeMismatchError, UnknownNameError
from flowgraph.language import clock as clocks
from flowgraph.language.block import REQUIRED, WIRING, Block, line_of
from flowgraph.language.builder import Builder, builder
from flowgraph.language.clock import Clock, Condition, both, clock_of, either, within
from flowgraph.language.freezing import Freezer
from flowgraph.language.graph import Argument, CallNode, OutputPort, RegisterNode, Wire
from flowgraph.language.purity import line_of_step, refuse_impure
from flowgraph.language.recording import StepTrace, check_units, record
from flowgraph.language.stream import Held, Stream
from flowgraph.types import ArrayType, StructType, Type, check_fits


def wire(block: Block[Any], streams: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
    """Add a call of `block` to the graph under construction; returns its output stream or streams."""
    build = builder(block.name)
    at, name, draws = (keywords.pop(k, None) for k in WIRING)
    path = build.path(name or block.name, given=name is not None)
    block = _with_defaults(block, path, streams, keywords)
    given = _match_ports(block, path, streams, keywords)
    settings = _match_settings(block, path, keywords)
    as_given, freezer = (block, settings), Freezer()
    if not block.host:
        block, settings = _frozen(freezer, *as_given)
    arguments = tuple(_argument(build, path, port.name, port.optional, value) for port, value in given)
    types = [None if v is None else v.type for _, v in given]
    sizes: dict[str, int] = {}
    for port, value in given:
        if value is not None and port.type is not None:
            check_fits(
                value.type, port.type, given_at=value.label, wanted_at=f"{path}.{port.name}", sizes=sizes
            )
    clocked = [(p, v) for p, v in given if isinstance(v, Stream)]
    firing = _firing(block, path, clocked, at)
    state = None
    if block.stateful:
        state = build.register(
            "state", f"{path.rsplit('/', 1)[-1]}.state", block.initial(types, settings), None
        ).register
    state_type = None if state is None else typing.cast(RegisterNode, build.nodes[state]).type
    if "draw" in block.handed:
        draws = build.random_streams(draws or block.name, path)
    variants = _variants(block, path, clocked, given, firing, settings, state_type, draws or "", freezer)
    if any(not isinstance(v, StepTrace) for v in variants.values()):
        block, settings = as_given  # it runs in Python only, with what it reads as it is then
    else:

        def again(other: Freezer) -> None:
            step, values = _frozen(other, *as_given)
            _variants(step, path, clocked, given, firing, values, state_type, draws or "")

        refuse_impure(freezer, again, block, path)
    for variant in variants.values():
        if isinstance(variant, StepTrace):
            for site, _ in variant.sites:
                build.random_site(site.name, site.hash, path)
    outputs, dynamic = _outputs(block, path, firing, clocked, variants, types, settings)
    stamp = build.stamp(firing) if "dt" in block.handed else None
    index = build.add(
        CallNode(
            path, block, arguments, settings, firing, outputs, dynamic, variants, state, stamp, draws or ""
        )
    )
    made = tuple(build.stream(Wire(index, k)) for k in range(len(outputs)))
    return made[0] if len(made) == 1 else made or None


def _frozen(
    freezer: Freezer, block: Block[Any], settings: dict[str, Any]
) -> tuple[Block[Any], dict[str, Any]]:
    return freezer.block(block), {k: freezer.value(v, k) for k, v in settings.items()}


def _with_defaults(
    block: Block[Any], path: str, streams: tuple[Any, ...], keywords: dict[str, Any]
) -> Block[Any]:
    """The block with those of its ports as settings that have a default and are not wired."""
    fixed = [
        p.name
        for k, p in enumerate(block.ports)
        if p.default is not REQUIRED
        and k >= len(streams)
        and not isinstance(keywords.get(p.name), Stream | Held)
    ]
    if not fixed:
        return block
    names = [p.name for p in block.ports]
    behind = [n for n in names[names.index(fixed[0]) :] if n not in fixed]
    if behind:
        raise DeclarationError(
            f"{fixed[0]!r}, which has a default, stands before the port {behind[0]!r}",
            path=path,
            expected="ports first, then what has a default and is not wired",
            got=f"{block.name}({', '.join(names)})",
            fix=f"move it behind the ports, or make it a setting: *, {fixed[0]}=...",
        )
    return block.with_settings(fixed)


def _match_ports(
    block: Block[Any], path: str, streams: tuple[Any, ...], keywords: dict[str, Any]
) -> list[Any]:
    signature = f"{block.name}({', '.join(p.name for p in block.ports)})"
    if len(streams) > len(block.ports):
        raise DeclarationError(
            "too many streams",
            path=path,
            expected=signature,
            got=f"{len(streams)} streams",
            fix="settings go by keyword",
        )
    given = []
    for k, port in enumerate(block.ports):
        if k < len(streams) and port.name in keywords:
            raise DeclarationError(
                f"port {port.name!r} is given twice",
                path=path,
                expected=signature,
                got="a position and a keyword",
                fix="give it once",
            )
        value = streams[k] if k < len(streams) else keywords.pop(port.name, None)
        if value is None and not port.optional:
            raise DeclarationError(
                f"port {port.name!r} is not connected",
                path=path,
                expected=signature,
                got=f"nothing at {port.name!r}",
                fix=f"give a stream: {block.name}(..., {port.name}=stream)",
            )
        given.append((port, value))
    return given


def _match_settings(block: Block[Any], path: str, keywords: dict[str, Any]) -> dict[str, Any]:
    for key in keywords:
        if key not in block.settings:
            raise UnknownNameError("setting", key, [*block.settings, *WIRING], path=path)
    settings = {k: keywords.get(k, default) for k, default in block.settings.items()}
    missing = [k for k, v in settings.items() if v is REQUIRED]
    if missing:
        raise DeclarationError(
            f"setting {missing[0]!r} is missing",
            path=path,
            expected=", ".join(block.settings),
            got=", ".join(keywords) or "none",
            fix=f"write {block.name}(..., {missing[0]}=...)",
        )
    for key, value in settings.items():
        if isinstance(value, Stream | Held):
            raise DeclarationError(
                f"setting {key!r} cannot be a stream",
                path=path,
                expected="a value fixed when the graph is built",
                got=repr(value),
                fix="make it a positional parameter of the block, which is a port",
            )
    return settings


def _argument(build: Builder, path: str, port: str, optional: bool, value: Any) -> Argument:
    if value is None:
        return Argument(optional=True)
    if not isinstance(value, Stream | Held):
        raise DeclarationError(
            f"port {port!r} needs a stream",
            path=path,
            expected="a Stream, latest(...) or delay(...)",
            got=f"{type(value).__name__} {value!r}"[:80],
            fix="make it a keyword-only parameter of the block, which is a setting",
        )
    if value.builder is not build:
        raise DeclarationError(
            f"port {port!r} is wired to a stream of another graph",
            path=path,
            expected=f"a stream of {build.name}",
            got=f"{value.label} of {value.builder.name}",
            fix="pass it in as a parameter of the graph",
        )
    if isinstance(value, Held):
        return Argument(register=value.register, optional=optional)
    return Argument(wire=value.wire, optional=optional)


def _firing(block: Block[Any], path: str, clocked: list[Any], at: object) -> Clock:
    """The clock at which a call fires; refuses what no join rule covers."""
    main = [(p, s) for p, s in clocked if not p.optional]
    options = [(p, s) for p, s in clocked if p.optional]
    if at is not None:
        firing = clock_of(at)
        for port, stream in main:
            if not within(firing, stream.clock):
                raise ClockError(
                    f"input {port.name!r} can be absent when the block fires",
                    path=path,
                    expected=f"a stream present at every tick of {firing}",
                    got=f"{stream.label} at {stream.clock}",
                    fix=f"hold it: latest({stream.label}, init=...)",
                )
    elif main:
        first = main[0][1]
        firing = first.clock
        for _, stream in main[1:]:
            if not clocks.equal(firing, stream.clock):
                raise ClockError(
                    f"{first.label} and {stream.label} are not provably present together",
                    path=path,
                    expected="streams of one clock",
                    got=f"{first.clock} and {stream.clock}",
                    fix=f"hold one with latest({stream.label}, init=...), or pair them with zip or match",
                )
    elif options:
        return either(*(s.clock for _, s in options))
    else:
        raise ClockError(
            "nothing fires this block: all its inputs are held",
            path=path,
            expected="a clock",
            got="only held values",
            fix=f"say when: {block.name}(..., at=imu) or at=imu | vicon",
        )
    for port, stream in options:
        if not within(stream.clock, firing):
            raise ClockError(
                f"optional input {port.name!r} can come when the block does not fire",
                path=path,
                expected=f"a clock within {firing}",
                got=f"{stream.label} at {stream.clock}",
                fix=f"let the main input fire then too: at={firing} | {stream.label}",
            )
    return firing


def _variants(
    block: Block[Any],
    path: str,
    clocked: list[Any],
    given: list[Any],
    firing: Clock,
    settings: dict[str, Any],
    state: Type | None,
    draws: str,
    freezer: Freezer | None = None,
) -> dict[tuple[bool, ...], StepTrace | LoweringError]:
    """Record the step once for each possible presence of its optional streams."""
    options = [s for p, s in clocked if p.optional]
    found: dict[tuple[bool, ...], StepTrace | LoweringError] = {}
    choices = sorted(
        itertools.product((True, False), repeat=len(options)),
        key=lambda choice: bool(options) and _never(firing, options, choice),
    )
    for choice in choices:
        if options and _never(firing, options, choice) and not _untyped(found):
            break  # such ticks cannot come, so the step need not cope with them
        present = iter(choice)
        types = [
            None if v is None or (isinstance(v, Stream) and p.optional and not next(present)) else v.type
            for p, v in given
        ]
        if block.host:
            found[choice] = LoweringError(
                "a host block cannot be lowered",
                path=path,
                expected="blocks of array-API operations",
                got=f"@block(host=True) {block.name}, {line_of(block)}",
                fix='keep it outside the lowered graph, or run the graph with engine="python"',
            )
            continue
        try:
            found[choice] = record(block, types, settings, state, path, draws, freezer=freezer)
        except LoweringError as error:
            if error.in_every_engine:
                raise
            found[choice] = error
    return found


def _never(firing: Clock, options: list[Stream[Any]], choice: tuple[bool, ...]) -> bool:
    tick = both(firing, *_literals(options, choice))
    return clocks.disjoint(tick, tick)


def _untyped(found: Mapping[tuple[bool, ...], StepTrace | LoweringError]) -> bool:
    """Whether an output has no value in any of the ticks that can come, so that others tell its type."""
    steps = [v for v in found.values() if isinstance(v, StepTrace)]
    if len(steps) < len(found):
        return False
    return not steps or any(
        all(o.type is None for o in of) for of in zip(*(v.outputs for v in steps), strict=True)
    )


def _literals(options: list[Stream[Any]], choice: tuple[bool, ...]) -> list[Clock]:
    return [s.clock if here else clocks.Not(s.clock) for s, here in zip(options, choice, strict=True)]


def _agreed(a: Type, b: Type) -> Type | None:
    """What two types have in common that differ at most in a unit or frame which one leaves open."""
    if isinstance(a, StructType) and isinstance(b, StructType):
        pairs = [(n, _agreed(f, g)) for (n, f), (_, g) in zip(a.fields, b.fields, strict=False)]
        whole = replace(a, fields=tuple((n, t) for n, t in pairs if t is not None))
        names = [n for n, _ in b.fields]
        return whole if a.cls is b.cls and [n for n, _ in whole.fields] == names else None
    if isinstance(a, StructType) or isinstance(b, StructType) or (a.shape, a.dtype) != (b.shape, b.dtype):
        return None
    if not all(x == y or None in (x, y) for x, y in ((a.unit, b.unit), (a.frame, b.frame))):
        return None
    return replace(a, unit=a.unit and b.unit, frame=a.frame and b.frame)


def _outputs(
    block: Block[Any],
    path: str,
    firing: Clock,
    clocked: list[Any],
    variants: Mapping[tuple[bool, ...], Any],
    types: list[Any],
    settings: dict[str, Any],
) -> tuple[tuple[OutputPort, ...], tuple[bool, ...]]:
    options = [s for p, s in clocked if p.optional]
    recorded = {c: v for c, v in variants.items() if isinstance(v, StepTrace)}
    refused = next((v for v in variants.values() if not isinstance(v, StepTrace)), None)
    declared = block.outputs
    names = [p.name for p in declared] if declared is not None else ["out"]
    ports, dynamic = [], []
    for k, name in enumerate(names):
        steps = {c: v.outputs[k] for c, v in recorded.items()}
        type_ = next((s.type for s in steps.values() if s.type is not None), None)
        if block.output_rule is not None and k == 0:
            type_ = block.output_rule(types, settings)
            if isinstance(type_, ArrayType | StructType):
                for choice, step in steps.items():
                    if step.type is not None:
                        check_units(recorded[choice].trace, step.leaves, type_, path, line_of_step(block))
        if type_ is None and declared is not None:
            type_ = declared[k].type
        if type_ is None:
            if isinstance(refused, LoweringError):
                refused.fix = f"{refused.fix}; or, to run it in Python only, annotate its output type"
                raise refused
            raise DeclarationError(
                f"output {name!r} never has a value",
                path=path,
                expected="a value in some case",
                got="None in all",
                fix="return a value, or drop the output",
            )
        for step in steps.values():
            if step.type is None or block.output_rule is not None:
                continue
            agreed = _agreed(step.type, type_)
            if agreed is not None:
                type_ = agreed
            else:
                raise TypeMismatchError(
                    f"output {name!r} changes its type with the presence of an option",
                    path=path,
                    expected=str(type_),
                    got=str(step.type),
                    fix="return the same type in every case",
                )
        clock, unsure = firing, False
        if refused is not None:
            unsure = declared is not None and declared[k].optional
        elif any(s.presence != "always" for s in steps.values()):
            cases = [both(*_literals(options, c)) for c, s in steps.items() if s.presence != "never"]
            clock = clocks.simplify(both(firing, either(*cases)), [firing, *(s.clock for s in options)])
            unsure = any(isinstance(s.presence, int) for s in steps.values())
        if unsure:
            label = path if len(names) == 1 else f"{path}.{name}"
            rule = block.clock_rule
            ruled = (
                rule(firing, [s.clock for _, s in clocked], settings) if rule is not None and k == 0 else None
            )
            clock = ruled or Condition(label, clock, path)
        ports.append(OutputPort(name, type_, clock))
        dynamic.append(unsure)
    return tuple(ports), tuple(dynamic)

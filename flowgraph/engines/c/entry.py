"""The entry of a filter: it calls the reaction of the pattern that is there, and looks at what came of it.

In a program of a user's own nobody else looks: so a queue that was full, and an output that is not finite,
are bits of what the entry returns.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from flowgraph.engines.c.header import NOT_FINITE, OVERFLOW, react_signature
from flowgraph.engines.c.names import Names, given, made
from flowgraph.engines.c.patterns import Pattern
from flowgraph.pipeline.pipeline import Pipeline


def reaction_name(pattern: Pattern) -> str:
    """Of the function for these patterns of present inputs."""
    return f"fg_react_{pattern.inputs}"


def parameters(names: Names, pattern: Pattern) -> list[tuple[str, str]]:
    """The type and the name of each that the function has."""
    m = names.module
    inputs = zip(names.inputs, given(names), strict=True)
    return [
        (f"{m}_state *restrict", "s"),
        ("int64_t", "time"),
        *([("uint64_t", "present")] if pattern.open else []),
        *((f"const {m}_{n} *restrict", g) for k, (n, g) in enumerate(inputs) if pattern.inputs >> k & 1),
        *((f"{m}_{n} *restrict", g) for n, g in zip(names.outputs, made(names), strict=True)),
    ]


def entry_text(
    pipeline: Pipeline, names: Names, real: str, patterns: Sequence[Pattern], *, checked: bool
) -> str:
    """The function that a program calls; with `checked` it returns the bits of what went wrong, too."""
    checks = list(_checks(pipeline, names)) if checked else []
    lines = [*(_FINITE.format(real=real).splitlines() if any("fg_finite" in c for c in checks) else [])]
    lines += [*react_signature(names, "restrict ").splitlines(), "{"]
    ends = "made = {};" if checks else "return {};"
    if checks:
        lines.append("    uint64_t made;")
    for k, n in enumerate(names.inputs):
        if any(p.open >> k & 1 for p in patterns):
            lines.append(f"    static const {names.module}_{n} no_{n} = FG_ZERO;")
    maybe = {g: f"((present >> {k}) & 1u) ? {g} : &no_{n}" for k, (n, g) in enumerate(
        zip(names.inputs, given(names), strict=True))}  # fmt: skip
    calls = []
    for p in patterns:
        there = {g for k, g in enumerate(given(names)) if not p.open >> k & 1}
        passed = [g if g in there else maybe.get(g, g) for _, g in parameters(names, p)]
        calls.append(ends.format(f"{reaction_name(p)}({', '.join(passed)})"))
    if any(p.every for p in patterns):
        lines.append(f"    {calls[0]}")
    else:
        lines.append("    switch (present) {")
        for p, call in zip(patterns, calls, strict=True):
            lines += [f"    case {key}:" for key in p.keys]
            lines[-1] += f" {call}{' break;' if checks else ''}"
        lines += ["    default: return 0;", "    }"]
    if checks:
        lines += [*(f"    {c}" for c in checks), "    return made;"]
    return "\n".join([*lines, "}", ""])


def fault_cells(pipeline: Pipeline, names: Names) -> list[str]:
    """For each fault of the pipeline what the cell is called that keeps its time."""
    places = {
        (r.path, c.name): n
        for r, called in zip(pipeline.registers, names.registers, strict=True)
        for c, n in zip(r.cells, called, strict=True)
    }
    return [places[f.register, f.cell] for f in pipeline.faults]


def _checks(pipeline: Pipeline, names: Names) -> Iterator[str]:
    for cell in fault_cells(pipeline, names):
        yield f"if (s->{cell} != INT64_MIN) made |= UINT64_C(1) << {OVERFLOW};"
    for k, (port, out, leaves) in enumerate(
        zip(pipeline.outputs, made(names), names.output_leaves, strict=True)
    ):
        for leaf, name in zip(port.leaves, leaves, strict=True):
            size = math.prod(leaf.shape)
            if leaf.dtype == "real" and size:
                place = f"{out}->{name}" if leaf.shape else f"&{out}->{name}"
                there = f"(made >> {k} & 1u) && !fg_finite({place}, {size})"
                yield f"if ({there}) made |= UINT64_C(1) << {NOT_FINITE};"


_FINITE = """/* 0 times a number is 0, and NaN where it is not finite */
static inline bool fg_finite(const {real} *a, int32_t n) {{
    {real} sum = 0;
    for (int32_t i = 0; i < n; i++) sum += 0 * a[i];
    return sum == 0;
}}
"""

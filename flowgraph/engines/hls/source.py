"""A tick as C++ for high-level synthesis: the instructions of fixed-point C on words of `ap_int`.

A word has as many bits as its format. A product is as wide as both its factors together, and is rounded
(half up) and cut (to the largest word of either sign) once, where the interpreter does it: AP_RND and
AP_SAT_SYM, as `ap_fixed` calls them. An array of `ap_fixed` has one fraction, and the elements of a
covariance have many; so the words are `ap_int`, the fractions of a value stand beside it, and the shifts are
in the text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowgraph.engines.c.names import names_of
from flowgraph.engines.c.syntax import comment
from flowgraph.engines.fixed.engine import Bound, Integers
from flowgraph.engines.fixed.kernels import kernels
from flowgraph.engines.fixed.shifts import slim
from flowgraph.engines.fixed.writer import Writer
from flowgraph.engines.hls.arrays import Array, ValueArrays
from flowgraph.pipeline.formats import FREE
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.trace import Instruction

REGISTERS_UP_TO = 64
"""Elements of an array that becomes registers; one with more becomes a memory."""

_NARROW = re.compile(r"\(int64_t\)([vc]\w*\[.*\])")


class HlsWriter(Writer):
    """The same text with words of as many bits as they have, and a loop's pragma in it."""

    def said(self, i: Instruction) -> None:
        what = f"/* v{i.out} = {i.op} {list(i.spec.shape)}"
        if i.spec.dtype == "real":
            what += f", {fraction_text(self.bound.fractions[i.out])}"
        self.put(f"{what}  {i.line} */")
        assert isinstance(self.places, ValueArrays)
        for array in self.places.begun(i.out):
            self.lines += declared(array, "  ")

    def product(self, a: str, b: str) -> str:
        left, right = _NARROW.fullmatch(a), _NARROW.fullmatch(b)
        return f"fx_times({left[1]}, {right[1]})" if left and right else super().product(a, b)

    def fitted(self, place: str, text: str) -> str:
        most = int(self.player.most) if self.most is None else self.most
        return f"{place} = fx_fit<{most.bit_length() + 1}>({text}, count);"

    def taken(self) -> str:
        self.lines = _pipelined(self.lines)
        return super().taken()


@dataclass(frozen=True)
class Output:
    """An output of the top function: how many leaves it has, and for each of them the array."""

    name: str
    there: str
    leaves: tuple[Array, ...]


class HlsSource:
    """A pipeline in fixed point as the text of C++ for high-level synthesis.

    Args:
        pipeline: with formats.
        keys: the patterns of present inputs that come.

    Attributes:
        text: of the file with the functions.
        header: of that which declares the top function.
        names: of the function and its files, as those of C.
        inputs: for each input port, the arrays of its leaves.
        outputs: the output ports.
        registers: the arrays of the registers' cells, in order.
        bound: for each of `keys` its program.
    """

    def __init__(self, pipeline: Pipeline, keys: Sequence[int]) -> None:
        self.pipeline, self.keys = pipeline, list(keys)
        self.player = Integers(
            pipeline, [c.reset for r in pipeline.registers for c in r.cells], np.zeros(2, np.uint32)
        )
        self.names = names_of(pipeline)
        self._arrays = ValueArrays(self.player, keys)
        self._writer = HlsWriter(self.player, self._arrays, marks=False)
        held = self._arrays.held
        self.inputs = [[held[leaf.value] for leaf in port.leaves] for port in pipeline.inputs]
        self.registers = [held[c.read] for r in pipeline.registers for c in r.cells]
        self._next = [held[-1 - c.read] for r in pipeline.registers for c in r.cells]
        self.bound: list[Bound] = []
        kinds: dict[tuple[int, int], str] = {}
        bodies = []
        for key in keys:
            parts, end = self._writer.tick(key)
            bound = self._writer.bound
            self.bound.append(bound)
            bodies.append((parts, self._outputs(bound, kinds), end))
        self.outputs = [
            Output(
                port.name,
                self._there(p),
                tuple(
                    Array(self._leaf(p, n), kinds.get((p, n), "int64_t"),
                          max(math.prod(leaf.shape), 1))
                    for n, leaf in enumerate(port.leaves)
                ),
            )
            for p, port in enumerate(pipeline.outputs)
        ]  # fmt: skip
        self.text = self._text(bodies)
        self.header = self._header()

    def _there(self, port: int) -> str:
        """The argument that tells whether an output is there."""
        return f"there{port}_{self.names.outputs[port]}"

    def _leaf(self, port: int, leaf: int) -> str:
        """The argument of a leaf of an output."""
        return f"out{port}_{self.names.outputs[port]}_{self.names.output_leaves[port][leaf]}"

    def _outputs(self, bound: Bound, kinds: dict[tuple[int, int], str]) -> str:
        """The copies of what a tick gives; `kinds` learns the type of each leaf."""
        arrays = {a.name: a for a in (*self._arrays.held.values(), *self._arrays.made.values())}
        arrays |= {name: a for name, (a, _) in self._arrays.known.items()}
        lines = []
        for p, (port, (flag, leaves)) in enumerate(
            zip(self.pipeline.outputs, bound.program.outputs, strict=True)
        ):
            there = f"*{self._there(p)}"
            if flag is None:
                lines.append(f"  {there} = 0;")
                continue
            name, at = self._arrays.at(flag, ())
            lines.append(f"  {there} = {name}[{at}] != 0;")
            for n, (leaf, value) in enumerate(zip(port.leaves, leaves, strict=True)):
                name, at = self._arrays.at(value, leaf.shape)
                kinds[p, n] = _wider(kinds.get((p, n)), arrays[name].kind)
                to = self._leaf(p, n)
                size = max(math.prod(leaf.shape), 1)
                source = f"{name}[{at} + k]" if at else f"{name}[k]"
                lines.append(f"  for (int k = 0; k < {size}; ++k) {to}[k] = {source};")
        return "\n".join(lines)

    # -- text ------------------------------------------------------------------------------------------------

    def arguments(self) -> list[tuple[str, str]]:
        """Of the top function: declaration and name."""
        bits = max(len(self.pipeline.inputs), 1)
        found = [
            ("bool restart", "restart"),
            ("int64_t time", "time"),
            (f"ap_uint<{bits}> present", "present"),
            ("const int64_t seed[2]", "seed"),
        ]
        found += [(f"const {a.kind} {a.name}[{a.size}]", a.name) for row in self.inputs for a in row]
        for port in self.outputs:
            found.append((f"bool *{port.there}", port.there))
            found += [(f"{a.kind} {a.name}[{a.size}]", a.name) for a in port.leaves]
        return [*found, ("int64_t count[3]", "count")]

    def _head(self, indent: int) -> str:
        return (",\n" + " " * indent).join(text for text, _ in self.arguments())

    def _text(self, bodies: list[tuple[list[str], str, str]]) -> str:
        name = self.names.module
        functions = [self._pattern(key, *body) for key, body in zip(self.keys, bodies, strict=True)]
        used = set(re.findall(r"\b(?:s|at)\d+\b", "\n".join(functions)))
        tables = [t for t in self._writer.tables.values() if t.split()[3].split("[")[0] in used]
        known = [
            f"static const {a.kind} {a.name}[{a.size}] = {{{', '.join(map(literal, words))}}};"
            for a, words in self._arrays.known.values()
        ]
        return "\n".join(
            [
                f"// {comment(name)}, generated by flowgraph for high-level synthesis: fixed point of",
                f"// {self.player.formats.width} bits. To compile and play it on this computer: make",
                f'#include "{name}_hls.h"',
                kernels(int(self.player.most), None).replace("#include <stdint.h>", "#include <cstdint>"),
                _WORDS,
                *known,
                *tables,
                *self._registers(),
                *functions,
                self._top(),
                self._peek(),
            ]
        )

    def _registers(self) -> list[str]:
        """The memory between ticks, as it is at power-up."""
        lines = ["// registers, and what they are at a restart"]
        for array, words in zip(self.registers, self.player.cells, strict=True):
            flat = np.asarray(words).astype(np.int64).ravel().tolist()
            first = ", ".join(map(literal, flat)) or "0"
            lines.append(f"static const {array.kind} first_{array.name}[{array.size}] = {{{first}}};")
            lines.append(f"static {array.kind} {array.name}[{array.size}] = {{{first}}};")
        return [*lines, ""]

    def _pattern(self, key: int, parts: list[str], outputs: str, end: str) -> str:
        """The function of a pattern of present inputs."""
        present = [p.name for k, p in enumerate(self.pipeline.inputs) if key >> k & 1]
        time, seed = (self._arrays.held[n].name for n in (self.pipeline.time, self.pipeline.seed))
        lines = [f"// a tick with {comment(', '.join(present))}", f"static void tick_{key}("]
        lines[-1] += f"{self._head(len(lines[-1]))}) {{"
        lines += [f"  const int64_t {time}[1] = {{time}};", f"  const int64_t *{seed} = seed;"]
        lines.append(f"  (void){time}; (void){seed}; (void)count;")
        new = [line for a in self._next if f"{a.name}[" in end for line in declared(a, "  ")]
        return "\n".join([*lines, *parts, outputs, *new, end, "}", ""])

    def _top(self) -> str:
        name = self.names.module
        names = [n for _, n in self.arguments()]
        head = f"void {name}_hls("
        lines = [head + f"{self._head(len(head))}) {{"]
        lines += [f"#pragma HLS INTERFACE s_axilite port={n}" for n in [*names, "return"]]
        lines += [line for a in self.registers for line in declared(a, "")[1:]]
        lines.append("  if (restart) {")
        lines += [
            f"    for (int k = 0; k < {a.size}; ++k) {a.name}[k] = first_{a.name}[k];" for a in self.registers
        ]
        lines += ["    for (int k = 0; k < 3; ++k) count[k] = 0;", "  }"]
        lines += [f"  *{port.there} = 0;" for port in self.outputs]
        lines.append("  switch (present) {")
        call = ", ".join(names)
        lines += [f"    case {key}: tick_{key}({call}); break;" for key in self.keys]
        lines += ["    default: break; // a pattern without formats: nothing is done", "  }", "}", ""]
        return "\n".join(lines)

    def _peek(self) -> str:
        """What only a test bench calls: it reads or writes the registers."""
        lines = [
            "#ifndef __SYNTHESIS__",
            f"void {self.names.module}_registers(int64_t *words, bool write) {{",
            "  (void)words; (void)write;",
        ]
        begin = 0
        for a in self.registers:
            at = f"words[{begin} + k]"
            each = f"if (write) {a.name}[k] = {at}; else {at} = (int64_t){a.name}[k];"
            lines.append(f"  for (int k = 0; k < {a.size}; ++k) {{ {each} }}")
            begin += a.size
        return "\n".join([*lines, "}", "#endif", ""])

    def _header(self) -> str:
        name, pipeline = self.names.module, self.pipeline
        guard = f"{name.upper()}_HLS_H"
        formats = self.player.formats
        lines = [
            f"#ifndef {guard}",
            f"#define {guard}",
            "#include <ap_int.h>",
            "#include <cstdint>",
            "",
            f"// {comment(name)}: one call is one tick.",
            "// restart: first put the registers and count to their beginning.",
            "// time: of the tick, ns. seed: two words of 32 bits, low first.",
            "// present: bit k tells that input k is there; there0_X: whether output 0, X, is.",
            "// count, which the caller keeps: words that were cut, quotients by zero, words lost to zero.",
            "// A real x is the whole number nearest to x 2^fraction; -2^62 is a reading that is not there.",
        ]
        for k, (port, arrays) in enumerate(zip(pipeline.inputs, self.inputs, strict=True)):
            for leaf, a in zip(port.leaves, arrays, strict=True):
                what = (
                    fraction_text(formats.fractions.get(leaf.value)) if leaf.dtype == "real" else leaf.dtype
                )
                lines.append(f"// input {k} {a.name}: {port.name}.{leaf.name} {list(leaf.shape)}, {what}")
        for key, bound in zip(self.keys, self.bound, strict=True):
            for port, made, (flag, leaves) in zip(
                pipeline.outputs, self.outputs, bound.program.outputs, strict=True
            ):
                for leaf, a, n in zip(
                    port.leaves, made.leaves, leaves if flag is not None else (), strict=False
                ):
                    what = fraction_text(bound.fractions.get(n)) if leaf.dtype == "real" else leaf.dtype
                    lines.append(f"// present {key}: {a.name} {list(leaf.shape)}, {what}")
        head = f"void {name}_hls("
        lines += [
            head + f"{self._head(len(head))});",
            "#ifndef __SYNTHESIS__",
            f"void {name}_registers(int64_t *words, bool write);",
            "#endif",
            "",
            "#endif",
            "",
        ]
        return "\n".join(lines)


def fraction_text(fraction: np.ndarray | None) -> str:
    """The fraction of a value, or of each of its elements where they differ."""
    slimmed = slim(np.where(fraction == FREE, 0, fraction)) if fraction is not None else np.zeros(1)
    return f"fraction {' '.join(str(int(f)) for f in slimmed.ravel())}"


def declared(array: Array, indent: str) -> list[str]:
    """The declaration of an array, and the pragma that makes registers of a small one."""
    if array.size > REGISTERS_UP_TO:  # a memory: static, or many would be too much for a stack
        return [f"{indent}static {array.kind} {array.name}[{array.size}];"]
    lines = [f"{indent}{array.kind} {array.name}[{array.size}];"]
    if array.size > 1:
        lines.append(f"#pragma HLS ARRAY_PARTITION variable={array.name} complete")
    return lines


def literal(n: int) -> str:
    """A 64-bit integer as C++ has it: the least is no literal."""
    if -(2**31) < n < 2**31:
        return str(n)
    return f"INT64_C({n})" if n > -(2**63) else f"(-INT64_C({2**63 - 1}) - 1)"


def _wider(one: str | None, other: str) -> str:
    """The type that holds the words of both."""
    if one is None or one == other:
        return other
    bits = [re.findall(r"^ap_int<(\d+)>$", kind) for kind in (one, other)]
    return f"ap_int<{max(int(b[0]) for b in bits)}>" if all(bits) else "int64_t"


def _pipelined(lines: Sequence[str]) -> list[str]:
    """A pragma in each loop that has no other in it."""
    found: list[str] = []
    for n, line in enumerate(lines):
        found.append(line)
        indent = len(line) - len(line.lstrip())
        if not (line.lstrip().startswith("for (") and line.endswith("{")):
            continue
        inside = []
        for later in lines[n + 1 :]:
            if later == " " * indent + "}":
                break
            inside.append(later)
        if not any(re.search(r"\b(for|while) \(", x) for x in inside):
            found.append("#pragma HLS PIPELINE II=1")
    return found


_WORDS = """
// A product of two words, as wide as both together.
template <int A, int B> static inline int64_t fx_times(const ap_int<A> &a, const ap_int<B> &b) {
  const ap_int<A + B> product = a * b;
  return (int64_t)product;
}

// A word of W bits, or the largest, counted.
template <int W> static inline int64_t fx_fit(int64_t x, int64_t *count) {
  return fx_fit(x, count, ((int64_t)1 << (W - 1)) - 1);
}
"""

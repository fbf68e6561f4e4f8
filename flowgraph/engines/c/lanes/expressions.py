"""One operation on the lanes of several runs, as an expression over vector types of GCC and Clang."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from flowgraph.engines.c.expressions import ARITHMETIC, IN_LANES, Expressions
from flowgraph.engines.c.nodes import Buffer, Node
from flowgraph.engines.c.syntax import CTYPES, ctype
from flowgraph.engines.comparisons import COMPARISONS
from flowgraph.errors import LoweringError
from flowgraph.recorder.ops import FUNCTIONS

TYPES = {
    "real": "fg_real",
    "bool": "fg_mask",
    "int64": "fg_long",
    "uint64": "fg_ulong",
    "int32": "fg_int",
    "uint32": "fg_uint",
}
_JOINED = {
    "logical_and": "&",
    "bitwise_and": "&",
    "logical_or": "|",
    "bitwise_or": "|",
    "logical_xor": "^",
    "bitwise_xor": "^",
}
_SHIFTS = {"bitwise_left_shift": "<<", "bitwise_right_shift": ">>"}
_MOST_POWER = 8
"""The largest whole power that is written as products: three roundings, as `pow` has less than one."""
_EACH = (FUNCTIONS | {"floor", "ceil", "trunc"}) - {"remainder", "floor_divide", "pow"}


class NoLanesError(LoweringError):
    """A pipeline that must be run one run at a time."""


def no_lanes(what: str, origin: str) -> NoLanesError:
    """What is raised for an operation that has no form in lanes."""
    return NoLanesError(
        "this pipeline runs one run at a time",
        path=origin,
        expected="arithmetic, functions, products and factorizations",
        got=what,
        fix="nothing need be done: its runs go as threads",
    )


class LaneExpressions(Expressions):
    """Writes operations on lanes; the arguments that it is given are vectors where the node varies."""

    def __init__(self, choice: Callable[..., str] = lambda *_: "") -> None:
        super().__init__("double", choice=choice)
        self._varies: dict[Node, bool] = {}

    def ctype(self, dtype: str) -> str:
        return TYPES[dtype]

    def kind(self, buffer: Buffer) -> str:
        """Constants are alike in all lanes."""
        return ctype(buffer.dtype, self.real) if buffer.kind == "const" else TYPES[buffer.dtype]

    def varies(self, node: Node) -> bool:
        """Whether a node may differ from lane to lane."""
        if node not in self._varies:
            if node.op in ("const", "given", "iota"):
                found = False
            elif node.op in ("load", "gather"):
                found = node.extra[0].kind != "const" or any(self.varies(a) for a in node.args)
            else:
                found = node.op == "reduce" or any(self.varies(a) for a in node.args)
            self._varies[node] = found
        return self._varies[node]

    def splat(self, dtype: str, text: str) -> str:
        """A number in all lanes."""
        return f"{TYPES[dtype]}_of({f'-(int64_t)({text})' if dtype == 'bool' else text})"

    def pick(self, dtype: str, mask: str, yes: str, no: str) -> str:
        return f"{TYPES[dtype]}_pick({mask}, {yes}, {no})"

    def compared(self, kind: str, text: str) -> str:
        """A comparison of vectors as a mask."""
        return f"__builtin_convertvector({text}, fg_mask)" if kind.endswith("32") else f"(fg_mask)({text})"

    def write(self, node: Node, args: Sequence[str]) -> str:
        if not self.varies(node):
            return super().write(node, args)
        op, dtype, origin = node.op, node.dtype, node.origin
        kind = node.args[0].dtype
        a, b = args[0], args[-1]
        if op in ARITHMETIC:
            return self._sum(op, dtype, args)
        if op == "divide":
            return f"{a} / {b}"
        if op == "negative":
            return f"-{a}" if dtype == "real" else self._sum("subtract", dtype, (self.splat(dtype, "0"), a))
        if op in COMPARISONS:
            if kind == "bool" and op not in ("equal", "not_equal"):
                raise no_lanes(f"{op} of truths", origin)
            return self.compared(kind, f"{a} {COMPARISONS[op]} {b}")
        if op in _JOINED:
            return f"{a} {_JOINED[op]} {b}"
        if op == "where":
            return self.pick(dtype, *args)
        if op in ("logical_not", "bitwise_invert"):
            return f"~{a}"
        if op == "isnan":
            return f"(fg_mask)({a} != {a})"
        if op == "isfinite":
            return f"(fg_mask)({a} - {a} == {self.splat('real', '0.0')})"
        if op == "astype" and kind == "real" and dtype not in ("real", "bool"):
            return self.each(op, self.helper(f"fg_whole_{dtype}"), dtype, node, args)
        if op == "astype":
            return self._cast_lanes(kind, dtype, a)
        if op in ("maximum", "minimum"):
            more = f" | ({a} != {a})" if dtype == "real" else ""
            wins = self.compared(dtype, f"({a} {'>' if op == 'maximum' else '<'} {b}){more}")
            return self.pick(dtype, wins, a, b)
        if op == "abs":
            return self._size(dtype, a)
        if op in ("round", "floor", "ceil", "trunc") and dtype != "real":
            return a
        if op == "float32_bits":
            return self.each(op, self.helper("fg_float_bits"), dtype, node, args)
        if op == "sqrt":
            return f"fg_real_root({a})"
        if op in IN_LANES and dtype == "real":
            return f"{self.helper('fg_lanes_' + op)}({', '.join(args)})"
        if op in _EACH and dtype == "real":
            return self.each(op, op, dtype, node, args)
        if op == "round":
            return self.each(op, "rint", dtype, node, args)
        if op == "sign" and dtype == "real":
            up, down = (f"((fg_mask)({a} {s} {self.splat('real', '0.0')}) & 1)" for s in "><")
            return self.pick(dtype, f"(fg_mask)({a} != {a})", a, self._turned(f"{up} - {down}", dtype))
        shift = _SHIFTS.get(op)
        if shift and node.args[1].op == "const" and 0 <= node.args[1].extra[0] < int(dtype.lstrip("uint")):
            wide = TYPES[dtype if op == "bitwise_right_shift" else f"u{dtype.lstrip('u')}"]
            return f"({TYPES[dtype]})(({wide}){a} {shift} {int(node.args[1].extra[0])})"
        if op in ("remainder", "floor_divide", "pow"):
            return self._quotient(op, dtype, node, args)
        raise no_lanes(f"{op} on {dtype}", origin)

    def each(self, op: str, call: str, dtype: str, node: Node, args: Sequence[str]) -> str:
        """A function of scalars, lane by lane: a loop that the compiler joins again where it can."""
        kinds = tuple(n.dtype for n in node.args)

        def make(name: str) -> str:
            given = ", ".join(f"{TYPES[k]} x{i}" for i, k in enumerate(kinds))
            parts = [
                f"    union {{ {TYPES[k]} all; {_element(k)} one[FG_LANES]; }} a{i};\n    a{i}.all = x{i};"
                for i, k in enumerate(kinds)
            ]
            one = ", ".join(f"a{i}.one[l]" for i in range(len(kinds)))
            return "\n".join(
                [
                    f"static FG_INLINE {TYPES[dtype]} {name}({given}) {{",
                    *parts,
                    f"    union {{ {TYPES[dtype]} all; {_element(dtype)} one[FG_LANES]; }} made;",
                    "    FG_SIMD(omp simd)",
                    f"    for (int32_t l = 0; l < FG_LANES; l++) made.one[l] = {call}({one});",
                    "    return made.all;",
                    "}",
                    "",
                ]
            )

        return f"{self.function(('each', call, dtype, kinds), op, make)}({', '.join(args)})"

    def gathered(self, buffer: Buffer, place: str, at: str, kind: str, step: int, size: int) -> str:
        """An element of a buffer that is another in each lane; `place` is where those begin, `at` which."""
        alike = buffer.kind == "const"
        index, top = ("fg_int", 31) if kind == "int32" else ("fg_long", 63)

        def make(name: str) -> str:
            table = ctype(buffer.dtype, self.real) if alike else TYPES[buffer.dtype]
            return f"""static FG_INLINE {TYPES[buffer.dtype]} {name}(const {table} *table, {index} at) {{
    union {{ {TYPES[buffer.dtype]} all; {_element(buffer.dtype)} one[FG_LANES]; }} made;
    const {index} low = at & ~(at >> {top}), beyond = low > {size - 1};
    const {index} in = ({size - 1} & beyond) | (low & ~beyond);
    for (int32_t l = 0; l < FG_LANES; l++) made.one[l] = table[{step} * in[l]]{"" if alike else "[l]"};
    return made.all;
}}
"""

        name = self.function(("gather", alike, buffer.dtype, step, size, index), "gather", make)
        whole = at if kind in ("int32", "int64") else f"__builtin_convertvector({at}, fg_long)"
        return f"{name}({place}, {whole})"

    def _sum(self, op: str, dtype: str, args: Sequence[str]) -> str:
        """Whole numbers wrap around, as in NumPy, so they go through unsigned ones."""
        a, b = args
        if dtype in ("int32", "int64"):
            wide = TYPES[f"u{dtype}"]
            return f"({TYPES[dtype]})(({wide}){a} {ARITHMETIC[op]} ({wide}){b})"
        if dtype == "bool":
            return f"{a} {'|' if op == 'add' else '&'} {b}"
        return f"{a} {ARITHMETIC[op]} {b}"

    def _turned(self, text: str, dtype: str) -> str:
        return f"__builtin_convertvector({text}, {TYPES[dtype]})"

    def _cast_lanes(self, kind: str, dtype: str, a: str) -> str:
        if dtype == "bool":
            return a if kind == "bool" else self.compared(kind, f"{a} != {self.splat(kind, '0')}")
        if kind == "bool":
            return self._turned(f"({a} & 1)", dtype)
        return self._turned(a, dtype)

    def _size(self, dtype: str, a: str) -> str:
        if dtype == "real":
            return f"fg_real_size({a})"
        if dtype.startswith("u") or dtype == "bool":
            return a
        zero = self.splat(dtype, "0")
        below = self.compared(dtype, f"{a} < {zero}")
        return self.pick(dtype, below, self._sum("subtract", dtype, (zero, a)), a)

    def _power(self, power: int, a: str) -> str:
        """A whole power as products, by squares."""

        def make(name: str) -> str:
            lines, made = [], ""
            for k in range(power.bit_length()):
                lines.append(f"    const fg_real s{k} = {f's{k - 1} * s{k - 1}' if k else 'x'};")
                if power >> k & 1:
                    made = f"{made} * s{k}" if made else f"s{k}"
            body = "\n".join(lines)
            return f"static FG_INLINE fg_real {name}(fg_real x) {{\n{body}\n    return {made};\n}}\n"

        return f"{self.function(('power', power), f'power_{power}', make)}({a})"

    def _quotient(self, op: str, dtype: str, node: Node, args: Sequence[str]) -> str:
        a, _ = args
        power = node.args[1].extra[0] if op == "pow" and node.args[1].op == "const" else None
        if dtype == "real" and op == "pow":
            if power is not None and power in range(2, _MOST_POWER + 1):
                return self._power(int(power), a)
            if power == 0.5:
                return f"fg_real_root({a})"
            return self.each(op, "pow", dtype, node, args)
        if dtype == "real":
            return self.each(op, self.helper(f"fg_{op}"), dtype, node, args)
        if op == "pow":
            raise no_lanes(f"pow of {dtype}", node.origin)
        return self.each(op, self.helper(f"fg_{op}_{dtype[0]}"), dtype, node, args)


def _element(dtype: str) -> str:
    return "double" if dtype == "real" else "int64_t" if dtype == "bool" else CTYPES[dtype]

"""C expressions of what works element by element: sums, products, functions, comparisons, casts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowgraph.engines.comparisons import COMPARISONS
from flowgraph.engines.fixed import rules, shifts
from flowgraph.engines.fixed.shifts import Site
from flowgraph.engines.fixed.text import Text, never_none, unless_none
from flowgraph.errors import LoweringError
from flowgraph.recorder.ops import SINC, Spec

_JOIN = {"logical_and": "&&", "logical_or": "||"}
_BITS = {"bitwise_and": "&", "bitwise_or": "|", "bitwise_xor": "^"}
_WHOLE = {"floor": 0, "ceil": 1, "trunc": 2, "round": 3}
_ONE = {"sqrt": "fx_square_root", "exp": "fx_exponential", "log": "fx_logarithm", SINC: "fx_sine_over"}
_TWO = {"atan2": "fx_angle", "hypot": "fx_length"}


class Elements(Text):
    """Text that knows the expression of one element."""

    def expression(self, s: Site, x: list[str], index: Sequence[str]) -> str:
        i, op = s.i, s.i.op
        kinds = [s.specs[a].dtype for a in i.args]
        if op in ("isnan", "isfinite"):
            if kinds[0] != "real" or never_none(x[0]):
                return str(int(op != "isnan"))
            return f"{x[0]} {'==' if op == 'isnan' else '!='} FX_NAN"
        if op == "materialise" or op == "positive":
            return x[0]
        if op == "negative":
            if kinds[0] == "real":
                return unless_none(x[0], f"-{x[0]}")
            return self.wrapped(f"-(uint64_t){x[0]}", i.spec)
        if op == "abs":
            size = f"fx_abs({x[0]})"
            return unless_none(x[0], size) if kinds[0] == "real" else size
        if op == "astype":
            return self.cast(s, x[0], kinds[0], index)
        if "real" in kinds:
            return self.real(s, x, index)
        return self.whole(s, x, kinds)

    def real(self, s: Site, x: list[str], index: Sequence[str]) -> str:
        i, op = s.i, s.i.op
        out = s.out
        if op in ("add", "subtract"):
            a, b, end = (self.shift(by, index) for by in shifts.shifts_of_sum(s))
            return (
                f"fx_shift(fx_shift({x[0]}, {a}) {'+' if op == 'add' else '-'} fx_shift({x[1]}, {b}), {end})"
            )
        if op == "multiply":
            return f"fx_shift({self.product(*x)}, {self.shift(shifts.shift_of_product(s), index)})"
        if op == "divide":
            return f"fx_quotient({x[0]}, {x[1]}, {self.shift(shifts.shift_of_quotient(s), index)})"
        fractions = [
            None if f is None else self.shift(_wide(shifts.bound_fraction(f), i.spec), index) for f in s.f
        ]
        to = self.shift(_wide(out, i.spec), index)
        if op in _ONE:
            return f"{_ONE[op]}({x[0]}, {fractions[0]}, {to})"
        if op in ("sin", "cos"):
            return f"fx_sine({x[0]}, {fractions[0]}, {to}, {int(op == 'cos')})"
        if op in _TWO:
            return f"{_TWO[op]}({x[0]}, {x[1]}, {fractions[0]}, {fractions[1]}, {to})"
        if op in _WHOLE:
            return f"fx_shift(fx_whole({x[0]}, {fractions[0]}, {_WHOLE[op]}), -({to}))"
        if op == "sign":
            return f"fx_shift(({x[0]} > 0) - ({x[0]} < 0), -({to}))"
        ends = [
            None
            if f is None
            else self.shift(_wide(shifts.between(np.broadcast_to(f, _common(f, out)), out), i.spec), index)
            for f in s.f
        ]
        if op == "where":
            kept = [unless_none(a, f"fx_shift({a}, {e})") for a, e in zip(x[1:], ends[1:], strict=True)]
            return f"{x[0]} ? {kept[0]} : {kept[1]}"
        if op == "copysign":
            return (
                f"({x[1]} < 0 ? -fx_shift(fx_abs({x[0]}), {ends[0]}) : fx_shift(fx_abs({x[0]}), {ends[0]}))"
            )
        p, q, at = shifts.aligned(s)
        a, b = f"fx_shift({x[0]}, {self.shift(p, index)})", f"fx_shift({x[1]}, {self.shift(q, index)})"
        if op in COMPARISONS:
            return f"{a} {COMPARISONS[op]} {b}"
        if op in ("maximum", "minimum"):
            order = ">=" if op == "maximum" else "<="
            return f"{a} {order} {b} ? fx_shift({x[0]}, {ends[0]}) : fx_shift({x[1]}, {ends[1]})"
        if op == "remainder":
            return f"fx_shift(fx_remainder({a}, {b}), {self.shift(at - out, index)})"
        if op == "floor_divide":
            return f"fx_shift(fx_floor_divide({a}, {b}), -({to}))"
        rules.bind(s)  # says so
        raise AssertionError(op)

    def whole(self, s: Site, x: list[str], kinds: list[str]) -> str:
        i, op = s.i, s.i.op
        big = "uint64" in kinds
        u = [f"(uint64_t){a}" for a in x]
        if op in ("add", "subtract", "multiply"):
            sign = {"add": "+", "subtract": "-", "multiply": "*"}[op]
            return self.wrapped(f"{u[0]} {sign} {u[1]}", i.spec)
        if op in COMPARISONS:
            a, b = u if big else x
            return f"{a} {COMPARISONS[op]} {b}"
        if op in _JOIN:
            return f"{x[0]} {_JOIN[op]} {x[1]}"
        if op == "logical_xor":
            return f"!{x[0]} != !{x[1]}"
        if op == "logical_not":
            return f"!{x[0]}"
        if op == "bitwise_invert":
            return f"!{x[0]}" if i.spec.dtype == "bool" else self.wrapped(f"~{u[0]}", i.spec)
        if op in _BITS:
            return self.wrapped(f"{u[0]} {_BITS[op]} {u[1]}", i.spec)
        if op in ("bitwise_left_shift", "bitwise_right_shift"):
            bits = 64 if i.spec.dtype.endswith("64") else 32
            if op == "bitwise_left_shift":
                return self.wrapped(f"({x[1]} >= {bits} || {x[1]} < 0 ? 0 : {u[0]} << {x[1]})", i.spec)
            if i.spec.dtype.startswith("u"):
                return self.wrapped(f"({x[1]} >= {bits} || {x[1]} < 0 ? 0 : {u[0]} >> {x[1]})", i.spec)
            return f"fx_down({x[0]}, {x[1]} >= {bits} || {x[1]} < 0 ? 63 : (int){x[1]})"
        if op == "where":
            return f"{x[0]} ? {x[1]} : {x[2]}"
        if op in ("maximum", "minimum"):
            a, b = u if big else x
            return f"{a} {'>=' if op == 'maximum' else '<='} {b} ? {x[0]} : {x[1]}"
        if op in ("floor_divide", "remainder") and not big:
            return f"fx_{op}({x[0]}, {x[1]})"
        if op == "sign":
            return f"({x[0]} > 0) - ({x[0]} < 0)"
        if op in ("floor", "ceil", "round", "trunc"):
            return x[0]
        if op == "float32_bits":
            return f"fx_float32_bits({x[0]})"
        raise LoweringError(
            f"{op} of {i.spec.dtype} has no form in fixed-point C",
            path=i.line,
            expected="an operation of the table",
            got=op,
            fix='use engine="fixed", which has it',
        )

    def cast(self, s: Site, x: str, kind: str, index: Sequence[str]) -> str:
        to = s.i.attrs["dtype"]
        if kind == to:
            return x
        if to == "real":
            most = (
                f"(uint64_t){x} > FX_LIMIT ? FX_LIMIT : {x}" if kind == "uint64" else f"fx_cut({x}, FX_LIMIT)"
            )
            return f"fx_shift({most}, {self.shift(_wide(-s.out, s.i.spec), index)})"
        if kind == "real":
            if to == "bool":
                return f"{x} != 0"
            f = self.shift(_wide(shifts.bound_fraction(s.real(0)), s.i.spec), index)
            return self.wrapped(f"fx_whole({x}, {f}, 2)", Spec((), to))
        return self.wrapped(x, Spec((), to))


def _wide(numbers: np.ndarray, spec: Spec) -> np.ndarray:
    return np.broadcast_to(numbers, spec.shape)


def _common(f: np.ndarray, out: np.ndarray) -> tuple[int, ...]:
    return np.broadcast_shapes(f.shape, out.shape)

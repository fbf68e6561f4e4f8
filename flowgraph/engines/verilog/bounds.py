"""How large a word can be: sums that no format cuts must fit the words that the machine multiplies.

A real number is cut to its word, and so are numbers of 32 bits. What comes between (whole numbers that count,
choices, parts of functions) is kept as it is, and must have less than 34 bits. That is known by how it is
built (`proved`), or follows from the words that a sum is made of; where it does not, it is refused.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from functools import wraps
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar, cast

from flowgraph.engines.verilog.nodes import NO_LIMIT, Constant, Held, Joined, Nodes, Sum, Table, Term, View
from flowgraph.errors import LoweringError

if TYPE_CHECKING:
    from flowgraph.engines.verilog.plan import Plan

MOST = 2**33 - 1
"""Of a word that the machine multiplies, by size."""

_UNKNOWN = frozenset(["DYN", "TAKE", "NORM", "NORM_EVEN"])

_P = ParamSpec("_P")
_R = TypeVar("_R")
_N = TypeVar("_N", bound=Nodes)


def proved(method: Callable[Concatenate[_N, _P], _R]) -> Callable[Concatenate[_N, _P], _R]:
    """A method whose words fit by how it is built, for every argument that fits."""

    @wraps(method)
    def within(self: _N, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        begin = len(self.nodes)
        made = method(self, *args, **kwargs)
        self.proved.update(range(begin, len(self.nodes)))
        return made

    return cast("Callable[Concatenate[_N, _P], _R]", within)


def most_of(nodes: Nodes, n: int) -> int:
    """The largest size of a word, or of one of a row."""
    found = nodes.sizes.get(n)
    if found is None:
        found = nodes.sizes[n] = MOST if n in nodes.proved else _most(nodes, n)
    return found


def _most(nodes: Nodes, n: int) -> int:
    node = nodes.nodes[n]
    match node:
        case Constant():
            return min(abs(node.word), MOST)  # a reading that is not there is no number
        case Held():
            return (1 << node.width - 1) - 1 if node.width else 2**32
        case Table():
            return max(map(abs, node.words), default=0)
        case View():
            return most_of(nodes, node.of)
        case Joined():
            return max(most_of(nodes, r) for r in node.parts)
        case Sum(mode="RAW"):
            return most_of_sum(nodes, node.terms, node.end, node.limit, node.gather)
        case Sum(mode="FIT"):
            return (1 << nodes.width - 1) - 1
        case Sum(mode="WIDE"):
            return (1 << nodes.wide - 1) - 1
        case Sum(mode="U32" | "S32"):
            return 2**32
        case Sum(mode="START" | "INDEX"):
            return MOST
    return 1


def most_of_sum(
    nodes: Nodes, terms: Iterable[Term], end: int = 0, limit: int = NO_LIMIT, gather: str = ""
) -> int:
    """The largest size of a sum of terms; of what is chosen by one word, the larger side counts."""
    chosen: dict[int, dict[str, int]] = defaultdict(lambda: {"SEL": 0, "SELN": 0})
    total = 0
    for t in terms:
        size = _most_of_term(nodes, t)
        if limit != NO_LIMIT:
            size = min(size, 1 << 62 - limit)
        if t.times and gather != "peak":
            size *= t.times
        if t.kind in ("SEL", "SELN"):
            chosen[t.b][t.kind] += size
        else:
            total += size
    total += sum(max(by.values()) for by in chosen.values())
    return _shifted(total, end)


def _most_of_term(nodes: Nodes, t: Term) -> int:
    if t.kind in _UNKNOWN:
        return MOST
    if t.kind in ("ZERO", "ISNAN"):
        return 1
    if t.kind == "BITS":
        return 36
    size = most_of(nodes, t.a)
    if t.kind == "MUL":
        size *= most_of(nodes, t.b)
    elif t.kind in ("AND", "OR", "XOR"):
        size = (1 << max(size, most_of(nodes, t.b)).bit_length()) - 1
    return _shifted(size, t.shift)


def _shifted(size: int, by: int) -> int:
    return size << -by if by <= 0 else (size + (1 << by - 1)) >> by


def need_room(plan: Plan) -> None:
    """Refuse sums of which it is not known that they fit.

    Raises:
        LoweringError: naming the operation and its line.
    """
    tick = plan.tick
    for n in plan.order:
        if tick.made(n).mode == "RAW" and (size := most_of(tick, n)) > MOST:
            raise LoweringError(
                "a whole number between may not fit a word of the machine",
                path=tick.line[n],
                expected="less than 2^33 by size",
                got=f"up to {size:.3g}",
                fix="make it of fewer or smaller numbers, or lower the graph to C",
            )


__all__ = ["MOST", "most_of", "most_of_sum", "need_room", "proved"]

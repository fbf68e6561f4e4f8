"""What the machine computes: sums of a few terms, each sum a word of the memory, made once.

A term is two words, what is made of them, and a shift; a sum of terms is shifted again and cut to a word.
That is all that the machine knows, so every operation of a pipeline becomes such sums, element by element.
Sums that are equal are one; terms that are known to be zero are left out, sums of known words are known, and
a sum that is one word unchanged is that word. So a product with a sparse matrix costs what its entries cost,
and of a symmetric matrix each entry is computed once.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import SupportsInt

from flowgraph.engines.fixed import integers as z
from flowgraph.pipeline.formats import NOT_A_NUMBER

KINDS = (
    "ZERO",
    "MUL",
    "SEL",
    "SELN",
    "DYN",
    "AND",
    "OR",
    "XOR",
    "BITS",
    "NORM",
    "NORM_EVEN",
    "TAKE",
    "ISNAN",
    "GET",
)
"""What a term makes of its words a and b, by number in a microword.

MUL a b; SEL a where b is not 0, SELN where it is; DYN a 2^-b; AND, OR, XOR of bits; BITS the length of |a|;
NORM |a| at full length, NORM_EVEN with an even shift; TAKE what unit b has made; ISNAN whether a is none;
GET the element of the row a whose number the index b is.
"""

MODES = ("", "FIT", "RAW", "U32", "S32", "LT", "LE", "EQ", "NE", "HOLD", "START", "WIDE", "INDEX")
"""What becomes of a sum: cut to a word of a real number, kept, 32 bits of it, compared with 0, given to a
unit, cut to a wider word, or made an index: a place in a row, 0 for what is less."""

UNITS = ("divide", "root", "logarithm", "angle")
PAIRED = ("divide", "angle")
"""Units that are given two numbers, one term each; others are given a sum."""

NO_LIMIT = 15
"""Of a sum whose terms are not cut."""


@dataclass(frozen=True)
class Term:
    """A term of a sum: `a` and `b` are numbers of words, `shift` is to the right.

    With `times` it is so many terms, one for each element of the rows among a and b.
    """

    kind: str
    a: int
    b: int
    shift: int = 0
    minus: bool = False
    times: int = 0


@dataclass(frozen=True)
class Sum:
    """A word that is computed, or a row of them.

    Args:
        terms: at least one; those of a START of a unit that is `PAIRED` go there one after the other.
        mode: what becomes of the sum.
        end: how far the sum is shifted to the right.
        limit: terms are cut to 2^(62 - limit).
        floor: shifts round down; for NORM_EVEN, that the fraction is odd.
        unit: of a START or TAKE.
        row: how many such words there are, each of the elements of the rows among its operands; 0 for one.
        gather: of terms with `times`, whether each element is the sum so far ("running"), or the largest of
            them is taken and no sum ("peak").
    """

    terms: tuple[Term, ...]
    mode: str = "FIT"
    end: int = 0
    limit: int = 0
    floor: bool = False
    unit: int = 0
    row: int = 0
    gather: str = ""


@dataclass(frozen=True)
class Constant:
    """A word that is known."""

    word: int


@dataclass(frozen=True)
class Held:
    """A word that lies in the memory when a tick begins: of a register, an input, the time or the seed.

    Args:
        value: its number in the pipeline.
        place: of the element in the value.
        high: whether it is the upper half of a whole number of 64 bits.
        width: bits of a word of a real number; 0 for what is none.
        row: how many words from there on are meant, for a row.
    """

    value: int
    place: int
    high: bool = False
    width: int = 0
    row: int = 0


@dataclass(frozen=True)
class Table:
    """A row of words that are known."""

    words: tuple[int, ...]

    @property
    def row(self) -> int:
        return len(self.words)


@dataclass(frozen=True)
class View:
    """Elements of a row from `offset` on: so many, or one where `row` is 0."""

    of: int
    offset: int
    row: int = 0


@dataclass(frozen=True)
class Joined:
    """Rows one behind the other, as one; each lies in no other."""

    parts: tuple[int, ...]
    row: int


Node = Sum | Constant | Held | Table | View | Joined


@dataclass
class Nodes:
    """The words of a tick, numbered; arguments come before what is made of them.

    Args:
        width: bits of a word of a real number.
        wide: bits of one that is held in a wider word.

    Attributes:
        now: bits of the words that are made now: one of these two.
        line: for each word, where in the source it comes from.
        doubtful: numbers of words that may be none.
        proved: numbers of words that fit by how they are made.
        sizes: the largest size of a word, where it is known.
    """

    width: int
    wide: int = 0
    nodes: list[Node] = field(default_factory=list)
    line: list[str] = field(default_factory=list)
    doubtful: set[int] = field(default_factory=set)
    proved: set[int] = field(default_factory=set)
    sizes: dict[int, int] = field(default_factory=dict)
    here: str = ""

    def __post_init__(self) -> None:
        self._known: dict[Node, int] = {}
        self.wide = self.wide or self.width
        self.now = self.width
        self.one = self.constant(1)

    def add(self, node: Node) -> int:
        """The number of a node; equal nodes have one."""
        found = self._known.get(node)
        if found is None:
            found = self._known[node] = len(self.nodes)
            self.nodes.append(node)
            self.line.append(self.here)
            if isinstance(node, Sum) and node.mode in ("FIT", "WIDE", "RAW"):
                passing = any(
                    t.a in self.doubtful or (t.kind == "MUL" and t.b in self.doubtful) for t in node.terms
                )
                if passing and all(t.kind in ("MUL", "SEL", "SELN", "DYN", "GET") for t in node.terms):
                    self.doubtful.add(found)
        return found

    def constant(self, word: SupportsInt) -> int:
        return self.add(Constant(int(word)))

    def known(self, n: int) -> int | None:
        """The word, where it is known."""
        node = self.nodes[n]
        return node.word if isinstance(node, Constant) else None

    def row(self, n: int) -> int:
        """How many elements the row n has; 0 for a word."""
        node = self.nodes[n]
        return 0 if isinstance(node, Constant) else node.row

    def made(self, n: int) -> Sum:
        """The sum of that number."""
        node = self.nodes[n]
        assert isinstance(node, Sum)
        return node

    def sum(
        self,
        terms: Iterable[Term],
        *,
        end: int = 0,
        mode: str = "FIT",
        limit: int = 0,
        floor: bool = False,
        row: int = 0,
        gather: str = "",
    ) -> int:
        """The number of a sum, made as simple as it can be.

        Args:
            terms: with shifts of any size.
            end, mode, limit, floor, gather: as in `Sum`.
            row: likewise, where no row among the operands says so.
        """
        mode = self._fitting(mode)
        kept: list[Term] = []
        total = 0
        for t in terms:
            t = self._plain(t)
            value = self._value(t, floor, limit != NO_LIMIT)
            if value is None:
                kept.append(t)
            else:
                cut = value if limit == NO_LIMIT else max(min(value, z.LIMIT >> limit), -(z.LIMIT >> limit))
                total += -cut if t.minus else cut
        if not kept:
            return self.constant(self._ended(total, end, mode, floor))
        if total:
            kept += self._of_known(total)
        elif len(kept) == 1 and not row and (same := self._same(kept[0], end, mode)) is not None:
            return same
        end = 63 if end > 62 else max(end, -62)
        if end == 63:
            return self.constant(0)
        kept.sort(key=lambda t: (t.a, t.b, t.kind, t.shift, t.minus))
        return self.add(Sum(tuple(kept), mode, end, limit, floor, 0, row or self._rows(kept), gather))

    def _rows(self, terms: Iterable[Term]) -> int:
        """How long the row is that terms make."""
        found = {
            self.row(n) for t in terms if not t.times for n in ((t.b,) if t.kind == "GET" else (t.a, t.b))
        }
        found.discard(0)
        assert len(found) < 2, f"{self.here}: rows of {sorted(found)}"
        return found.pop() if found else 0

    def begin(self, unit: str, operands: Sequence[Term], *, odd: bool = False) -> int:
        """Start a unit; `odd` is for NORM_EVEN."""
        place = UNITS.index(unit)
        return self.add(Sum(tuple(operands), "START", 0, 0, odd, place, self._rows(operands)))

    def take(
        self, begun: int, *, shift: int = 0, minus: bool = False, mode: str = "FIT", floor: bool = False
    ) -> int:
        """What a unit has made of what it was given."""
        unit, mode = self.made(begun).unit, self._fitting(mode)
        row = self.row(begun)
        return self.add(Sum((Term("TAKE", begun, unit, shift, minus),), mode, 0, 0, floor, unit, row))

    def _fitting(self, mode: str) -> str:
        return "WIDE" if mode == "FIT" and self.now != self.width else mode

    def _plain(self, t: Term) -> Term:
        """The same term, a product where it is one, with the constant second."""
        if t.kind in ("SEL", "SELN"):
            chosen = self.known(t.b)
            if chosen is not None:
                taken = (chosen != 0) == (t.kind == "SEL")
                return (
                    Term("MUL", t.a, self.one, t.shift, t.minus, t.times)
                    if taken
                    else Term("ZERO", self.one, self.one)
                )
        if t.kind == "DYN" and (by := self.known(t.b)) is not None:
            return Term("MUL", t.a, self.one, t.shift + by, t.minus)
        if t.kind == "MUL" and self.known(t.a) is not None and self.known(t.b) is None:
            t = replace(t, a=t.b, b=t.a)
        if t.kind == "MUL" and self.known(t.a) is None and self.known(t.b) is None and t.b < t.a:
            t = replace(t, a=t.b, b=t.a)
        shift = 63 if t.shift > 62 else max(t.shift, -62)
        return t if shift == t.shift else replace(t, shift=shift)

    def _value(self, t: Term, floor: bool, cut: bool) -> int | None:
        """The value of a term before its sign, where it is known."""
        if t.kind == "ZERO" or (t.shift == 63 and t.kind not in ("DYN", "TAKE")):
            return 0
        a, b = self.known(t.a), self.known(t.b)
        if t.kind == "MUL":
            if a is not None and b is not None:
                return shifted(a * b, t.shift, floor, cut)
            return 0 if 0 in (a, b) and t.a not in self.doubtful and t.b not in self.doubtful else None
        if t.kind in ("SEL", "SELN"):
            return 0 if a == 0 else None
        if t.kind == "ISNAN" and (a is not None or t.a not in self.doubtful):
            return int(a == NOT_A_NUMBER)
        if a is None or b is None:
            return None
        if t.kind in ("AND", "OR", "XOR"):
            made = {"AND": a & b, "OR": a | b, "XOR": a ^ b}[t.kind]
            return shifted(made, t.shift, floor, cut)
        return abs(a).bit_length() if t.kind == "BITS" else None

    def _ended(self, total: int, end: int, mode: str, floor: bool) -> int:
        x = shifted(total, end, floor)
        most = (1 << (self.now - 1)) - 1
        match mode:
            case "FIT" | "WIDE":
                return max(min(x, most), -most)
            case "U32":
                return x & 0xFFFFFFFF
            case "S32":
                return ((x & 0xFFFFFFFF) ^ 0x80000000) - 0x80000000
            case "RAW":
                return x
        return int({"LT": x < 0, "LE": x <= 0, "EQ": x == 0, "NE": x != 0}[mode])

    def _of_known(self, total: int) -> list[Term]:
        """Terms that make a known number."""
        if -(2**32) < total < 2**32:
            return [Term("MUL", self.constant(total), self.one)]
        places = min((total & -total).bit_length() - 1, 32)
        rest = total >> places
        if -(2**32) < rest < 2**32:
            return [Term("MUL", self.constant(rest), self.one, -places)]
        low = total & 0xFFFFFFFF
        high = total >> 32
        return [Term("MUL", self.constant(low), self.one), Term("MUL", self.constant(high), self.one, -32)]

    def _same(self, t: Term, end: int, mode: str) -> int | None:
        """The word that a sum of one term is, if it is one unchanged."""
        if mode == "U32" and self._word32(t) and not t.shift and not end:
            return t.a
        if (
            t.minus
            or t.times
            or t.kind != "MUL"
            or mode not in ("FIT", "WIDE", "RAW")
            or (mode != "RAW" and not self._fits(t.a))
        ):
            return None
        factor = self.known(t.b)
        if factor is None or factor <= 0 or factor & (factor - 1):
            return None
        up = factor.bit_length() - 1
        exact = t.shift <= up <= t.shift + 62 - self.wide
        return t.a if exact and up - t.shift == end else None

    def _word32(self, t: Term) -> bool:
        """Whether a term is a word of 32 bits without a sign."""
        node = self.nodes[t.a]
        plain = t.kind == "MUL" and t.b == self.one and not t.minus and not t.times
        return plain and isinstance(node, Sum) and node.mode == "U32"

    def _fits(self, n: int) -> bool:
        node = self.nodes[n]
        if isinstance(node, View):
            return self._fits(node.of)
        if isinstance(node, Joined):
            return all(map(self._fits, node.parts))
        if isinstance(node, Table):
            return all(abs(w) < 1 << (self.now - 1) for w in node.words)
        if isinstance(node, Held):
            return node.width != 0 and node.width <= self.now
        if isinstance(node, Constant):
            return abs(node.word) < 1 << (self.now - 1)
        return node.mode in ("FIT", "LT", "LE", "EQ", "NE") or (node.mode == "WIDE" and self.now == self.wide)


def shifted(x: int, by: int, floor: bool = False, cut: bool = True) -> int:
    """x 2^-by as the machine shifts: to the nearest, halves upwards; to the left up to +-2^62."""
    if by > 62:
        return 0
    if by >= 0:
        return x >> by if floor or by == 0 else (x + (1 << (by - 1))) >> by
    by = min(-by, 62)
    return max(min(x << by, z.LIMIT), -z.LIMIT) if cut else x << by


NONE_WORD = -(1 << 35)
"""How a reading that is not there lies in the memory."""


def in_memory(word: int) -> int:
    """A word as the memory holds it: 36 bits."""
    return (NONE_WORD if word == NOT_A_NUMBER else word) & ((1 << 36) - 1)

"""A scheduled tick as statements of C: straight code, loops, and operations with loops of their own."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator

from flowgraph.engines.c.blocks import BLOCK, of_a_block
from flowgraph.engines.c.expressions import Expressions
from flowgraph.engines.c.lines import Lines
from flowgraph.engines.c.macros import write_macro, write_product_of_block
from flowgraph.engines.c.nodes import Buffer, Macro, Node, Space, Store
from flowgraph.engines.c.schedule import REPEATED, Schedule, group_of, is_flat
from flowgraph.engines.c.syntax import comment, number
from flowgraph.recorder.ops import FUNCTIONS

_OFTEN = 3  # quotients by one number, from which on it is inverted
_SHORT = 50  # characters of an expression that is written where it is used


class Writer(Lines):
    """Writes one reaction.

    Args:
        plan: what is computed where.
        expressions: of the file.
        names: the C expression of a buffer.
    """

    blocks = True
    """Whether it writes products in blocks, and reads one number of an array where a loop keeps it."""

    def __init__(self, plan: Schedule, expressions: Expressions, names: Callable[[Buffer], str]) -> None:
        super().__init__(expressions, names)
        self.plan = plan
        self.uniform: dict[Node, str] = {}
        self.local: dict[Node, str] = {}
        self.place, self.flat = "", False
        self.in_block: frozenset[Buffer] = frozenset()
        self.often: set[Node] = set()
        self.inverse: dict[Node, str] = {}
        self.kept = {i.node for i in plan.items if isinstance(i, Store) and i.buffer.kind == "state"}
        self.groups: dict[tuple[int, Space], list[Node | Store]] = defaultdict(list)
        self.straight: dict[int, list[Node | Store | Macro]] = defaultdict(list)
        self.ends: list[Store] = []
        for item in plan.items:
            level, space = group_of(item)
            if isinstance(item, Store) and item.buffer.kind == "state" and not space:
                self.ends.append(item)
            elif space and not isinstance(item, Macro):
                if not (isinstance(item, Node) and item.op in REPEATED):
                    self.groups[level, space].append(item)
            elif item not in plan.blocks.values():
                self.straight[level].append(item)

    def body(self) -> list[str]:
        """The lines of the reaction."""
        for level in range(self.plan.levels):
            self._straight(level)
            for (at, space), items in sorted(self.groups.items()):
                if at == level and (at, space) in self.plan.blocks:
                    self._loop_in_blocks(space, items, self.plan.blocks[at, space])
                elif at == level:
                    self._loop(space, items)
        for buffer, stand_in in self.plan.late.items():
            self._note("state that was still in use until here")
            self._copy(buffer, stand_in)
        for store in self.ends:
            self.line(f"{self.at(store.buffer, str(store.offset))} = {self.stored(store)};")
        return self.lines

    def _note(self, text: str) -> None:
        if text != self.place:
            self.place = text
            self.line(f"/* {comment(text)} */")

    # -- straight code -------------------------------------------------------------------------------

    def _straight(self, level: int) -> None:
        for item in self.straight[level]:
            if isinstance(item, Macro):
                self._note(item.origin)
                self.macro(item)
            elif isinstance(item, Store):
                self.line(f"{self.at(item.buffer, str(item.offset))} = {self.stored(item)};")
            elif item.op not in ("const", "given", "reduce"):
                self._compute(item, self.uniform)

    def _compute(self, node: Node, names: dict[Node, str]) -> None:
        text = self.expression(node)
        inline = (
            self.plan.uses[node] == 1
            and len(text) <= _SHORT
            and node not in self.kept
            and node not in self.plan.spills
            and not self._reads_memory(node)
            and (node.space or node.op not in FUNCTIONS)  # once, not in each turn of a loop
        )
        if inline:
            names[node] = text if node.op in ("load", "given") or _closed(text) else f"({text})"
            return
        if node.op not in REPEATED:
            self._note(node.origin)
        names[node] = f"v{node.order}"
        self.line(f"const {self.type_of(node)} v{node.order} = {text};")

    def _reads_memory(self, node: Node) -> bool:
        if node.op == "turn":
            return True
        if node.op not in ("load", "gather", "search"):
            return False
        kind = node.extra[0].kind
        return bool(kind == "state" or (kind == "work" and not node.space))

    # -- loops ---------------------------------------------------------------------------------------

    def _loop_in_blocks(self, space: Space, items: list[Node | Store], product: Macro) -> None:
        (n,) = space
        self.line(f"for (int32_t block = 0; block < {n}; block += {BLOCK}) {{")
        self.depth += 1
        self.line(f"const int32_t end = block < {n - BLOCK} ? block + {BLOCK} : {n};")
        self.in_block = frozenset(v.buffer for v in product.inputs)
        self._loop(space, items, ("block", "end"))
        self.in_block = frozenset()
        self._note(product.origin)
        write_product_of_block(self, of_a_block(product))
        self.depth -= 1
        self.line("}")
        self.place = ""

    def _loop(self, space: Space, items: list[Node | Store], part: tuple[str, str] | None = None) -> None:
        reductions = [i for i in items if isinstance(i, Node) and i.op == "reduce"]
        for node in reductions:
            self.uniform[node] = f"v{node.order}"
            kind = node.extra[0]
            self.line(f"{self.sum_type(node)} v{node.order} = {self.start(kind, node.dtype)};")
            if kind in ("max", "min") and node.dtype == "real":
                self.line(f"{self.flag_type} n{node.order} = {self.no_flag};")
        self.flat = len(space) > 1 and is_flat(items, space)
        sizes = (math.prod(space),) if self.flat else space
        for search in [i for i in items if isinstance(i, Node) and i.op == "search"]:
            self.line(f"int32_t n{search.order} = 0;")
        if len(sizes) == 1:
            self.at_once(reductions, items)
        for k, n in enumerate(sizes):
            first, end = part or ("0", n)
            self.line(f"for (int32_t i{k} = {first}; i{k} < {end}; i{k}++) {{")
            self.depth += 1
        self.local = {}
        late: list[Store] = []
        self.inverse = {}
        divisors = Counter(i.args[1] for i in items if isinstance(i, Node) and _is_quotient(i))
        self.often = {n for n, count in divisors.items() if count >= _OFTEN}
        for item in items:
            if isinstance(item, Store):
                if item.buffer.kind == "state":
                    self.ref(item.node)
                    late.append(item)
                else:
                    self._store(item)
            elif item.op == "reduce":
                self.accumulate(item)
            else:
                self._compute(item, self.local)
        for node in [n for n in items if isinstance(n, Node) and n in self.plan.spills]:
            if not self.plan.spills[node].buffer.writers:
                self.line(f"{self._spilled(node)} = {self.local[node]};")
        for item in late:
            self._store(item)
        for _ in sizes:
            self.depth -= 1
            self.line("}")
        self.flat = False
        for node in reductions:
            if node.extra[0] in ("max", "min") and node.dtype == "real":
                self.settle(node)
        self.local, self.often = {}, set()
        self.place = ""

    flag_type, no_flag = "int", "0"
    """Of what remembers that there was a NaN."""

    def macro(self, item: Macro) -> None:
        """Write an operation that has loops of its own."""
        write_macro(self, item)

    def at_once(self, reductions: list[Node], items: list[Node | Store]) -> None:
        """Say that the turns of the next loop may be done together, where they may."""
        if not any(isinstance(i, Node) and i.op == "search" for i in items):
            self.line(f"FG_SIMD(omp simd{''.join(self._clause(n) for n in reductions)})")

    def sum_type(self, node: Node) -> str:
        """The type of what a loop sums up."""
        return "int" if node.dtype == "bool" else self.type_of(node)

    def start(self, kind: str, dtype: str) -> str:
        """What a sum, or the like, begins with."""
        if kind in ("sum", "any"):
            return "0"
        if kind in ("prod", "all"):
            return "1"
        if dtype == "real":
            return number(float("-inf" if kind == "max" else "inf"), dtype, self.write.real)
        low, high = {"int32": ("INT32_MIN", "INT32_MAX"), "int64": ("INT64_MIN", "INT64_MAX")}.get(
            dtype, ("0", f"{dtype.upper()}_MAX")
        )
        return low if kind == "max" else high

    def _clause(self, node: Node) -> str:
        kind, name = node.extra[0], f"v{node.order}"
        sign = {"sum": "+", "prod": "*", "max": "max", "min": "min", "any": "|", "all": "&"}[kind]
        more = f" reduction(|:n{node.order})" if kind in ("max", "min") and node.dtype == "real" else ""
        return f" reduction({sign}:{name}){more}"

    def settle(self, node: Node) -> None:
        """After the loop: the extreme of what holds a NaN is NaN."""
        self.line(f"if (n{node.order}) v{node.order} = NAN;")

    def accumulate(self, node: Node) -> None:
        """One turn of a sum, or the like."""
        kind, name, value = node.extra[0], f"v{node.order}", self.ref(node.args[0])
        if kind in ("sum", "prod"):
            sign = "+" if kind == "sum" else "*"
            if node.dtype in ("int32", "int64"):
                wide = f"uint{node.dtype[3:]}_t"
                self.line(f"{name} = ({node.dtype}_t)(({wide}){name} {sign} ({wide}){value});")
            else:
                self.line(f"{name} {sign}= {value};")
        elif kind in ("any", "all"):
            self.line(f"{name} {'|' if kind == 'any' else '&'}= {value};")
        else:
            sign = ">" if kind == "max" else "<"
            self.line(f"{name} = {value} {sign} {name} ? {value} : {name};")
            if node.dtype == "real":
                self.line(f"n{node.order} |= {value} != {value};")

    def _store(self, item: Store) -> None:
        buffer = self.plan.late.get(item.buffer, item.buffer)
        if buffer in self.in_block:
            where = f"{item.offset // item.space[0] * BLOCK} + i0 - block"
        else:
            where = self.index(item.offset, item.strides)
        self.line(f"{self.at(buffer, where)} = {self.stored(item)};")

    def _spilled(self, node: Node) -> str:
        buffer, offset, strides = self.plan.spills[node]
        return self.at(self.plan.late.get(buffer, buffer), self.index(offset, strides))

    def _copy(self, buffer: Buffer, stand_in: Buffer) -> None:
        """Carry over the places that were written."""
        for item in self.plan.items:
            if isinstance(item, Store) and item.buffer is buffer and item.space:
                for k, n in enumerate(item.space):
                    self.line(f"for (int32_t i{k} = 0; i{k} < {n}; i{k}++) {{")
                    self.depth += 1
                index = self.index(item.offset, item.strides)
                self.line(f"{self.at(buffer, index)} = {self.at(stand_in, index)};")
                for _ in item.space:
                    self.depth -= 1
                    self.line("}")

    # -- names ---------------------------------------------------------------------------------------

    def index(self, offset: int, strides: tuple[int, ...]) -> str:
        """An index in the loops at hand; where one loop stands for all, its steps are those of the last."""
        strides = strides[-1:] if self.flat else strides
        terms = [f"i{k}" if s == 1 else f"{s} * i{k}" for k, s in enumerate(strides) if s]
        if offset or not terms:
            terms = [str(offset), *terms] if offset >= 0 or not terms else [*terms, f"({offset})"]
        return " + ".join(terms)

    def type_of(self, node: Node) -> str:
        """The type of a node's variable."""
        return self.write.ctype(node.dtype)

    def stored(self, item: Store) -> str:
        """What a store writes, in the type of its buffer."""
        return self.ref(item.node)

    def ref(self, node: Node) -> str:
        """How a node is called here."""
        if node.op == "const":
            return number(node.extra[0], node.dtype, self.write.real)
        if node.op == "given":
            return str(node.extra)
        if not node.space:
            return self.uniform[node]
        if node not in self.local:
            if node.op in REPEATED:
                self.local[node] = f"v{node.order}"
                self.line(f"const {self.type_of(node)} v{node.order} = {self.expression(node)};")
            else:
                self.local[node] = self._spilled(node)
        return self.local[node]

    def expression(self, node: Node) -> str:
        """A node written out."""
        if node.op == "load":
            buffer, offset, strides = node.extra
            return self.at(buffer, self.index(offset, strides))
        if node.op == "turn":
            buffer, offset, strides = self.plan.spills[node.args[0]]
            return self.at(self.plan.late.get(buffer, buffer), str(offset + node.extra * strides[0]))
        if node.op == "iota":
            return f"(int64_t)i{node.extra}"
        if node.op == "gather":
            buffer, offset, strides, step, size = node.extra
            (at,) = node.args
            if at.dtype == "int32":
                clip = f"{self.write.helper('fg_clip_32')}({self.ref(at)}, {size})"
            else:
                clip = f"{self.write.helper('fg_clip')}((int64_t){self.ref(at)}, {size})"
            scaled = clip if step == 1 else f"{step} * {clip}"
            rest = self.index(offset, strides)
            return self.at(buffer, scaled if rest == "0" else f"{rest} + {scaled}")
        if node.op == "search":
            buffer, offset, size, side = node.extra
            kind = "r" if buffer.dtype == "real" else "b" if buffer.dtype == "bool" else buffer.dtype
            near = f", &n{node.order}" if node.space else ""
            name = self.write.helper(f"fg_search_{'near_' if near else ''}{kind}")
            whole = self.names(buffer) + (f" + {offset}" if offset else "")
            array = f"&{whole}" if buffer.bare else whole
            return f"{name}({array}, {size}, {self.ref(node.args[0])}, {int(side == 'right')}{near})"
        if _is_quotient(node) and node.args[1] in self.often:
            return self._times_inverse(*node.args)
        return self.write.write(node, [self.ref(a) for a in node.args])

    def _times_inverse(self, a: Node, b: Node) -> str:
        """A quotient by what is divided by often: one division takes as long as ten products."""
        if b not in self.inverse:
            one = number(1.0, b.dtype, self.write.real)
            divisor = self.ref(b)
            self.inverse[b] = f"u{b.order}"
            self.line(f"const {self.type_of(b)} u{b.order} = {one} / {divisor};")
        return f"{self.ref(a)} * {self.inverse[b]}"


def _is_quotient(node: Node) -> bool:
    return node.op == "divide" and node.dtype == "real" and node.args[1].space != ()


def _closed(text: str) -> bool:
    """Whether an expression is one word or one call."""
    if text.replace("_", "").isalnum():
        return True
    name, _, rest = text.partition("(")
    if not rest or not name.replace("_", "").isalnum():
        return False
    depth = 1
    for k, c in enumerate(rest):
        depth += (c == "(") - (c == ")")
        if depth == 0:
            return k == len(rest) - 1
    return False


def indices(sizes: tuple[int, ...]) -> Iterator[str]:
    """Names of loop counters."""
    return (f"i{k}" for k in range(len(sizes)))

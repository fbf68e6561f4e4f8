"""A scheduled tick of several runs as statements of C."""

from __future__ import annotations

from flowgraph.engines.c.lanes.expressions import LaneExpressions, no_lanes
from flowgraph.engines.c.lanes.macros import write_lane_macro
from flowgraph.engines.c.nodes import Macro, Node, Store
from flowgraph.engines.c.statements import Writer
from flowgraph.engines.c.syntax import ctype


class LaneWriter(Writer):
    """Writes one reaction of all lanes together."""

    write: LaneExpressions
    blocks = False
    flag_type, no_flag = "fg_mask", "fg_mask_of(0)"

    def macro(self, item: Macro) -> None:
        write_lane_macro(self, item)

    def at_once(self, reductions: list[Node], items: list[Node | Store]) -> None:
        """The vectors are made already."""

    def type_of(self, node: Node) -> str:
        return self.write.ctype(node.dtype) if self.write.varies(node) else ctype(node.dtype, "double")

    def sum_type(self, node: Node) -> str:
        return self.write.ctype(node.dtype)

    def start(self, kind: str, dtype: str) -> str:
        return self.write.splat(dtype, super().start(kind, dtype))

    def settle(self, node: Node) -> None:
        name = f"v{node.order}"
        nan = self.write.splat("real", "NAN")
        self.line(f"{name} = {self.write.pick('real', f'n{node.order}', nan, name)};")

    def accumulate(self, node: Node) -> None:
        kind, name, value = node.extra[0], f"v{node.order}", self.promoted(node.args[0])
        if kind in ("sum", "prod"):
            sign = "+" if kind == "sum" else "*"
            if node.dtype in ("int32", "int64"):
                wide = self.write.ctype(f"u{node.dtype}")
                self.line(f"{name} = ({self.type_of(node)})(({wide}){name} {sign} ({wide}){value});")
            else:
                self.line(f"{name} {sign}= {value};")
        elif kind in ("any", "all"):
            self.line(f"{name} {'|' if kind == 'any' else '&'}= {value};")
        else:
            wins = self.write.compared(node.dtype, f"{value} {'>' if kind == 'max' else '<'} {name}")
            self.line(f"{name} = {self.write.pick(node.dtype, wins, value, name)};")
            if node.dtype == "real":
                self.line(f"n{node.order} |= (fg_mask)({value} != {value});")

    def promoted(self, node: Node) -> str:
        """A node as a vector."""
        text = self.ref(node)
        return text if self.write.varies(node) else self.write.splat(node.dtype, text)

    def stored(self, item: Store) -> str:
        return self.promoted(item.node)

    def expression(self, node: Node) -> str:
        if node.op == "search":
            raise no_lanes("a search", node.origin)
        if node.op == "gather" and self.write.varies(node.args[0]):
            buffer, offset, strides, step, size = node.extra
            if buffer.dtype == "bool":
                raise no_lanes("a look-up of truths", node.origin)
            place = f"{'&' if buffer.bare else ''}{self.names(buffer)} + {self.index(offset, strides)}"
            (at,) = node.args
            return self.write.gathered(buffer, place, self.ref(at), at.dtype, step, size)
        if node.op in ("load", "iota", "gather") or not self.write.varies(node):
            return super().expression(node)
        return self.write.write(node, [self.promoted(a) for a in node.args])

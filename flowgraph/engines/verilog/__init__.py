"""Hardware: a pipeline in fixed point as a machine of its own, in Verilog.

Every operation becomes sums of a few terms (`nodes`), scheduled to a microword a cycle (`schedule`) for one
multiply-add-shift lane with block memory (`machine/*.v`). Its words are equal to the integer interpreter's.
"""

from flowgraph.engines.verilog.engine import ENGINE, VerilogEngine

__all__ = ["ENGINE", "VerilogEngine"]

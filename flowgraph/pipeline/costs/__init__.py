"""What a lowered graph costs: operations, memory, FIFOs, time and energy, counted on its instruction list."""

from __future__ import annotations

from flowgraph.pipeline.costs.report import CostReport, Costs, Section, cost_report
from flowgraph.pipeline.costs.timing import Machine

__all__ = ["CostReport", "Costs", "Machine", "Section", "cost_report"]

"""Studies: one filter or several over recordings, seeds and parameters, to a table that survives a crash."""

from flowgraph.study.execution import Outcome, Plan, Watcher, plan, run_study
from flowgraph.study.executors import Executor, Finished, InProcess, OnDask, ProcessPool
from flowgraph.study.spec import Study
from flowgraph.study.store import Store, read_table, read_trajectory

__all__ = [
    "Executor",
    "Finished",
    "InProcess",
    "OnDask",
    "Outcome",
    "Plan",
    "ProcessPool",
    "Store",
    "Study",
    "Watcher",
    "plan",
    "read_table",
    "read_trajectory",
    "run_study",
]

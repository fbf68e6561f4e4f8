"""Studies: one filter or several over recordings, seeds and parameters, to a table that survives a crash.

One run says little of a filter that is fed noise. A study says which graphs run on which flights, with which
seeds and parameters (`spec`). It is planned as single runs, each known by a digest of all that its result
depends on (`keys`), so that what is there already is not run again (`execution`). Runs go out to workers
(`executors`), which play those of one filter together where the engine can (`tasks`, `lifting`), and each
result is on disk, whole, before the next is asked for (`store`).

What came out is summed up and compared (`statistics`), shown while it grows (`progress`), and made a page
with pictures (`report`). To fit noise parameters to recordings is a search whose points are runs (`tune`,
`trials`).
"""

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

"""One drawn graph against its meaning, and engines against each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from flowgraph import FifoOverflowError, Result, simulate
from tests.oracle.build import built, inputs_of
from tests.oracle.meaning import Meaning
from tests.oracle.specs import MS, Spec
from tests.support import same

OURS = ("python", "reference")


def fault(spec: Spec, engines: Sequence[str] = ()) -> str | None:
    """What is wrong with a graph's results; None where python, reference, the meaning and `engines` agree."""
    meaning = Meaning(spec)
    graph, inputs = built(spec), inputs_of(spec)
    results: list[Result] = []
    for engine in (*OURS, *engines):
        try:
            results.append(simulate(graph, inputs, engine=engine))
        except FifoOverflowError as error:
            if meaning.full is None or error.time != meaning.full * MS:
                return f"{engine}: full at {error.time} ns, and by its meaning at {meaning.full} ms"
            continue
        if meaning.full is not None:
            return f"{engine}: never full, and by its meaning at {meaning.full} ms"
    if meaning.full is not None:
        return None
    wrong = _apart(results[0], meaning)
    if wrong is not None:
        return wrong
    for engine, result in zip((*OURS, *engines)[1:], results[1:], strict=True):
        try:
            same(results[0], result, exact=engine == "reference")
        except AssertionError as error:
            return f"python and {engine}: {str(error)[:300]}"
    return None


def _apart(result: Result, meaning: Meaning) -> str | None:
    for k, events in enumerate(meaning.streams):
        found = result[f"n{k}"]
        time, value = [t * MS for t, _ in events], np.array([v for _, v in events], float)
        if found.time.tolist() != time:
            return f"n{k}: present at {found.time // MS} ms, by its meaning at {[t for t, _ in events]}"
        if not (np.abs(found.value - value) <= 1e-9 * np.maximum(1.0, np.abs(value))).all():
            return f"n{k}: {found.value.tolist()}, by its meaning {value.tolist()}"
    counts: Counter[str] = Counter()
    for name, n in result.stats.items():
        counts[name.rpartition(".")[2]] += n
    if +counts != +meaning.counts:
        return f"counted {dict(+counts)}, by its meaning {dict(+meaning.counts)}"
    return None

"""`python -m tests.oracle --count N --seed S [--engine c] [--json]`: random graphs against their meaning."""

from __future__ import annotations

import argparse
import json
import sys
from time import perf_counter

from tests.oracle.check import fault
from tests.oracle.specs import drawn


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.oracle", description=__doc__)
    parser.add_argument("--count", type=int, default=100, help="how many graphs")
    parser.add_argument("--seed", type=int, default=0, help="of the first; the next has the next")
    parser.add_argument("--engine", action="append", default=[], help="beside python and reference")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    begin, failed = perf_counter(), {}
    for seed in range(given.seed, given.seed + given.count):
        try:
            wrong = fault(drawn(seed), given.engine)
        except Exception as error:  # a legal graph that is refused is a failure as any other
            wrong = f"{type(error).__name__}: {error}"
        if wrong is not None:
            failed[seed] = wrong
    seconds = perf_counter() - begin
    report = {
        "count": given.count,
        "failed": len(failed),
        "seeds": list(failed),
        "engines": ["python", "reference", *given.engine],
        "graphs_per_s": round(given.count / seconds, 2),
    }
    if given.json:
        print(json.dumps(report))
    else:
        print(", ".join(f"{k}: {v}" for k, v in report.items()))
    for seed, wrong in failed.items():
        print(f"seed {seed}: {wrong}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

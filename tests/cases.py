"""`python -m tests.cases FOLDER`: runs a folder of field cases and prints a line each.

A case is a folder with a small input and a `run.sh` or `run.py` that shows what is done with it. Each is run
in a scratch copy, with FLOWGRAPH and PYTHON naming this environment, and nothing is written into FOLDER. The
verdict on what came is looked up by the case's name in `tests.case_expectations`; of a name that is not
there, only what came is printed.

    right     what came is what is right
    WRONG     it is not
    LATE      the time limit has passed
    -         no expectation known
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

from tests.case_expectations import EXPECTATIONS, Expectation

SCRIPTS = ("run.sh", "run.py")

_LABELS = {  # of the figures that a table of runs prints under a name of its own: their names, and the unit
    "position RMSE [mm]": ("position_rmse_m", 1e-3),
    "attitude [deg]": ("attitude_rmse_deg", 1.0),
    "tilt [deg]": ("tilt_rmse_deg", 1.0),
    "heading [deg]": ("heading_rmse_deg", 1.0),
    "position in 3 sigma": ("position_3sigma", 1e-2),
    "tilt in 3 sigma": ("tilt_3sigma", 1e-2),
    "time [s]": ("wall_s", 1.0),
    "set-up [s]": ("setup_s", 1.0),
}
_ROW = re.compile(r"^(\S.*?)\s{2,}(-?(?:\d[\d.]*(?:[eE][-+]?\d+)?|nan|inf))(?: %)?\s*$")
_SHOWN = ("position_rmse_m", "attitude_rmse_deg", "total_rmse_deg", "position_nis_mean", "nis_mean")
_ERROR = re.compile(r"^(?:error: |(?:flowgraph|tests)[\w.]*(?:Error|Exception): )(.*(?:\n {2,}\S.*)*)", re.M)
_PYTHON_ERROR = re.compile(r"^([A-Za-z_][\w.]*(?:Error|Exception|Interrupt|Exit))(?:: .*)?$", re.M)


@dataclass
class Outcome:
    """What came of a case.

    Args:
        status: the exit status of its script; None where the time limit has passed.
        stdout: what it printed.
        stderr: what it said beside.
        seconds: how long it took.
        runs: the figures of each run of a graph that it printed, as a table or as JSON; the graph's name is
            under "graph".
        probed: what the expectation's probe printed.
    """

    status: int | None
    stdout: str
    stderr: str
    seconds: float
    runs: list[dict[str, Any]] = field(default_factory=list)
    probed: str = ""

    @property
    def text(self) -> str:
        return f"{self.stdout}\n{self.stderr}"

    @property
    def errors(self) -> list[str]:
        """Each error of the package that was said, with what was expected, what came and the remedy."""
        return [match[1] for match in _ERROR.finditer(self.text)]

    @property
    def crash(self) -> str | None:
        """The last line of a traceback of an error that is not the package's."""
        if "Traceback (most recent call last)" not in self.stderr:
            return None
        found = [m[0] for m in _PYTHON_ERROR.finditer(self.stderr) if not m[1].startswith("flowgraph.")]
        return found[-1] if found else None


def run_case(folder: Path, *, limit: float = 300.0, expectation: Expectation | None = None) -> Outcome:
    """Run the script of a case in a scratch copy of its folder.

    Args:
        folder: the case.
        limit: s after which the script and all that it has started are killed.
        expectation: whose probe, if it has one, runs after a `run.py` in the same process.
    """
    with tempfile.TemporaryDirectory(prefix="case-", ignore_cleanup_errors=True) as scratch:
        copy = Path(scratch) / "case" / folder.name
        shutil.copytree(folder, copy)
        (Path(scratch) / "tmp").mkdir()
        script = next(copy / name for name in SCRIPTS if (copy / name).is_file())
        probe = expectation.probe if expectation else ""
        mark = "== probe =="
        if script.suffix == ".sh":
            command = ["sh", str(script)]
        elif probe:
            first = f"import runpy\ncame = runpy.run_path({str(script)!r}, run_name='__main__')\n"
            command = [sys.executable, "-c", f"{first}print({mark!r})\n{probe}"]
        else:
            command = [sys.executable, str(script)]
        environment = {
            **os.environ,
            "FLOWGRAPH": str(Path(sys.executable).with_name("flowgraph")),
            "PYTHON": sys.executable,
            "TMPDIR": str(Path(scratch) / "tmp"),
        }
        start = perf_counter()
        with (
            open(Path(scratch) / "stdout", "wb") as out,
            open(Path(scratch) / "stderr", "wb") as err,
            subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                env=environment,
                cwd=copy,
                start_new_session=True,
            ) as process,
        ):
            status: int | None = None
            try:
                status = process.wait(limit)
            except subprocess.TimeoutExpired:
                pass
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)  # what the script left behind, too
        seconds = perf_counter() - start
        stdout, stderr = (
            Path(scratch, n).read_text("utf-8", errors="replace").replace(str(copy), folder.name)
            for n in ("stdout", "stderr")
        )
    stdout, _, probed = stdout.partition(mark + "\n")
    return Outcome(status, stdout, stderr, seconds, list(figures(stdout)), probed)


def figures(text: str) -> Iterator[dict[str, Any]]:
    """The figures of each run in what was printed: objects of JSON, and tables that begin with `ticks`."""
    lines = text.splitlines()
    k = 0
    while k < len(lines):
        if lines[k].startswith("{"):
            try:
                found, end = json.JSONDecoder().raw_decode("\n".join(lines[k:]))
            except ValueError:
                k += 1
                continue
            k += "\n".join(lines[k:])[:end].count("\n") + 1
            yield from found.get("rows", [found])
            continue
        row = _ROW.match(lines[k])
        if row and row[1] == "ticks":
            run: dict[str, Any] = {"graph": lines[k - 2].strip() if k > 1 else ""}
            while row:
                name, unit = _LABELS.get(row[1], (row[1], 1.0))
                run[name] = float(row[2]) * unit
                k += 1
                row = _ROW.match(lines[k]) if k < len(lines) else None
                if row and row[1] == "ticks":
                    break
            yield run
            continue
        k += 1


def verdict(outcome: Outcome, expectation: Expectation | None) -> str:
    if outcome.status is None:
        return "LATE"
    if expectation is None:
        return "-"
    return "right" if expectation.check(outcome) else "WRONG"


def summary(outcome: Outcome) -> str:
    """The figures of what came, or the first line of the error."""
    if outcome.crash is not None:
        return f"crash: {outcome.crash}"
    parts = [
        " ".join([str(run.get("graph", "")), *(f"{n}={run[n]:.4g}" for n in _SHOWN if n in run)]).strip()
        for run in outcome.runs
    ]
    parts += [f"error: {error.splitlines()[0]}" for error in dict.fromkeys(outcome.errors)]
    if not parts:
        parts = [
            line for line in (outcome.probed or outcome.stdout or outcome.stderr).splitlines() if line.strip()
        ][-1:]
    return "; ".join(parts) or "nothing was printed"


def cases(folder: Path, only: Sequence[str] | None = None) -> list[Path]:
    """The cases in a folder, by name.

    Raises:
        SystemExit: when there are none, or one of `only` is not there.
    """
    found = {}
    if folder.is_dir():
        found = {
            f.name: f for f in sorted(folder.iterdir()) if any((f / script).is_file() for script in SCRIPTS)
        }
    if not found:
        raise SystemExit(f"{folder}: no folder in it has a {' or a '.join(SCRIPTS)}")
    missing = [name for name in only or () if name not in found]
    if missing:
        raise SystemExit(f"{folder}: no case is called {', '.join(missing)}; there are {', '.join(found)}")
    return [found[name] for name in (only or found)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases; the status is 1 when one is wrong or late."""
    parser = argparse.ArgumentParser(prog="python -m tests.cases", description=__doc__.split("\n", 1)[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="holds a folder a case")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="the cases to run")
    parser.add_argument("--limit", type=float, default=300.0, metavar="SECONDS", help="for each case")
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object, with all that was printed"
    )
    given = parser.parse_args(arguments)
    rows = []
    chosen = cases(given.folder, given.only)
    width = max(len(case.name) for case in chosen)
    for case in chosen:
        expectation = EXPECTATIONS.get(case.name)
        outcome = run_case(case, limit=given.limit, expectation=expectation)
        row = {
            "case": case.name,
            "verdict": verdict(outcome, expectation),
            "right": expectation.right if expectation else "no expectation known",
            "summary": summary(outcome),
            "exit": outcome.status,
            "wall_s": outcome.seconds,
            "runs": outcome.runs,
            "errors": outcome.errors,
            "stdout": outcome.stdout + outcome.probed,
            "stderr": outcome.stderr,
        }
        rows.append(row)
        if not given.json:
            line = f"{row['verdict']:6}{case.name:{width}}  exit {row['exit']}  {row['summary']}"
            line = "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)
            print(line if expectation else f"{line} (no expectation known)", flush=True)
    counts = {v: sum(row["verdict"] == v for row in rows) for v in ("right", "WRONG", "LATE", "-")}
    if given.json:
        print(json.dumps({"rows": rows, "counts": counts}, indent=1))
    else:
        print(", ".join(f"{n} {v if v != '-' else 'without an expectation'}" for v, n in counts.items() if n))
    return 1 if counts["WRONG"] or counts["LATE"] else 0


if __name__ == "__main__":
    raise SystemExit(main())

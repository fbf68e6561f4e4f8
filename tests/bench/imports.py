"""How long `import flowgraph` takes in a fresh process, beside NumPy's import and a bare Python."""

from __future__ import annotations

import subprocess
import sys
from statistics import median

from tests.bench.rows import Row, interleaved, seconds

LIMIT_S = 0.4


def import_seconds(module: str) -> float:
    """Seconds that `import module` takes in a process of its own, without the start of Python."""
    clock = "from time import perf_counter as now; start = now()"
    return float(_python("-c", f"{clock}; import {module}; print(now() - start)").stdout)


def heaviest(module: str, count: int) -> list[dict[str, object]]:
    """The modules whose own code takes longest when `module` is imported."""
    found = []
    for line in _python("-X", "importtime", "-c", f"import {module}").stderr.splitlines():
        parts = line.removeprefix("import time:").split("|")
        if len(parts) == 3 and parts[0].strip().isdigit():
            own, total, name = (part.strip() for part in parts)
            found.append({"module": name, "own_ms": int(own) / 1e3, "total_ms": int(total) / 1e3})
    return sorted(found, key=lambda m: -float(str(m["own_ms"])))[:count]


def import_time(*, repeats: int = 9) -> list[Row]:
    """Import of flowgraph against that of NumPy alone, which it needs."""
    ours, peer, ratio = interleaved(
        lambda: import_seconds("flowgraph"), lambda: import_seconds("numpy"), repeats
    )
    bare = median(seconds(lambda: _python("-c", "pass")) for _ in range(repeats))
    return [
        Row(
            "import flowgraph",
            ours,
            peer,
            "s",
            f"import numpy (bare Python process: {bare:.3f} s)",
            ratio,
            f"ours < {LIMIT_S} s",
            ours < LIMIT_S,
            {"bare_process_s": bare, "heaviest_modules": heaviest("flowgraph", 15)},
        )
    ]


def _python(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=True)

"""What the tests' workers are told to do; in a module of its own, so that they can import it."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path


def double(x: int) -> int:
    return 2 * x


def fail(x: int) -> int:
    raise ValueError(f"no {x}")


def die(x: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return x


def die_once(file: str, x: int) -> int:
    """Kills its worker the first time only."""
    if not Path(file).exists():
        Path(file).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return x


def slow(x: int) -> int:
    time.sleep(0.05)
    return x

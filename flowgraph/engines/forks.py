"""Processes that were forked after JAX had been used.

JAX computes in threads of its own. A forked process has its memory and not its threads, so whatever it gives
JAX to do waits for ever. Each fork is looked at from the start, whoever used JAX before it.
"""

from __future__ import annotations

import os
import sys

from flowgraph.errors import DeclarationError

_lost = False  # whether the threads of JAX are in another process


def _after_fork() -> None:
    global _lost
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is not None:
        _lost = _lost or bool(getattr(bridge, "_backends", True))  # made when JAX is first used


if hasattr(os, "register_at_fork"):  # where processes can fork
    os.register_at_fork(after_in_child=_after_fork)


def refuse_lost_threads() -> None:
    """Refuse to use JAX where it would wait for threads that were left in another process.

    Raises:
        DeclarationError: saying how processes are started instead.
    """
    if _lost:
        raise DeclarationError(
            "this process was forked after JAX had been used, and JAX would wait for ever",
            path='engine="xla"',
            expected="a process that was started anew, or forked before JAX was used",
            got=f"process {os.getpid()}, forked from one that has the threads of JAX",
            fix='start processes with multiprocessing.get_context("spawn"), or use engine="c" in them',
        )

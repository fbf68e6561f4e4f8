"""Processes that were forked after JAX had been used: XLA is refused there, at once, with the remedy."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

pytest.importorskip("jax")

PROGRAM = """
import json, multiprocessing, sys, warnings
warnings.simplefilter("ignore")
import numpy as np
from flowgraph import FlowgraphError, Scalar, Stream, graph, simulate, simulate_many

@graph
def g(x: Stream[Scalar]):
    return x.map(lambda v: 3.0 * v)

built, data = g.build(), {"x": (np.arange(3), np.arange(3.0))}

def play(engine="xla", many=False):
    try:
        if many:
            return sorted(simulate_many(built, data, [0, 1], engine=engine).series)
        return simulate(built, data, engine=engine).output.value.tolist()
    except FlowgraphError as error:
        return str(error)

def answer(pipe, *words):
    pipe.send(play(*words))

def child(*words, method="fork"):
    context = multiprocessing.get_context(method)
    mine, yours = context.Pipe()
    process = context.Process(target=answer, args=(yours, *words))
    process.start()
    found = mine.recv() if mine.poll(120) else "hangs"
    process.kill()
    process.join()
    return found

def grandchild(pipe):
    pipe.send(child())

def forked_twice():
    context = multiprocessing.get_context("fork")
    mine, yours = context.Pipe()
    process = context.Process(target=grandchild, args=(yours,))
    process.start()
    found = mine.recv() if mine.poll(120) else "hangs"
    process.kill()
    process.join()
    return found

if __name__ == "__main__":
    print(json.dumps(BODY))
"""


def said(body: str, tmp_path) -> list:
    file = tmp_path / "program.py"
    file.write_text(PROGRAM.replace("BODY", body))
    done = subprocess.run([sys.executable, file], capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot fork here")
FINE = [0.0, 3.0, 6.0]


@needs_fork
@pytest.mark.parametrize(
    "use", ["play()", "play('xla', True)", "__import__('jax').numpy.zeros(3).sum().item()"]
)
def test_after_jax_was_used_xla_is_refused_and_the_others_work(tmp_path, use):
    """Whoever used it: a run, many runs, or the user's own program."""
    body = f"[{use}, child(), child('xla', True), child('c'), child('python'), forked_twice(), play()]"
    _, xla, many, c, python, twice, own = said(body, tmp_path)
    for text in (xla, many, twice):
        assert text.startswith('engine="xla": this process was forked after JAX had been used')
        assert 'multiprocessing.get_context("spawn")' in text
        assert 'engine="c"' in text
    assert c == python == own == FINE, "and the process that was forked goes on"


@needs_fork
def test_before_jax_was_used_a_fork_may_use_it(tmp_path):
    assert said("[child(), __import__('jax') and None, child(), play()]", tmp_path) == [
        FINE,
        None,
        FINE,
        FINE,
    ]


def test_a_process_that_is_started_anew_may_use_it(tmp_path):
    assert said("[play(), child(method='spawn')]", tmp_path) == [FINE, FINE]

"""The same bootstrap filter here and in `particles` (N. Chopin): one model, as many particles, one record.

`particles` 0.4 asks for NumPy < 2, though it runs with newer ones. So it has an environment of its own:

    python -m venv .venv-particles
    .venv-particles/bin/pip install particles

or any other whose interpreter `FLOWGRAPH_PARTICLES` names. The two take turns; each times itself.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Array, Graph, Series, Signal, Stream, graph, real, simulate
from flowgraph.blocks.filtering import DiscreteModel, LinearMeasurement, filtered, particles
from flowgraph.blocks.signals import Gaussian
from tests.bench.rows import Row, interleaved, missing, worked

HERE = Path(__file__).resolve()
PYTHON = HERE.parents[2] / ".venv-particles" / "bin" / "python"
STEP_S, STEP_NS = 0.005, 5_000_000
JERK, SEEN, START_SPREAD = 1.0, 0.05, 0.05
SIZES = (100, 1000)


class Place(Signal):
    position: Array = real(3)


def plain_model(steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """F (9, 9), Q (9, 9), H (3, 9), true states (steps, 9) and measured positions (steps, 3); by axis."""
    h = STEP_S
    F = np.kron(np.eye(3), [[1.0, h, h * h / 2], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
    Q = np.kron(
        np.eye(3),
        np.array([[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2], [h**3 / 6, h**2 / 2, h]]),
    )
    Q *= JERK**2
    H = np.kron(np.eye(3), [[1.0, 0.0, 0.0]])
    generator = np.random.default_rng(0)
    factor = np.linalg.cholesky(Q)
    x, states = np.zeros(9), []
    for _ in range(steps):
        x = F @ x + factor @ generator.normal(size=9)
        states.append(x)
    truth = np.stack(states)
    return F, Q, H, truth, truth @ H.T + SEEN * generator.normal(size=(steps, 3))


def ours(n: int, steps: int) -> tuple[Graph, dict[str, Series]]:
    """Our filter of the plain model, and its record."""
    F, Q, H, _, seen = plain_model(steps)
    motion = DiscreteModel(F, Q)
    place = LinearMeasurement(motion.space, H, noise=SEEN**2)
    start = Gaussian(mean=np.zeros(9), covariance=START_SPREAD**2 * np.eye(9))

    @graph
    def bootstrap(z: Stream[Place]):
        return filtered(motion, {place: z}, start=start, method=particles(n))

    return bootstrap.build(), {"z": Series(np.arange(steps) * STEP_NS, Place(position=seen))}


@contextmanager
def peer(n: int, steps: int) -> Iterator[Any]:
    """A call that filters once in `particles`: processor time, and the estimate (9) after the last step.

    Raises:
        ImportError: where no interpreter has it.
    """
    python = Path(os.environ.get("FLOWGRAPH_PARTICLES") or PYTHON)
    if not python.exists():
        raise ImportError(f"python -m venv {PYTHON.parents[1].name}, and its pip install particles")
    F, Q, H, _, seen = plain_model(steps)
    covariances = {"covX": Q, "covY": SEEN**2 * np.eye(3), "cov0": START_SPREAD**2 * np.eye(9)}
    model = {name: a.tolist() for name, a in {"F": F, "G": H, "seen": seen, **covariances}.items()}
    command = [str(python), str(HERE.parent / "floor" / "bootstrap.py")]
    pipe = subprocess.PIPE
    one = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # threads that wait would count
    with subprocess.Popen(command, env=one, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        say, hear = process.stdin, process.stdout

        def asked(line: str) -> dict[str, Any]:
            try:
                print(line, file=say, flush=True)
                answer = hear.readline()
            except BrokenPipeError:
                answer = ""
            if not answer:
                raise ImportError(f"{python} has no particles that works")
            found: dict[str, Any] = json.loads(answer)
            return found

        asked(json.dumps({**model, "particles": n}))
        try:
            yield lambda: asked("go")
        finally:
            say.close()


def rows(*, sizes: tuple[int, ...] = SIZES, steps: int = 100, repeats: int = 5) -> list[Row]:
    """Milliseconds of work a step of our Python engine, and of theirs."""
    made = []
    for n in sizes:
        built, record = ours(n, steps)
        truth = plain_model(steps)[3][-1]
        found = simulate(built, record).output.mean[-1]
        assert np.abs(found - truth)[::3].max() < 10.0 * SEEN
        scale = 1e3 / steps
        mine = lambda built=built, record=record, scale=scale: (  # type: ignore[misc]
            worked(lambda: simulate(built, record)) * scale
        )
        name, against = f"bootstrap filter of 9 states, {n:,} particles, python", "particles"
        try:
            with peer(n, steps) as run:
                assert np.abs(np.array(run()["mean"]) - truth)[::3].max() < 10.0 * SEEN
                theirs = lambda run=run, scale=scale: run()["seconds"] * scale  # type: ignore[misc]
                a, b, ratio = interleaved(mine, theirs, repeats)
        except ImportError as error:
            made.append(missing(name, mine(), "ms/step", against, error))
        else:
            made.append(Row(name, a, b, "ms/step", against, ratio, "ratio <= 1", ratio <= 1.0))
    return made

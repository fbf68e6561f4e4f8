"""Every method on every problem: how good it is, how honest, what it costs, and whether a peer agrees.

The truth of each problem is drawn from its own model, so that an exact filter has a NEES of the dimension of
its state, and the log-likelihood compares the methods: the higher, the better the measurements were foretold.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph import Report, UnknownNameError, simulate
from flowgraph.blocks.filtering import (
    cubature,
    ensemble,
    extended,
    information,
    linear,
    particles,
    rao_blackwellized,
    square_root,
    unscented,
)
from flowgraph.graphs.benches.model_peers import PEERS, volatility_log_likelihood
from flowgraph.graphs.benches.model_problems import PROBLEMS, Drawn, Problem, declared, drawn
from flowgraph.language.checks import need_count

__all__ = ["METHODS", "models"]

METHODS: dict[str, Callable[[int], Any]] = {
    "linear": lambda n: linear(),
    "extended": lambda n: extended(),
    "iterated": lambda n: extended(iterations=3),
    "square_root": lambda n: square_root(),
    "information": lambda n: information(),
    "unscented": lambda n: unscented(),
    "cubature": lambda n: cubature(),
    "ensemble": lambda n: ensemble(n),
    "bootstrap": lambda n: particles(n),
    "guided": lambda n: particles(n, proposal="guided"),
    "auxiliary": lambda n: particles(n, proposal="auxiliary"),
    "rao_blackwellized": lambda n: rao_blackwellized(max(n // 10, 2), linear="velocity"),
}
"""By name, given the number of particles; at a Gaussian each there are a tenth of them."""

SAMPLED = ("ensemble", "bootstrap", "guided", "auxiliary", "rao_blackwellized")
"""Those that draw."""

ONLY = {"linear": ("point",), "rao_blackwellized": ("point", "radar", "ranges", "turn")}
"""Methods that need a model with linear parts, and the problems whose model has them."""


def models(
    *,
    problem: str = "all",
    method: str = "all",
    runs: int = 5,
    particles: int = 1000,
    engine: str = "c",
    seed: int = 0,
) -> Report:
    """Filters of a model by every method, beside peers: from a point to a pose and a stochastic volatility.

    Args:
        problem: point, radar, ranges, turn, bicycle, pendulum, pose, volatility, or all.
        method: linear, extended, iterated, square_root, information, unscented, cubature, ensemble,
            bootstrap, guided, auxiliary, rao_blackwellized, or all.
        runs: drawn from the model, over which errors are averaged.
        particles: how many; so many members has an ensemble.
        engine: that runs the filters.
        seed: of the first run; the next has the next.

    Returns:
        A row a problem and method: `problem`, `filter`, `rmse` (of the numbers of the tangent space
        together), `nees_mean` (right: `dimension`), `dimension`, `log_likelihood` (of a run), `peer` (all
        that have the method), `peer_difference` (the largest of means, relative to max(1, |x|), and
        covariances, relative to the deviations; None without a peer), `peer_error`, and `c_us`, the time a
        tick of the engine's loop (of `engine`, "c" if left out). Of a method that draws, `peer` is an exact
        filter where there is one, "linear" or a "grid", `peer_difference` the mean difference of the
        log-likelihood and `peer_error` its standard error.

    Raises:
        UnknownNameError: for a problem or method that is not there; DeclarationError: for a number out of
            range.
    """
    for name, value, known in (("problem", problem, PROBLEMS), ("method", method, METHODS)):
        if value != "all" and value not in known:
            raise UnknownNameError(name, value, ["all", *known], path=f"models.{name}")
    need_count("models", "runs", runs, least=1)
    need_count("models", "particles", particles, least=1)
    rows = []
    for which in PROBLEMS if problem == "all" else (problem,):
        made = PROBLEMS[which]()
        some = [drawn(made, seed + k) for k in range(runs)]
        declaration = declared(made)
        for name in METHODS if method == "all" else (method,):
            if which not in ONLY.get(name, PROBLEMS):
                continue
            rows.append(_row(which, name, made, declaration, some, particles, engine, seed))
    notes = [f"{runs} runs a row, drawn from the model; {particles} particles"]
    asked = {"jax", *(peer for peers in PEERS.values() for peer, _ in peers)}
    missing = sorted(peer for peer in asked if importlib.util.find_spec(peer) is None)
    notes += [f"without {name}, which is not installed (extra bench)" for name in missing]
    return Report(rows, {}, tuple(notes))


def _row(
    which: str,
    name: str,
    made: Problem,
    declaration: Any,
    some: list[Drawn],
    count: int,
    engine: str,
    seed: int,
) -> dict[str, Any]:
    built = declaration.build(method=METHODS[name](count), sizes=_sizes(some[0]))
    space, squares, nees, likely, seconds, ticks = made.motion.space, [], [], [], 0.0, 0
    beliefs = []
    for k, run in enumerate(some):
        result = simulate(built, run.inputs, engine=engine, seed=seed + k)
        belief = result["output"]
        apart = np.asarray(space.minus(run.truth, belief["mean"], np))
        squares.append(np.mean(np.sum(apart**2, axis=-1)))
        solved = np.linalg.solve(belief["covariance"], apart[..., None])[..., 0]
        nees.append(np.mean(np.sum(apart * solved, axis=-1)))
        likely.append(float(result["log_likelihood"]["value"].sum()))
        seconds, ticks = seconds + result.wall_s, ticks + result.ticks
        beliefs.append(belief)
    if name in SAMPLED:
        peer, difference, error = _exact(which, made, some, likely, declaration, engine)
    else:
        peer, difference, error = *_peers(which, name, made, some[0], beliefs[0]), None
    return {
        "problem": which,
        "filter": name,
        "rmse": float(np.sqrt(np.mean(squares))),
        "nees_mean": float(np.mean(nees)),
        "dimension": space.tangent,
        "log_likelihood": float(np.mean(likely)),
        "peer": peer,
        "peer_difference": difference,
        "peer_error": error,
        "c_us": 1e6 * seconds / ticks,
    }


def _sizes(run: Drawn) -> dict[str, int]:
    return {"m": run.inputs["z"]["value"].shape[-1]}


def _exact(
    which: str, made: Problem, some: list[Drawn], likely: list[float], declaration: Any, engine: str
) -> tuple[str | None, float | None, float | None]:
    """How far the log-likelihoods are from the exact ones: the mean over the runs, and its standard error."""
    if made.linear:
        peer, kalman = "linear", declaration.build(method=linear(), sizes=_sizes(some[0]))
        found = [simulate(kalman, run.inputs, engine=engine)["log_likelihood"]["value"].sum() for run in some]
    elif which == "volatility":
        peer, found = "grid", [volatility_log_likelihood(made, run) for run in some]
    else:
        return None, None, None
    off = np.array(likely) - np.array(found)
    return peer, float(off.mean()), float(off.std(ddof=1) / np.sqrt(len(off))) if len(off) > 1 else None


def _peers(which: str, name: str, made: Problem, run: Drawn, belief: Any) -> tuple[str | None, float | None]:
    """Who has the same method, and how far the farthest is from ours on the first run."""
    there = [
        (peer, theirs)
        for peer, theirs in PEERS.get((which, name), ())
        if importlib.util.find_spec(peer) and importlib.util.find_spec("jax")
    ]
    if not there:
        return None, None
    farthest, space = 0.0, made.motion.space
    for _, theirs in there:
        mean, covariance = theirs(made, run)
        off = np.abs(space.minus(belief["mean"], mean, np))
        off = off / np.maximum(1.0, np.abs(mean).max(axis=-1, keepdims=True))
        deviation = np.sqrt(np.einsum("nii->ni", covariance))
        wide = np.abs(belief["covariance"] - covariance) / (deviation[:, :, None] * deviation[:, None, :])
        farthest = max(farthest, float(off.max()), float(wide.max()))
    return ", ".join(peer for peer, _ in there), farthest

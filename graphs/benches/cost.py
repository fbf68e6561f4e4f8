"""What particles buy and what they cost: accuracy, memory, operations and energy of `rbpf_indoor`.

R. Fiszel's thesis lowers its particle filter by hand and gives no figure of what it takes (2017, ch. 6). Here
each size is run on the same simulated flights and counted on its instruction list.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import find_graph, load_flight, lower, simulate
from flowgraph.data.registry import Report
from flowgraph.graphs.benches import lists
from flowgraph.language.checks import need_count
from flowgraph.pipeline.costs import Costs, Machine


def cost(
    *,
    particles: str = "10,100,1000",
    flights: int = 5,
    duration: float = 30.0,
    engine: str = "xla",
    multipliers: int = 16,
    lanes: int = 1,
    seed: int = 0,
) -> Report:
    """Accuracy of `rbpf_indoor` against memory, operations and energy, by number of particles.

    Args:
        particles: numbers, with commas between.
        flights: how many simulated flights, with one seed each.
        duration: of a flight, s.
        engine: that runs them.
        multipliers, lanes: of the machine, for the initiation interval; more lanes than particles are idle.
        seed: of the first flight.

    Raises:
        DeclarationError: for a list that holds no numbers of particles, or no flight.
    """
    need_count("cost", "flights", flights, least=1)
    rows = [
        _row(n, flights, duration, engine, Machine(multipliers, min(lanes, n)), seed)
        for n in lists.numbers(particles, "cost.particles")
    ]
    return Report(
        rows,
        notes=(
            f"Medians over {flights} simulated flights of {duration:g} s with an unknown heading; "
            "operations, cycles and energy are of a tick with an IMU reading and a pose, reals of 32 bits.",
            "Memory is what is kept between ticks, constants, and buffers within a tick.",
            f"Cycles: {multipliers} multipliers a lane, {lanes} lane{'s' * (lanes > 1)}. Energy: 45 nm at "
            "0.9 V, arithmetic and memories alone (Horowitz, ISSCC 2014).",
        ),
    )


def _row(
    particles: int, flights: int, duration: float, engine: str, machine: Machine, seed: int
) -> dict[str, Any]:
    scores = []
    for n in range(seed, seed + flights):
        flight = load_flight("sim", seed=n, settings={"duration": str(duration)})
        case = find_graph("rbpf_indoor").case(flight, particles=particles, seed=n)
        scores.append(case.score(simulate(case.graph, case.inputs, engine=engine, seed=n)))
    pipeline = lower(case.graph)
    costs = Costs(pipeline, 2 ** len(pipeline.inputs) - 1, machine=machine)
    count = costs.operations
    return {
        "particles": particles,
        "position_mm": round(1e3 * _median(scores, "position_rmse_m"), 1),
        "tilt_deg": round(_median(scores, "tilt_rmse_deg"), 2),
        "heading_deg": round(_median(scores, "heading_rmse_deg"), 2),
        "kept_kbit": round(sum(s.bits for s in costs.stores if s.use not in _SCRATCH) / 1e3, 1),
        "memory_kbit": round(costs.bits / 1e3, 1),
        "products": count["multiply"] + count["integer multiply"],
        "operations": sum(count.values()),
        "cycles": costs.interval.cycles,
        "energy_uJ": round(costs.energy_pj / 1e6, 3),
    }


_SCRATCH = ("constant", "within a tick")


def _median(scores: list[dict[str, float]], name: str) -> float:
    return float(np.median([s[name] for s in scores]))

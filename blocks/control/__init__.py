"""Control: plants that move as they are told, controllers that tell them, and what stands between.

`plant` is a model of motion (of `statespace`, or a `LinearModel`) as a block that a loop closes through.
`DormandPrince` solves one to a tolerance, on the host.
`pid`, `state_feedback` and `regulator` (the gains of a linear quadratic one) tell it what to do, `limited` is
what an actuator cannot exceed and `late` a delay by ticks. `lti` has systems in continuous time, joined to
one before they become a plant, so that a loop without a clock is exact. `vehicle` flies a quadrotor.
"""

from __future__ import annotations

from flowgraph.blocks.control.adaptive import DormandPrince
from flowgraph.blocks.control.controllers import late, limited, pid, regulator, state_feedback
from flowgraph.blocks.control.lti import Lti, pid_action, transfer
from flowgraph.blocks.control.plant import plant
from flowgraph.blocks.control.vehicle import fly_to, quadrotor, quadrotor_motion

__all__ = [
    "plant",
    "DormandPrince",
    "pid",
    "state_feedback",
    "regulator",
    "limited",
    "late",
    "Lti",
    "transfer",
    "pid_action",
    "quadrotor",
    "quadrotor_motion",
    "fly_to",
]

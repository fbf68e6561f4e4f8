"""Trajectories as TUM text: a row is stamp, position and attitude, `t x y z qx qy qz qw`, t in seconds.

The common language of trajectory tools. `flowgraph.write_tum` writes it.

Source: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from __future__ import annotations

from collections.abc import Mapping

from flowgraph import Flight
from flowgraph.blocks.datasets.shape import Recording, chosen, known, offset, policy, the_file
from flowgraph.blocks.datasets.tables import POLICIES, read_table
from flowgraph.blocks.signals import Pose

__all__ = ["ROLES", "SETTINGS", "load"]

ROLES = ("measurement", "truth")
"""What a trajectory is taken for."""

SETTINGS: Mapping[str, str] = {
    "role": "the stream `vicon` (measurement), or the truth",
    "time_offset": "s, added to the stamps",
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
}
"""The settings of `load` and what they mean."""


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read a trajectory: the stream `vicon` (`Pose`), or a truth without a stream.

    Args:
        argument: the file.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Raises:
        DataError: the file is missing, or a row is malformed or out of order (file, line).
        DeclarationError, UnknownNameError: for a setting.
    """
    given = settings or {}
    known(given, SETTINGS, "tum")
    role, shift = chosen(given, "role", ROLES, "tum"), offset(given, "time_offset", "tum")
    file = the_file(argument, kind="tum", what="trajectory")
    made = Recording(file.stem, policy(given, "tum"))
    time, x, said = read_table(
        file, columns=7, delimiter=None, seconds=True, quaternion=3, gaps=True, bad_time=made.bad_time
    )
    made.notes.extend(said)
    pose = {"position": x[:, :3], "attitude": x[:, [6, 3, 4, 5]]}
    made.add("truth" if role == "truth" else "vicon", str(file), time + shift, pose, Pose)
    return made.flight()

"""Trajectories as TUM text: a row is stamp, position and attitude, `t x y z qx qy qz qw`, t in seconds.

The common language of trajectory tools. `flowgraph.write_tum` writes it.

Source: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from __future__ import annotations

from collections.abc import Mapping

from flowgraph import Flight
from flowgraph.blocks.datasets.shape import (
    MEASURED_NOISE,
    Recording,
    chosen,
    known,
    measured_noise,
    policy,
    stream_settings,
    the_file,
)
from flowgraph.blocks.datasets.stamps import UNITS
from flowgraph.blocks.datasets.tables import POLICIES, read_table
from flowgraph.blocks.signals import Pose

__all__ = ["ROLES", "SETTINGS", "load"]

ROLES = ("measurement", "truth")
"""What a trajectory is taken for."""

SETTINGS: Mapping[str, str] = {
    "role": "the stream `vicon` (measurement), or the truth",
    "time.unit": "of the stamps: " + ", ".join(UNITS),
    "time_offset": "s, added to the stamps",
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
    **stream_settings("vicon", "truth"),
    **MEASURED_NOISE,
}
"""The settings of `load` and what they mean."""


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read a trajectory: the stream `vicon` (`Pose`), or a truth without a stream.

    Args:
        argument: the file.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Raises:
        DataError: the file is missing, or a row is malformed, out of order or of no attitude (file, line).
        DeclarationError, UnknownNameError: for a setting.
    """
    given = dict(settings or {})
    known(given, SETTINGS, "tum")
    role = chosen(given, "role", ROLES, "tum")
    name = "truth" if role == "truth" else "vicon"
    if "time_offset" in given:
        given.setdefault(f"{name}.time_offset", given.pop("time_offset"))
    unit = chosen(given, "time.unit", list(UNITS), "tum")
    file = the_file(argument, kind="tum", what="trajectory")
    made = Recording(file.stem, policy(given, "tum"), kind="tum", given=given, unit=unit)
    lines: list[int] = []
    time, x, said = read_table(file, columns=7, delimiter=None, unit=unit, gaps=True, lines=lines)
    made.notes.extend(said)
    pose = {"position": x[:, :3], "attitude": x[:, 3:7]}
    made.add(name, str(file), time, pose, Pose, row=lambda k: f"{file}, line {lines[k]}", scalar_last=True)
    measured_noise(given, "tum", made.info)
    return made.flight()

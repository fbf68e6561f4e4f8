"""The navigation unit of a KITTI drive, a folder `oxts`: a file of 30 numbers an epoch, and the times of all.

    oxts/timestamps.txt          2011-09-26 13:02:25.594360375
    oxts/data/0000000000.txt     lat lon alt roll pitch yaw vn ve vf vl vu ax ay az af al au wx wy wz wf wl wu
                                 pos_accuracy vel_accuracy navstat numsats posmode velmode orimode

Degrees and m; rad, yaw from east to the left; m/s; m/s^2 and rad/s of x forward, y left, z up. The unit's
solution is at once `gps` and the truth: what a filter makes of it shows how it follows, and not how good it
is, as a note says.

Source: A. Geiger, P. Lenz, C. Stiller, R. Urtasun, "Vision meets robotics: the KITTI dataset", IJRR 32(11),
2013.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.cells import stamps
from flowgraph.blocks.datasets.places import NAVIGATION_SETTINGS, add_fixes, add_velocities, diagonal
from flowgraph.blocks.datasets.shape import (
    Recording,
    imu_noise,
    known,
    policy,
)
from flowgraph.blocks.geometry.euler import quaternion_from_angles
from flowgraph.blocks.geometry.geodetic import to_enu
from flowgraph.blocks.signals import Imu, Pose
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["SETTINGS", "load"]

SETTINGS = NAVIGATION_SETTINGS
"""The settings of `load` and what they mean."""

_NUMBERS = 30


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read the streams `imu`, `gps` (`GnssFix`) and `gps_velocity` (`GnssVelocity`); truth: `Pose`.

    Args:
        argument: the folder of a drive, or its folder oxts.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Raises:
        DataError: a file is missing, or has other numbers; names it. UnknownNameError: for a setting.
    """
    given = dict(settings or {})
    known(given, SETTINGS, "kitti")
    folder = Path(argument).expanduser()
    folder = folder / "oxts" if (folder / "oxts").is_dir() else folder
    files = sorted((folder / "data").glob("*.txt"))
    clock = folder / "timestamps.txt"
    if not argument or not files or not clock.is_file():
        raise DataError(
            "this is no navigation unit of KITTI",
            path=str(folder) if argument else "kitti",
            expected="a folder with oxts/timestamps.txt and oxts/data/*.txt",
            got="no data" if clock.is_file() else "no timestamps.txt",
            fix="name the folder of a drive",
        )
    texts = [line for line in clock.read_text().splitlines() if line.strip()]
    if len(texts) != len(files):
        raise DataError(
            "there is not one time a file",
            path=str(clock),
            expected=f"{len(files)} times",
            got=str(len(texts)),
            fix="restore the folder",
        )
    time, _ = stamps(texts, lambda k: f"{clock}, line {k + 1}", unit="s")
    x = np.array([_numbers(file) for file in files])
    made = Recording(
        folder.parent.name or folder.name,
        policy(given, "kitti"),
        kind="kitti",
        given=given,
        place=str(folder),
    )
    row = lambda k: str(files[k])
    made.add("imu", str(folder), time, {"gyro": x[:, 17:20], "specific_force": x[:, 11:14]}, Imu, row=row)
    add_fixes(made, str(folder), time, x[:, :3], diagonal(x[:, 23:24] * np.ones(3)), row)
    add_velocities(made, str(folder), time, x[:, [7, 6, 10]], diagonal(x[:, 24:25] * np.ones(3)))
    origin = float(np.radians(x[0, 0])), float(np.radians(x[0, 1])), float(x[0, 2])
    places = np.concatenate([np.radians(x[:, :2]), x[:, 2:3]], axis=1)
    attitude = np.asarray(quaternion_from_angles(x[:, 3:6], order="zyx", xp=np))
    pose = {"position": to_enu(places, origin), "attitude": attitude}
    made.add("truth", str(folder), time, pose, Pose, row=row)
    made.info["origin"] = origin
    made.info["imu_noise"] = imu_noise(given, "kitti", made.notes)
    made.notes.append(note("info", "gps and the truth are one solution: errors tell how it is followed"))
    return made.flight()


def _numbers(file: Path) -> list[float]:
    try:
        found = [float(cell) for cell in file.read_text().split()]
        if len(found) != _NUMBERS:
            raise ValueError(f"{len(found)} numbers")
    except ValueError as error:
        raise DataError(
            "this is no epoch of the unit",
            path=str(file),
            expected=f"{_NUMBERS} numbers",
            got=str(error)[:80],
            fix="restore the file",
        ) from None
    return found

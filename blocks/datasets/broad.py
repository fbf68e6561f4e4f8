"""The BROAD benchmark: inertial and magnetic recordings of one hand-moved unit, with optical orientation.

    01_undisturbed_slow_rotation_A.mat      imu_gyr (n, 3) rad/s, imu_acc (n, 3) m/s^2, imu_mag (n, 3) uT,
                                            opt_quat (n, 4) and opt_pos (n, 3) m, NaN where not seen,
                                            movement (n,), sampling_rate Hz

The world is east, north, up, with magnetic north on y. Errors are scored where `movement` is true and the
optical system saw the unit, and nowhere else.

Source: D. Laidig, M. Caruso, A. Cereatti and T. Seel, "BROAD - a benchmark for robust inertial orientation
estimation", Data 6(7):72, 2021.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.datasets.matfile import read_mat
from flowgraph.blocks.datasets.shape import (
    NOISE_SETTINGS,
    Recording,
    imu_noise,
    known,
    number,
    stream_settings,
    the_file,
)
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.signals import Imu, MagneticField, Pose
from flowgraph.errors import DataError

__all__ = ["NOISE", "SETTINGS", "SPEED", "load"]

SETTINGS: Mapping[str, str] = {
    "duration": "s, only the first; 0 is all",
    **NOISE_SETTINGS,
    **stream_settings("imu", "magnetometer", "truth"),
}
"""The settings of `load` and what they mean. Samples come at the file's rate, so their order is given."""

NOISE = ImuNoise(gyro=1.1e-4, accelerometer=3.3e-3, gyro_bias=1e-5, accelerometer_bias=1e-3)
"""Densities of the unit: of rate and force as readings at rest show them (Allan deviation at 0.1 and 1 s), of
the gyroscope's bias by the rests before and after a trial."""

SPEED = 0.25
"""m/s, how fast a hand moves the unit: root mean square an axis of the optical velocity, 0.03 to 0.46 by
trial."""

_FIELDS = {
    "imu_gyr": (None, 3),
    "imu_acc": (None, 3),
    "imu_mag": (None, 3),
    "opt_quat": (None, 4),
    "opt_pos": (None, 3),
    "movement": (None,),
    "sampling_rate": (),
}


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read a trial: the streams `imu` (`Imu`) and `magnetometer` (`MagneticField`).

    Args:
        argument: a .mat file of the benchmark.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight`. truth: `Pose`, east-north-up, where the optical system saw the unit. info: `imu_noise`,
        `imu_period_ns`, `absent`, `speed` (m/s, how fast a hand moves the unit), and `scored`, a `Series` of
        whether an error at that time counts.

    Raises:
        DataError: the file is missing or cut off, a field is missing, of another shape or of another unit.
        DeclarationError, UnknownNameError: for a setting.
    """
    given = settings or {}
    known(given, SETTINGS, "broad")
    duration = number(given, "duration", 0.0, "broad")
    file = the_file(argument, kind="broad", what="trial of BROAD", endings=(".mat",))
    fields = read_mat(file, _FIELDS)
    rate = float(fields.pop("sampling_rate"))
    if not 1.0 <= rate <= 1e5:
        raise DataError(
            "'sampling_rate' is no rate of an IMU",
            path=f"{file}: sampling_rate",
            expected="from 1 to 1e5 Hz",
            got=f"{rate:g}",
            fix="restore the file",
        )
    n = len(fields["imu_gyr"])
    for name, array in fields.items():
        if len(array) != n:
            raise DataError(
                f"field {name!r} has another length than imu_gyr",
                path=f"{file}: {name}",
                expected=f"{n} rows",
                got=f"{len(array)} rows",
                fix="restore the file",
            )
    if duration:
        n = min(n, int(duration * rate) + 1)
        fields = {name: array[:n] for name, array in fields.items()}
    time = np.rint(np.arange(n) * (1e9 / rate)).astype(np.int64)
    made = Recording(file.stem, kind="broad", given=given)
    imu = {"gyro": fields["imu_gyr"], "specific_force": fields["imu_acc"]}
    made.add("imu", f"{file}: imu_gyr, imu_acc", time, imu, Imu)
    made.add("magnetometer", f"{file}: imu_mag", time, {"field": fields["imu_mag"] * 1e-6}, MagneticField)
    seen = np.isfinite(fields["opt_quat"]).all(axis=1) & np.isfinite(fields["opt_pos"]).all(axis=1)
    pose = {
        "position": fields["opt_pos"],
        "attitude": fields["opt_quat"],
    }
    made.add("truth", f"{file}: opt_pos, opt_quat", time, pose, Pose)
    made.info["scored"] = Series(time, seen & (fields["movement"] != 0), name="scored")
    made.info["imu_noise"] = imu_noise(given, "broad", made.notes, NOISE)
    made.info["speed"] = SPEED
    made.info["imu_period_ns"] = round(1e9 / rate)
    return made.flight()

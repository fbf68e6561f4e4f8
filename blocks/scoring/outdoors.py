"""What a flight outdoors has for `gnss_ins`: its streams in one form, a local world about the first fix, a
start.

A recording gives positions as latitude, longitude and height or as metres, with a covariance of each or none.
Here all become positions and velocities with covariances, in a world of east, north, up about the first fix,
whose gravity and turn are those of the place. Without a place the world is flat and stands still.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Series
from flowgraph.blocks.geometry.geodetic import to_enu
from flowgraph.blocks.inertial.alignment import StartSpread, rest_seconds, start_belief, usable
from flowgraph.blocks.inertial.compassing import compass_by_gyro
from flowgraph.blocks.inertial.moving import align_moving
from flowgraph.blocks.inertial.navigation import PARAMETERS, Earth, earth_at, extended, gravity_at
from flowgraph.blocks.inertial.outdoors import Antenna, Resting
from flowgraph.blocks.scoring.cases import Adapted, Factors, HeldControl, OnFlight, Smoothed
from flowgraph.blocks.scoring.settings import Positive
from flowgraph.blocks.scoring.start import UNKNOWN_HEADING, Started, turned
from flowgraph.blocks.scoring.tuning import given
from flowgraph.blocks.signals import GnssPosition, GnssVelocity, WheelSpeed
from flowgraph.errors import DataError, DeclarationError, MissingDependencyError, UnknownNameError

__all__ = ["POSITIONS", "Outdoors", "World", "declination"]

POSITIONS = ("gnss", "gps", "rtk", "leica", "vicon")
"""The streams that may measure a position, the first that there is."""

USUAL = {"position": 2.5, "velocity": 0.2}
"""m and m/s, an axis: of a receiver of which nothing is known."""

_LONGEST_REST = 120.0  # s, that are looked at for north
_COMPASSED = 0.1  # rad, of a heading by the Earth's turn that is good enough

_FIRST_HEADING = 2_000_000_000  # ns, within which two antennas tell that of the start

_RIDE = 100_000_000  # ns, between two looks at how a vehicle rolls, where no wheel tells its speed


class World(NamedTuple):
    """The local world: where its origin is (latitude, longitude in rad, height in m), or None; and its
    gravity."""

    origin: tuple[float, float, float] | None
    gravity: tuple[float, float, float]
    earth: Earth | None


@dataclass(frozen=True)
class Outdoors(Factors, Smoothed, Started, HeldControl, Adapted):
    """What is set of a filter that is aided by satellites.

    Args:
        position_noise, velocity_noise: m and m/s, standard deviations of fixes that bring no covariance; the
            flight's own if left out.
        estimate: what is estimated beside pose, velocity and biases, of lever, gyro_scale,
            accelerometer_scale, time_offset and height_offset, joined by +, or none. With auto the lever
            and the time offset where fixes are good to half a metre and nobody says the lever; and the level
            of a barometer.
        compass_noise: rad, of the heading by a magnetometer.
        declination: degrees, of magnetic north, to the east.
        date: year-month-day of the flight, in place of the declination, which then is that of the place.
        height_noise: m, of a barometer.
        speed_noise, slip: m/s, of wheels along and across.
        non_holonomic: whether the body is a vehicle that moves along its x axis, with wheels or without.
        zero_velocity: whether standing still is looked for.
        gyro_bias, accelerometer_bias: rad/s and m/s^2, deviations of the unit's constant biases; the flight's
            if it tells them. Where the first is small enough, a body at rest finds north by the Earth's turn.
    """

    position_noise: Positive | None = None
    velocity_noise: Positive | None = None
    estimate: str = "auto"
    compass_noise: Positive = 0.1
    declination: float | None = None
    date: str | None = None
    height_noise: Positive = 0.5
    speed_noise: Positive = 0.1
    slip: Positive = 0.1
    non_holonomic: bool = False
    zero_velocity: bool = False
    gyro_bias: Positive | None = None
    accelerometer_bias: Positive | None = None

    def inputs(self, on: OnFlight) -> tuple[dict[str, Series], World, str | None]:
        """The inputs of the graph, the world that they are in, and the name of the stream of positions.

        Raises:
            DataError: where there is no inertial unit.
        """
        streams = on.flight.streams
        found = {"imu": on.need("imu")["imu"]}
        name = next((n for n in POSITIONS if n in streams and len(streams[n])), None)
        world = World(None, on.gravity, None)
        if name is None:
            on.note("warning", "no stream of positions: nothing but its readings says where the body goes")
        else:
            found["gnss"], world = self._positions(on, streams[name])
        speeds = next((n for n in ("gnss_velocity", "gps_velocity") if n in streams), None)
        if speeds is not None:
            found["gnss_velocity"] = self._velocities(on, streams[speeds])
        for known in ("heading", "magnetometer", "barometer"):
            if known in streams:
                found[known] = streams[known]
        if "wheels" in streams:
            found["wheels"] = streams["wheels"]
        elif self.non_holonomic:
            found["wheels"] = _unmeasured(found["imu"])
        return found, world, name

    def _positions(self, on: OnFlight, series: Series) -> tuple[Series, World]:
        """As `GnssPosition`, and the world about the first."""
        origin: tuple[float, float, float] | None = None
        world = World(None, on.gravity, None)
        if "latitude" in series.leaves:
            table = np.stack([series[n] for n in ("latitude", "longitude", "height")], axis=-1)
            first = on.flight.info.get("origin", table[int(np.argmax(np.isfinite(table).all(axis=-1)))])
            latitude, longitude, height = (float(x) for x in first)
            origin = latitude, longitude, height
            world = World(origin, gravity_at(latitude, height), earth_at(latitude))
            place = to_enu(table, origin)
            said = f"{math.degrees(latitude):.7f}, {math.degrees(longitude):.7f} degrees, {height:.2f} m"
            whose = "the flight's origin" if "origin" in on.flight.info else "the first fix"
            on.note("info", f"the world is east, north, up about {whose}, {said}")
        else:
            place = series["position"]
        return Series(
            series.time,
            GnssPosition(position=place, covariance=self._covariances(on, series, "position")),
            name="gnss",
            gaps=series.gaps,
        ), world

    def _velocities(self, on: OnFlight, series: Series) -> Series:
        """As `GnssVelocity`."""
        values = GnssVelocity(
            velocity=series["velocity"], covariance=self._covariances(on, series, "velocity")
        )
        return Series(series.time, values, name="gnss_velocity", gaps=series.gaps)

    def _covariances(self, on: OnFlight, series: Series, what: str) -> np.ndarray:
        """Those of the messages; of a message without one that which was set, or is usual."""
        n = len(series)
        setting = self.position_noise if what == "position" else self.velocity_noise
        own = on.flight.info.get(f"{what}_noise", _simulated(on, series.name))
        usual = float(given(setting, given(own, USUAL[what])))
        one = np.eye(3) * usual**2
        told = series["covariance"] if "covariance" in series.leaves else np.full((n, 3, 3), np.nan)
        whole = np.isfinite(told).all(axis=(1, 2)) & (np.einsum("nii->ni", told) > 0.0).all(axis=1)
        if setting is not None:
            whole[:] = False
        if not whole.all() and setting is None and own is None:
            unit = "m" if what == "position" else "m/s"
            on.note("assumed", f"{series.name}: a {what} is good to {usual:g} {unit}; {what}_noise says it")
        return np.where(whole[:, None, None], told, one)

    def north(self, on: OnFlight, world: World) -> float:
        """Where magnetic north is: rad from the world's x axis, to the left.

        Raises:
            DeclarationError: for a date that is none. DataError: for a date without a place.
            MissingDependencyError: for a date without the model of the Earth's field.
        """
        if self.date is not None and self.declination is None:
            if world.origin is None:
                raise DataError(
                    "the declination of this place is not known",
                    path=f"{on.name}.date",
                    expected="positions of latitude and longitude",
                    got="positions in metres",
                    fix="write --set declination=DEGREES",
                )
            east = declination(self.date, world.origin, on.name)
            on.note("info", f"the declination is {math.degrees(east):.2f} degrees (World Magnetic Model)")
            return 0.5 * math.pi - east
        if self.declination is not None:
            return 0.5 * math.pi - math.radians(self.declination)
        field = on.flight.info.get("magnetic_field")
        if field is not None:
            return math.atan2(field[1], field[0])
        on.note("assumed", "magnetic north is north: declination or date says where it is")
        return 0.5 * math.pi

    def estimated(
        self, on: OnFlight, inputs: Mapping[str, Series], name: str | None, lever: bool
    ) -> tuple[str, ...]:
        """What is estimated beside the fifteen.

        Args:
            name: of the stream of the positions. lever: whether the flight says where the antenna sits.

        Raises:
            UnknownNameError: for what cannot be.
        """
        if self.estimate != "auto":
            names = [n.strip() for n in self.estimate.split("+") if n.strip() not in ("", "none")]
            for name in names:
                if name not in PARAMETERS:
                    raise UnknownNameError("parameter", name, PARAMETERS, path=f"{on.name}.estimate")
            return tuple(dict.fromkeys(names))
        found = []
        if "gnss" in inputs and not lever and _good(inputs["gnss"]):
            if f"{name}.time_offset" in on.flight.info.get("sought", ()):
                # a lever along the way is a delay: which of the two it is, straight flights do not tell
                said = "it is taken for the unit's place, while its clock is sought"
                on.note("assumed", f"nobody says where the antenna sits: {said}")
            else:
                found += ["lever", "time_offset"]
                said = "nobody says where the antenna sits and how late it is: both are estimated"
                on.note("assumed", said)
        if "barometer" in inputs:
            found.append("height_offset")
        return tuple(found)

    def antenna(self, on: OnFlight, name: str | None) -> tuple[Antenna, bool]:
        """Where it sits, and whether the flight says so."""
        lever = on.flight.info.get(f"{name}_lever")
        if lever is None:
            return Antenna(), on.flight.truth is not None and "attitude" in on.flight.truth.leaves
        return Antenna(tuple(float(x) for x in lever)), True  # type: ignore[arg-type]

    def started(
        self,
        on: OnFlight,
        inputs: dict[str, Series],
        world: World,
        estimated: tuple[str, ...],
        antenna: Antenna,
    ) -> tuple[Any, dict[str, Series], bool]:
        """The belief to start from, the inputs from then on, and whether next to nothing is known of its
        heading.

        The truth's, or what the file shows at rest; else, of a unit that is good enough and rests, what the
        Earth's turn shows; else that of an alignment in motion, of which the heading is as sure as the motion
        makes it; else a level body with the heading that two antennas tell, or one of which nothing is known.
        """
        begin = self.pose(on, inputs, position=inputs.get("gnss"))
        kept = begin.inputs
        imu = kept["imu"]
        velocity, spread = np.zeros(3), StartSpread(heading=given(begin.heading, StartSpread().heading))
        position = begin.position
        if begin.told and on.flight.truth is not None and "velocity" in on.flight.truth.leaves:
            row = int(np.argmin(np.abs(on.flight.truth.time - begin.time)))
            velocity = on.flight.truth["velocity"][row]
        north = self._north(on, imu, world) if begin.unknown else None
        if north is not None:
            compassed, spread = north
            self._said(on, spread.tilt, spread.velocity, spread.heading)
            if "gnss" in kept:
                size = 3.0 * float(np.sqrt(kept["gnss"]["covariance"][0, 0, 0])) + 0.1
                spread = replace(spread, position=size)
            belief = start_belief(position, compassed, spread=spread)
            return extended(belief, estimated, lever=antenna.lever), kept, False
        if begin.unknown and "gnss" in kept:
            size = max(0.3, float(np.sqrt(np.median(kept["gnss"]["covariance"][:, 0, 0]))))
            moving = align_moving(imu, kept["gnss"], gravity=world.gravity, noise=size)
            if moving is not None and moving.heading < 0.7:
                on.note(
                    "info",
                    "the heading at the start is that of an alignment in motion: known to "
                    f"{math.degrees(moving.heading):.2g} degrees",
                )
                at = moving.belief
                deviations = np.sqrt(np.diagonal(at.covariance))
                self._said(on, float(deviations[6:9].max()), float(deviations[3:6].max()))
                start = extended(at, estimated, lever=antenna.lever)
                return start, kept, False
            if "heading" not in kept:
                on.note("warning", "the motion does not tell the heading at the start: it is unknown")
        antennas = _by_antennas(imu, kept.get("heading")) if begin.unknown else None
        if antennas is not None:
            angle, unsure = antennas
            ahead = on.flight.info.get("heading_baseline", (1.0, 0.0, 0.0))
            angle -= math.atan2(ahead[1], ahead[0])
            begin, spread = (
                begin._replace(attitude=turned(begin.attitude, angle)),
                replace(spread, heading=unsure),
            )
            told = f"known to {math.degrees(unsure):.2g} degrees"
            on.note("info", f"the heading at the start is that of two antennas: {told}")
        force = None
        if not on.weightless:
            push = imu["specific_force"]
            rest = rest_seconds(imu)
            shown = usable(push) & (imu.time - imu.time[0] <= round(rest * 1e9))
            force = push[shown].mean(axis=0) if rest > 0.2 and shown.any() else on.first_up("imu", push)
        if not begin.told and "gnss" in kept:
            spread = StartSpread(
                position=3.0 * float(np.sqrt(kept["gnss"]["covariance"][0, 0, 0])) + 0.1,
                velocity=0.2 if rest_seconds(imu) >= 1.0 else 5.0,
                tilt=0.05 if rest_seconds(imu) >= 1.0 else 0.3,
                heading=spread.heading,
            )
        self._said(on, spread.tilt, spread.velocity, spread.heading)
        levelled = None if begin.told and velocity.any() else force
        belief = start_belief(
            position, begin.attitude, specific_force=levelled, velocity=velocity, spread=spread
        )
        arm = (0.0, 0.0, 0.0) if begin.told and "lever" not in estimated else antenna.lever
        return extended(belief, estimated, lever=arm), kept, spread.heading >= UNKNOWN_HEADING

    def _north(self, on: OnFlight, imu: Series, world: World) -> tuple[np.ndarray, StartSpread] | None:
        """The attitude by the Earth's turn and how sure it is, where the unit is good enough to tell; a note
        says how sure it is, or would be."""
        told = on.flight.info.get("start_spread", (None, None))
        bias, push = given(self.gyro_bias, told[0]), given(self.accelerometer_bias, told[1])
        noise = on.flight.info.get("imu_noise")
        if world.earth is None or bias is None or noise is None or on.weightless:
            return None
        white = 6.0 * np.array([noise.gyro, noise.accelerometer]) / math.sqrt(0.1)  # of means of a tenth
        rate, force = np.minimum(white, [0.03, 0.3]).tolist()
        rest = rest_seconds(imu, rate=rate, force=force, most=_LONGEST_REST)
        if rest < 1.0:
            return None
        found = compass_by_gyro(
            imu, rest, turn=world.earth.turn, noise=noise, gyro_bias=bias,
            accelerometer_bias=given(push, StartSpread().accelerometer_bias),
        )  # fmt: skip
        sure = f"{math.degrees(found.heading):.2g} degrees"
        if found.heading > _COMPASSED:
            on.note("refused", f"gyro compassing: by a unit of this bias north is known to {sure} only")
            return None
        if not found.believed:
            off = f"{found.missed:.1f} deviations"
            on.note("refused", f"gyro compassing: what turns about the vertical is not the Earth, by {off}")
            return None
        on.note(
            "info", f"the heading at the start is that of gyro compassing over {rest:.3g} s: known to {sure}"
        )
        return found.attitude, StartSpread(
            velocity=0.05, tilt=max(found.tilt, 1e-5), heading=max(found.heading, 1e-5), gyro_bias=bias,
            accelerometer_bias=given(push, StartSpread().accelerometer_bias),
        )  # fmt: skip

    def _said(self, on: OnFlight, tilt: float, velocity: float, heading: float | None = None) -> None:
        """A note on how sure the start is."""
        turn = "" if heading is None else f", heading to {math.degrees(heading):.3g}"
        on.note(
            "info",
            f"the start is known to {math.degrees(tilt):.3g} degrees of tilt{turn}, {velocity:.2g} m/s",
        )

    def resting(self) -> Resting | None:
        """How standing still is told, where it is looked for."""
        return Resting() if self.zero_velocity else None


def declination(date: str, place: tuple[float, float, float], path: str) -> float:
    """How far east of north the magnetic north is, rad, by the World Magnetic Model.

    Args:
        date: year-month-day. place: latitude and longitude in rad, height in m.

    Raises:
        DeclarationError: for a date that is none. MissingDependencyError: without the model.
    """
    try:
        day = datetime.date.fromisoformat(date)
    except ValueError:
        raise DeclarationError(
            "setting 'date' is no date",
            path=f"{path}.date",
            expected="year-month-day",
            got=repr(date),
            fix="write date=2024-05-31",
        ) from None
    try:
        from pygeomag import GeoMag  # optional
    except ImportError:
        raise MissingDependencyError(
            "the declination of a date and place needs the World Magnetic Model",
            path=f"{path}.date",
            expected="the Python package pygeomag",
            got="it cannot be imported",
            fix='pip install "flowgraph-filters[wmm]", or write --set declination=DEGREES',
        ) from None
    year = day.year + (day.timetuple().tm_yday - 1) / 365.25
    model = max(2010, min(2025, day.year // 5 * 5))
    latitude, longitude, height = place
    found = GeoMag(coefficients_file=f"wmm/WMM_{model}.COF").calculate(
        glat=math.degrees(latitude), glon=math.degrees(longitude), alt=height * 1e-3, time=year,
        allow_date_outside_lifespan=True,
    )  # fmt: skip
    return math.radians(found.d)


def _good(gnss: Series) -> bool:
    """Whether positions are so good that the arm of an antenna shows."""
    return bool(np.sqrt(np.median(np.einsum("nii->ni", gnss["covariance"]))) <= 0.5)


def _simulated(on: OnFlight, name: str) -> float | None:
    """The noise of a simulated sensor of that name."""
    own = on.flight.info.get("noise", {}).get(name, {}).get("noise")
    return None if own is None or not own > 0.0 else float(own)


def _by_antennas(imu: Series, heading: Series | None) -> tuple[float, float] | None:
    """The angle (rad) that the first reading of two antennas tells, and its deviation, of which what the unit
    has turned since the start is a part; None where nothing comes in the first seconds."""
    if heading is None:
        return None
    whole = np.flatnonzero(np.isfinite(heading["angle"]) & np.isfinite(heading["deviation"]))
    if not len(whole) or heading.time[whole[0]] - imu.time[0] > _FIRST_HEADING:
        return None
    first = int(whole[0])
    before = imu.time <= heading.time[first]
    rate = np.nan_to_num(np.linalg.norm(imu["gyro"][before], axis=-1))
    apart = float(np.sum(rate * np.diff(imu.time[before], append=imu.time[before][-1:]) * 1e-9))
    unsure = math.hypot(float(heading["deviation"][first]), apart)
    return (float(heading["angle"][first]), unsure) if unsure < UNKNOWN_HEADING else None


def _unmeasured(imu: Series) -> Series:
    """Wheels of which nobody tells the speed, ten times a second, at times of the inertial unit."""
    number = (imu.time - imu.time[0]) // _RIDE
    rows = np.flatnonzero(np.diff(number, prepend=-1) > 0)
    return Series(imu.time[rows], WheelSpeed(speed=np.full(len(rows), np.nan)), name="wheels", gaps=True)

"""Simulated flights. `sim`: 1 s at rest, then a smooth figure in space, with an IMU and a motion capture.

The figure is a graph, of which a flight is a run: see `figure`. `sim:thesis`, `sim:roundtrip` and `sim:hover`
go through the simulated world with sensors of choice: see `worlds`; `sim:plane` is a point in the plane: see
`plane`; `sim:drive` is a car: see `drive`.
"""

from __future__ import annotations

from collections.abc import Mapping

from flowgraph import Flight
from flowgraph.blocks.datasets.adjust import stream_settings
from flowgraph.blocks.datasets.placed import PLACED, parted, placed_flight
from flowgraph.blocks.flights import drive, figure, plane, worlds
from flowgraph.errors import UnknownNameError

__all__ = ["SETTINGS", "load"]

SETTINGS: Mapping[str, str | float] = {
    **drive.DEFAULTS,
    "road": "of a drive: its number, that of the seed if left out",
    "unit": "of a drive: " + ", ".join(drive.GRADES),
    **worlds.SETTINGS,
    **plane.DEFAULTS,
    **stream_settings("STREAM", only=PLACED),
    **figure.DEFAULTS,
}
"""All settings that `load` understands: those of the figure with its values, and `worlds.SETTINGS`, whose
values when left out are their own; those of any stream are of a flight that was made, as of a recording."""


def load(argument: str = "", *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Make a flight with the streams `imu` (`Imu`) and `vicon` (`Pose`), or one through a world.

    Args:
        argument: "", "quadrotor" or "figure" for the figure (see `figure`); thesis, roundtrip or hover for a
            world (see `worlds`); plane for a point in the plane (see `plane`); drive for a car (see `drive`).
        seed: of the figure and of all noise. Each noise has a random stream of its own name, so that a
            change of one setting does not change the draws of another.
        settings: any of `figure.DEFAULTS`; of a world, any of `worlds.SETTINGS` that concern it.

    Raises:
        UnknownNameError: for another shape or an unknown setting.
        DeclarationError: for a setting that is not a number in its range.
    """
    own, placed = parted(settings or {}, SETTINGS)
    return placed_flight(_made(argument, seed, own), placed, "sim")


def _made(argument: str, seed: int, settings: Mapping[str, str | float]) -> Flight:
    if argument in ("", "quadrotor", "figure"):
        return figure.load_figure(seed=seed, settings=settings)
    if argument in worlds.WORLDS:
        return worlds.load_world(argument, seed=seed, settings=settings)
    if argument == "plane":
        return plane.load_plane(seed=seed, settings=settings)
    if argument == "drive":
        return drive.load_drive(seed=seed, settings=settings)
    kinds = ["quadrotor", "figure", "plane", "drive", *worlds.WORLDS]
    raise UnknownNameError("simulated flight", argument, kinds, path="sim")

"""The pose of a body from the tags that its camera sees: the stage on the host, before any filter.

Finding a pose in an image takes OpenCV, which no pipeline holds. So this graph is one of its own, run in
Python,
and what it gives is a source of the filters: they are lowered, and it is not. Lowering it says so.

Sources: `blocks/vision/pnp.py`; the map of tags that nobody surveyed, `blocks/vision/mapping.py`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Case, DataError, Flight, Result, Series, Stream, delay, graph, simulate
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.signals import Pose, PoseMeasurement, Tags
from flowgraph.blocks.vision.camera import Camera, Mount
from flowgraph.blocks.vision.mapping import build_map, frames_of
from flowgraph.blocks.vision.pnp import as_measurements, find_pose, no_pose
from flowgraph.blocks.vision.tags import TagMap
from flowgraph.data.inputs import clocks_of
from flowgraph.errors import UnknownNameError
from flowgraph.language.checks import need_numbers

WHICH = ("all", "even", "odd")


@graph
def tag_pose(
    tags: Stream[Tags],
    *,
    tag_map: TagMap,
    camera: Camera,
    mount: Mount,
    prior: tuple[np.ndarray, np.ndarray] | None = None,
    pixel_noise: float = 0.5,
    least: int = 1,
):
    """Pose of a body from AprilTags (PnP), on the host: position, attitude, covariance, reprojection error.

    Collected: `pose`, wherever at least `least` tags of the map are seen.
    """
    last = delay(no_pose(), name="last")
    pose, remembered = find_pose(
        last, tags, tag_map=tag_map, camera=camera, mount=mount, prior=prior, pixel_noise=pixel_noise,
        least=least, name="pnp",
    )  # fmt: skip
    last.feed(remembered)
    return {"pose": pose}


@tag_pose.on_flight
def for_flight(
    flight: Flight,
    *,
    tags: str = "all",
    pixel_noise: float | None = None,
    least: int = 1,
    settle: float = 0.0,
) -> Case:
    """Find the poses of a flight with a camera.

    Args:
        flight: with the stream `tags`; its info has `camera` and `mount`, and a `tag_map` or the `tag_side`
            of tags, of which a map is made first, from all of them.
        tags: all, even or odd: the ids that are used.
        pixel_noise: standard deviation of a corner's coordinate, px; the flight's, or 0.5, if left out.
        least: how many tags there must be.
        settle: seconds at the start that the errors leave out.

    Raises:
        DataError: where the flight has no tags.
        DeclarationError, UnknownNameError: for a setting that is out of range.
    """
    need_numbers(
        "tag_pose", positive={"pixel_noise": pixel_noise, "least": least}, not_negative={"settle": settle}
    )
    if tags not in WHICH:
        raise UnknownNameError("set of tags", tags, WHICH, path="tag_pose.tags")
    inputs = flight.need("tag_pose", "tags")
    tag_map = map_of(flight)
    if tags != "all":
        tag_map = tag_map.only(tag_map.ids[tag_map.ids % 2 == (tags == "odd")].tolist())
    noise = flight.info.get("pixel_noise", 0.5) if pixel_noise is None else pixel_noise
    built = tag_pose.build(
        **clocks_of(inputs),
        sizes={"tags": inputs["tags"]["ids"].shape[1]},
        tag_map=tag_map,
        camera=flight.info["camera"],
        mount=flight.info["mount"],
        pixel_noise=noise,
        least=least,
    )
    truth = flight.truth

    def score(result: Result) -> dict[str, float]:
        found = result["pose"]
        row = {"images": float(len(inputs["tags"])), "poses": float(len(found))}
        if len(found):
            row["reprojection_px"] = float(np.median(found["error"]))
        return row | ({} if truth is None else pose_errors(found, truth, settle=settle))

    return Case(built, inputs, score, estimate="pose")


def map_of(flight: Flight) -> TagMap:
    """The flight's map of tags; where nobody surveyed it, one made of all its images."""
    if "tag_map" in flight.info:
        found: TagMap = flight.info["tag_map"]
        return found
    frames = frames_of(flight.streams["tags"])
    return build_map(frames, flight.info["camera"], side=flight.info["tag_side"]).tag_map


def poses_of(graph_name: str, flight: Flight, *, tags: str = "all") -> Series:
    """The measured poses of a flight, for a filter: its stream `pose`, those of its `tags`, or of its
    `vicon`.

    Raises:
        DataError: where it has none of them, or no image shows a tag.
    """
    if "pose" in flight.streams:
        return flight.need(graph_name, "pose")["pose"]
    if "tags" in flight.streams:
        case = tag_pose.case(flight, tags=tags)
        found = simulate(case.graph, case.inputs)["pose"]
        if not len(found):
            raise DataError(
                "no image of this flight gives a pose",
                path=f"{flight.name}: tags",
                expected="at least one image with tags of the map",
                got=f"{len(flight.streams['tags'])} images",
                fix="check the map's ids, or the setting tags",
            )
        return Series(found.time, found.values, name="pose")
    if "vicon" in flight.streams:
        vicon = flight.need(graph_name, "vicon")["vicon"]
        pose: Any = vicon.values
        assert isinstance(pose, Pose)
        return Series(vicon.time, as_measurements(pose.position, pose.attitude), name="pose")
    raise DataError(
        f"this flight lacks what {graph_name} needs",
        path=flight.name,
        expected="one of the streams pose, tags and vicon",
        got=", ".join(flight.streams) or "no stream",
        fix="choose another flight, or build the graph with your own sources",
    )


__all__ = ["PoseMeasurement", "map_of", "poses_of", "tag_pose"]

"""The pose of a body from the tags that its camera sees: the stage on the host, before any filter.

Finding a pose in an image takes OpenCV, which no pipeline holds. So this graph is one of its own, run in
Python, and what it gives is a source of the filters: they are lowered, and it is not. Lowering it says so.

Sources: `blocks/vision/pnp.py`; the map of tags that nobody surveyed, `blocks/vision/mapping.py`.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from flowgraph import Case, DataError, Flight, Result, Series, Stream, delay, graph, simulate
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.scoring.cases import OnFlight, Scored, on_flight
from flowgraph.blocks.scoring.euler import MEASURED
from flowgraph.blocks.scoring.settings import Positive, named, positive
from flowgraph.blocks.scoring.tuning import given
from flowgraph.blocks.signals import Pose, PoseMeasurement, Tags
from flowgraph.blocks.vision.camera import Camera, Mount
from flowgraph.blocks.vision.mapping import map_of
from flowgraph.blocks.vision.pnp import as_measurements, find_pose, no_pose
from flowgraph.blocks.vision.tags import TagMap

_AT_ONCE = Scored(settle=0.0)


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


_UNSMOOTHED = "each picture is taken by itself, so the later ones say nothing of it"


@on_flight(tag_pose, "tags", ranged=False, unsmoothed=_UNSMOOTHED)
def for_flight(
    on: OnFlight,
    *,
    tags: Annotated[str, named("set of tags", ("all", "even", "odd"))] = "all",
    pixel_noise: Positive | None = None,
    least: Annotated[int, positive] = 1,
    scored: Scored = _AT_ONCE,
) -> Case:
    """Find the poses of a flight with a camera.

    Args:
        flight: with the stream `tags`; its info has `camera` and `mount`, and a `tag_map` or the `tag_side`
            of tags, of which a map is made first, from all of them.
        tags: all, even or odd: the ids that are used.
        pixel_noise: standard deviation of a corner's coordinate, px; the flight's, or 0.5, if left out.
        least: how many tags there must be.

    Raises:
        DataError: where the flight has no tags.
        DeclarationError, UnknownNameError: for a setting that is out of range.
    """
    info, images = on.flight.info, on.inputs["tags"]
    tag_map = map_of(on.flight)
    if tags != "all":
        tag_map = tag_map.only(tag_map.ids[tag_map.ids % 2 == (tags == "odd")].tolist())
    errors = scored.score(on, pose_errors, estimate="pose")

    def score(result: Result) -> dict[str, float]:
        found = result["pose"]
        row = {"images": float(len(images)), "poses": float(len(found))}
        if len(found):
            row["reprojection_px"] = float(np.median(found["error"]))
        return row | errors(result)

    return on.case(
        score,
        estimate="pose",
        sizes={"tags": images["ids"].shape[1]},
        tag_map=tag_map,
        camera=info["camera"],
        mount=info["mount"],
        pixel_noise=given(pixel_noise, info.get("pixel_noise", 0.5)),
        least=least,
    )


def poses_of(graph_name: str, flight: Flight, *, tags: str = "all") -> Series:
    """The measured poses of a flight, for a filter: its stream `pose`, those of its `tags`, or of its
    `vicon`.

    Raises:
        DataError: where it has none of them, or no image shows a tag.
    """
    source = next((name for name in MEASURED if name in flight.streams), None)
    if source is None:
        raise DataError(
            f"this flight lacks what {graph_name} needs",
            path=flight.name,
            expected="one of the streams pose, tags and vicon",
            got=", ".join(flight.streams) or "no stream",
            fix="choose another flight, or build the graph with your own sources",
        )
    if source == "tags":
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
        seen = flight.streams["tags"]
        stamp = seen.stamp[np.searchsorted(seen.time, found.time)] if seen.is_late else None
        return Series(found.time, found.values, name="pose", stamp=stamp)
    measured = flight.need(graph_name, source)[source]
    if source == "pose":
        return measured
    pose: Any = measured.values
    assert isinstance(pose, Pose)
    values = as_measurements(pose.position, pose.attitude)
    return measured.holding(values, "pose")


__all__ = ["PoseMeasurement", "poses_of", "tag_pose"]

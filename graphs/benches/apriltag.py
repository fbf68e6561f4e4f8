"""AprilTags and the 15-state filters, on every recording that is there, beside a simulated flight of the
course.

A recording with surveyed truth is scored by position (root mean square, m) and attitude (geodesic, degrees).
One without, as the hand-held one, is scored by tags that took no part: the filter is given the poses of PnP
from the even ids only, and the corners of the odd ids are projected through its pose. So the ids that judge
are never those that were used; the map is made of all.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Flight, Report, Series, simulate
from flowgraph.blocks.datasets import course, rob6213, studentdata, umd
from flowgraph.blocks.metrics.errors import interpolate_pose, pose_errors, within_truth
from flowgraph.blocks.vision.mapping import frames_of, map_of
from flowgraph.blocks.vision.motion import velocity_error
from flowgraph.blocks.vision.pnp import rotation_of, solve
from flowgraph.blocks.vision.tags import TagMap
from flowgraph.errors import DataError
from flowgraph.graphs.ins_ekf_pose import ins_ekf_pose
from flowgraph.graphs.ins_particle import ins_particle
from flowgraph.graphs.ins_ukf_pose import ins_ukf_pose
from flowgraph.graphs.ins_ukf_velocity import ins_ukf_velocity
from flowgraph.graphs.tag_pose import poses_of

__all__ = ["apriltag", "drift", "held_out", "lasting", "odd_reprojection", "withheld"]

PUBLISHED = {  # position, 3-D metres, on files 1-7: extended filter, particle filter
    1: (0.156, 0.142), 2: (0.119, 0.144), 3: (0.186, 0.133), 4: (0.192, 0.136), 5: (0.151, 0.158),
    6: (0.090, 0.141), 7: (0.117, 0.145),
}  # fmt: skip
SPANS = (0.5, 1.0, 2.0, 3.0, 5.0)  # s, over which a drift is told
BLIND = 1e4  # m^2 and rad^2: the covariance of a pose that says nothing


def apriltag(
    *, data: str | None = None, seed: int = 0, seconds: float = 30.0, particles: int = 0, gap: float = 0.5
) -> Report:
    """AprilTags and 15-state filters: a simulated flight of the course, and the recordings that are there.

    Args:
        data: folder of recordings; $FLOWGRAPH_DATA or ../shared/datasets if left out.
        seed: of the simulated flight.
        seconds: how long that flight is.
        particles: of `ins_particle` on it; 0 leaves that row out, 5000 is what the course asks for.
        gap: s; how long the even ids of the hand-held recordings are withheld, out of every 3 s.
    """
    root = Path(data or os.environ.get("FLOWGRAPH_DATA", "../shared/datasets"))
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    figures: dict[str, Callable[[Path], None]] = {}
    flight = course.load(seed=seed, settings={"duration": seconds})
    rows += _posed(flight, figures, particles=particles)
    for file in sorted(root.glob("**/studentdata*.mat")):
        flight = studentdata.load(str(file))
        notes += [f"{flight.name}: {note}" for note in flight.notes]
        if flight.truth is None:
            continue  # the notes say that there is no motion capture
        if "tags" in flight.streams:
            number = int("".join(c for c in file.stem if c.isdigit()) or 0)
            rows += _posed(flight, figures, particles=particles, published=PUBLISHED.get(number))
    for file in sorted(root.glob("**/proj2_dataset*.mat")):
        rows += _flown(str(file), notes, figures)
    for file in sorted(root.glob("**/Data*New.mat")):
        rows += _hand_held(umd.load(str(file)), notes, gap)
    if len(rows) <= 3:
        notes.append(f"no recordings under {root}")
    return Report(rows, figures, tuple(notes))


def _row(data: str, what: str, error: Mapping[str, float], raw: float | None, **more: Any) -> dict[str, Any]:
    position = error.get("position_rmse_m")
    found = {
        "data": data,
        "what": what,
        "position_m": position,
        "attitude_deg": error.get("attitude_rmse_deg"),
        "of_raw": None if raw is None or position is None else position / raw,
        "px": None,
        "px_in_gaps": None,
        "m/s": None,
        "published_m": None,
        **more,
    }
    return {name: round(v, 4) if isinstance(v, float) else v for name, v in found.items()}


def _posed(
    flight: Flight,
    figures: dict[str, Callable[[Path], None]],
    *,
    particles: int,
    published: tuple[float, float] | None = None,
) -> Iterator[dict[str, Any]]:
    """PnP and the filters that it feeds, against the truth."""
    flight = _with(flight, poses_of("apriltag", flight))
    assert flight.truth is not None
    error = pose_errors(flight.streams["pose"], flight.truth, settle=1.0)
    raw = error["position_rmse_m"]
    yield _row(flight.name, "PnP", error, None, px=float(np.median(flight.streams["pose"]["error"])))
    graphs: list[tuple[str, Any, dict[str, Any]]] = [
        ("ins_ekf_pose", ins_ekf_pose, {}),
        ("ins_ukf_pose", ins_ukf_pose, {}),
    ]
    if particles:
        graphs.append((f"ins_particle, {particles}", ins_particle, {"particles": particles}))
    for name, graph, settings in graphs:
        case = graph.case(flight, **settings)
        result = simulate(case.graph, case.inputs)
        if name == "ins_ukf_pose":
            _draw(figures, flight, result, case.order)
        theirs = {"ins_ekf_pose": 0, "ins_particle": 1}.get(name.partition(",")[0])
        yield _row(
            flight.name, name, case.score(result), raw,
            published_m=published[theirs] if published and theirs is not None else None,
        )  # fmt: skip


def _draw(figures: dict[str, Callable[[Path], None]], flight: Flight, result: Any, order: str) -> None:
    # With them comes SciPy, which only pictures need.
    from flowgraph.drawing.trajectory import plot_ins, plot_space

    belief, observed = result["belief"], flight.streams["pose"]

    def space(file: Path) -> None:
        plot_space(belief, flight.truth, observed, file)

    def states(file: Path) -> None:
        plot_ins(belief, flight.truth, observed, file, order=order)

    figures[f"{flight.name}_space.png"], figures[f"{flight.name}_states.png"] = space, states


def _with(flight: Flight, pose: Series) -> Flight:
    return Flight(flight.name, {**flight.streams, "pose": pose}, flight.truth, flight.info, flight.notes)


def _flown(
    file: str, notes: list[str], figures: dict[str, Callable[[Path], None]]
) -> Iterator[dict[str, Any]]:
    """Recorded vision of a quadrotor, with the IMU that its motion capture implies."""
    recorded, flight = rob6213.load(file, settings={"frame": "raw"}), rob6213.load(file)
    notes += [f"{flight.name}: {note}" for note in flight.notes]
    if flight.truth is None:
        return
    error = pose_errors(recorded.streams["pose"], flight.truth, settle=1.0)
    raw = error["position_rmse_m"]
    yield _row(flight.name, "vision, as recorded", error, None)
    yield _row(
        flight.name, "vision, registered", pose_errors(flight.streams["pose"], flight.truth, settle=1.0), raw
    )
    for name, graph, settings in (
        ("ins_ekf_pose, derived IMU", ins_ekf_pose, {}),
        ("ins_ukf_pose, derived IMU", ins_ukf_pose, {}),
        ("ins_ukf_velocity (gyro), derived IMU", ins_ukf_velocity, {"rate": "gyro"}),
        ("ins_ukf_velocity (camera), derived IMU", ins_ukf_velocity, {"rate": "camera"}),
    ):
        case = graph.case(flight, **settings)
        result = simulate(case.graph, case.inputs)
        if "ukf_pose" in name:
            _draw(figures, flight, result, case.order)
        if "velocity" in name:
            grown = {span: drift(result["belief"], flight.truth, span) for span in SPANS}
            said = "; ".join(f"{h:.4f} in {span:g} s ({a:.4f})" for span, (a, h) in grown.items())
            notes.append(f"{flight.name}: {name}: drift in the plane (3-D), m: {said}")
        yield _row(flight.name, name, case.score(result), raw if "pose" in name else None)
    fit = velocity_error(flight.streams["motion"], flight.truth, flight.info["mount"])
    yield _row(flight.name, f"camera velocity, {flight.info['delay']:.3f} s late", {}, None, **{"m/s": fit})


def _hand_held(flight: Flight, notes: list[str], gap: float) -> Iterator[dict[str, Any]]:
    """Map, PnP and filter of a recording without truth, judged by tags that took no part."""
    notes += [f"{flight.name}: {note}" for note in flight.notes]
    tag_map = map_of(flight)
    flight = Flight(flight.name, flight.streams, None, {**flight.info, "tag_map": tag_map}, flight.notes)
    pixels, apart = held_out(flight, tag_map)
    notes.append(f"{flight.name}: split-half distance of camera positions {1e3 * apart:.2f} mm (median)")
    yield _row(flight.name, "PnP from even ids: odd ids", {}, None, px=pixels)
    even = poses_of("apriltag", flight, tags="even")
    best = poses_of("apriltag", flight)
    seen = odd_reprojection(flight, tag_map, dict(zip(best.time.tolist(), _poses(best), strict=True)))
    yield _row(flight.name, "PnP from all ids, those that judge it too", {}, None, px=_median(seen))
    kept = lasting(flight, tag_map, dict(zip(even.time.tolist(), _poses(even), strict=True)))
    notes.append(f"{flight.name}: correlation of an odd corner's residual with the image before: {kept:.2f}")
    blind, gapped = withheld(even, gap)
    held = dict(zip(even.time.tolist(), _poses(blind), strict=True))
    for name, used, hidden in (
        ("ins_ukf_pose, even ids: odd ids", even, None),
        (f"last PnP held over gaps of {gap:g} s: odd ids", None, gapped),
        (f"ins_ukf_pose, gaps of {gap:g} s: odd ids", blind, gapped),
    ):
        if used is None:
            poses = held
        else:
            case = ins_ukf_pose.case(_with(flight, used))
            belief = simulate(case.graph, case.inputs)["belief"]
            poses = dict(zip(belief.time.tolist(), _poses(belief), strict=True))
        found = odd_reprojection(flight, tag_map, poses)
        yield _row(
            flight.name, name, {}, None, px=_median(found),
            px_in_gaps=None if hidden is None else _median({t: found[t] for t in hidden if t in found}),
        )  # fmt: skip


def withheld(pose: Series, gap: float, every: float = 3.0) -> tuple[Series, list[int]]:
    """The poses with those of the last `gap` of every `every` seconds taken away, and the times of these.

    What stands in their place is the last pose before, with a covariance that makes it say nothing: the
    filter is asked for its pose at those times, and told none.
    """
    since = pose.seconds
    gone = (np.mod(since, every) >= every - gap) & (since > every)
    index = np.maximum.accumulate(np.where(gone, 0, np.arange(len(pose))))
    v = pose.values
    covariance = np.array(v.covariance[index])
    covariance[gone] = np.eye(6) * BLIND
    values = type(v)(v.position[index], v.attitude[index], covariance, v.error[index], v.tags[index])
    return Series(pose.time, values, name="pose"), pose.time[gone].tolist()


def _poses(series: Series) -> list[tuple[np.ndarray, np.ndarray]]:
    return list(zip(series["position"], rotation_of(series["attitude"]), strict=True))


def drift(belief: Series, truth: Series, span: float) -> tuple[float, float]:
    """By how much the position's error grows within `span` seconds: root mean square over all starts, m, in
    three dimensions and in the horizontal plane.

    Raises:
        DataError: when the run is shorter than the span.
    """
    seen = within_truth(belief, truth, 0.0)
    apart = seen["position"] - interpolate_pose(truth, seen.time)[0]
    later = np.searchsorted(seen.time, seen.time + round(span * 1e9))
    inside = later < len(seen)
    if not inside.any():
        raise DataError(
            "the run is shorter than the span of the drift",
            path=belief.name,
            expected=f"more than {span:g} s within the truth",
            got=f"{len(seen)} beliefs",
            fix="choose a shorter span",
        )
    squared = (apart[later[inside]] - apart[inside]) ** 2
    return float(np.sqrt(squared.sum(axis=1).mean())), float(np.sqrt(squared[:, :2].sum(axis=1).mean()))


Poses = Mapping[int, tuple[np.ndarray, np.ndarray]]
"""Position and attitude matrix of the body by time, ns."""


def _odd_residuals(
    flight: Flight, tag_map: TagMap, poses: Poses
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Time, odd ids (k,) and where a pose puts their corners minus where they are (k, 4, 2), px."""
    camera, mount, tags = flight.info["camera"], flight.info["mount"], flight.streams["tags"]
    for time, (ids, corners) in zip(tags.time.tolist(), frames_of(tags), strict=True):
        places, known = tag_map.find(ids)
        odd = known & (ids % 2 == 1)
        if time in poses and odd.any():
            R, t = mount.view(*poses[time])
            yield time, ids[odd], camera.project(places[odd] @ R.T + t) - corners[odd]


def odd_reprojection(flight: Flight, tag_map: TagMap, poses: Poses) -> dict[int, np.ndarray]:
    """By time (ns), the distances (px) of the odd ids' corners from where a pose of the body puts them."""
    found = _odd_residuals(flight, tag_map, poses)
    return {time: np.linalg.norm(residual, axis=-1).ravel() for time, _, residual in found}


def lasting(flight: Flight, tag_map: TagMap, poses: Poses, *, most: float = 3.0) -> float:
    """How much of the odd ids' residuals is still there in the next image: the correlation of each corner's
    with its own before. Averaging over images takes away only what is not. Those beyond `most` px are left
    out.

    Raises:
        DataError: when no odd id is seen in two images.
    """
    before: dict[int, np.ndarray] = {}
    pairs: list[np.ndarray] = []
    for _, ids, residual in _odd_residuals(flight, tag_map, poses):
        for tag, now in zip(ids.tolist(), residual, strict=True):
            if np.abs(now).max() > most:
                before.pop(tag, None)
                continue
            if tag in before:
                pairs.append(np.stack([before[tag].ravel(), now.ravel()]))
            before[tag] = now
    if not pairs:
        raise DataError(
            "no odd tag is seen twice",
            path=flight.name,
            expected="an odd id in two images",
            got=f"{len(flight.streams['tags'])} images",
            fix="choose another recording",
        )
    first, second = np.concatenate(pairs, axis=1)
    return float(first @ second / np.sqrt((first @ first) * (second @ second)))


def held_out(flight: Flight, tag_map: TagMap) -> tuple[float, float]:
    """Median reprojection (px) of odd ids through PnP from the even ones, and the median distance (m) of the
    camera's place from even and from odd ids.

    Raises:
        DataError: when no image shows two tags of each kind.
    """
    camera = flight.info["camera"]
    pixels, apart = [], []
    for ids, corners in frames_of(flight.streams["tags"]):
        places, known = tag_map.find(ids)
        even, odd = known & (ids % 2 == 0), known & (ids % 2 == 1)
        if min(even.sum(), odd.sum()) < 2:
            continue
        a, b = (solve(corners[half], places[half], camera) for half in (even, odd))
        if a is None or b is None:
            continue
        pixels.append(
            np.linalg.norm(camera.project(places[odd] @ a.R.T + a.t) - corners[odd], axis=-1).ravel()
        )
        apart.append(np.linalg.norm(a.R.T @ a.t - b.R.T @ b.t))
    if not pixels:
        raise DataError(
            "no image shows two even and two odd tags",
            path=flight.name,
            expected="images with four tags or more",
            got=f"{len(flight.streams['tags'])} images",
            fix="choose another recording",
        )
    return float(np.median(np.concatenate(pixels))), float(np.median(apart))


def _median(found: Mapping[int, np.ndarray]) -> float | None:
    return float(np.median(np.concatenate(list(found.values())))) if found else None

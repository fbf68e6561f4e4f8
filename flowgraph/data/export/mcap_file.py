"""MCAP: the streams of a run in the file that Foxglove opens, each message with the schema it is drawn by.

A stream `belief` is the topic `/belief`, with all of its fields under a schema of its own for plots. What
has a place is there again under a standard schema: `/belief/pose` (`foxglove.PoseInFrame`) or
`/belief/point` (`foxglove.Point3InFrame`), `/tf` (`foxglove.FrameTransform`, with the stream as child
frame), and `/gps/fix` (`foxglove.LocationFix`). A dot in a name is a step of the topic. Messages are JSON, in
the order of time; a message is logged when its value came, and carries the time at which it was true.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.export.packages import needed
from flowgraph.data.export.places import fixes, placed
from flowgraph.data.export.schemas import FIX, POINT, POSE, TRANSFORM, of_type
from flowgraph.data.files import whole
from flowgraph.data.notes import note
from flowgraph.data.series import Series
from flowgraph.errors import DataError

KNOWN = 3  # of foxglove.PositionCovarianceType

Make = Callable[[int], dict[str, Any]]


@dataclass(frozen=True)
class _Topic:
    name: str
    schema: dict[str, Any]
    time: np.ndarray
    stamp: np.ndarray
    make: Make  # the message of a row, without its time


def write_mcap(
    streams: Mapping[str, Series], file: str | Path, *, about: Mapping[str, object] | None = None
) -> tuple[str, ...]:
    """Write streams as an MCAP file of JSON messages.

    Args:
        streams: by name, with times from 0 on.
        file: to be written, mostly with the suffix .mcap.
        about: kept in the file as the metadata `flowgraph`.

    Returns:
        Notes: what has no place because it is not finite.

    Raises:
        MissingDependencyError: without the package mcap.
        DataError: for a time before 0, which MCAP cannot hold.
        OutputError: where the file cannot be written.
    """
    writer_of = needed("mcap.writer", "an MCAP file", "mcap").Writer
    topics: list[_Topic] = []
    notes: list[str] = []
    for name, series in streams.items():
        if len(series) and int(min(series.time.min(), series.stamp.min())) < 0:
            raise DataError(
                "MCAP has no times before 0",
                path=f"{file}: {name}",
                expected="times of at least 0 ns",
                got=f"{int(min(series.time.min(), series.stamp.min()))} ns",
                fix="shift the recording: STREAM.time_offset moves the stamps of a stream",
            )
        found, lacking = _topics(name, series)
        topics += found
        if lacking:
            notes.append(
                note("skipped", f"{lacking} of {len(series)} rows of {name} have no place: not finite")
            )
    with whole(file) as stream:
        writer = writer_of(stream)
        writer.start(profile="", library="flowgraph")
        schemas: dict[str, int] = {}
        channels = []
        for topic in topics:
            text = json.dumps(topic.schema)
            if text not in schemas:
                schemas[text] = writer.register_schema(
                    name=_unused(topic.schema["title"], schemas), encoding="jsonschema", data=text.encode()
                )
            channels.append(
                writer.register_channel(topic=topic.name, message_encoding="json", schema_id=schemas[text])
            )
        for channel, log, publish, data in _messages(topics, channels):
            writer.add_message(channel_id=channel, log_time=log, publish_time=publish, data=data)
        writer.add_metadata("flowgraph", {key: str(value) for key, value in (about or {}).items()})
        writer.finish()
    return tuple(notes)


def _unused(title: str, schemas: Mapping[str, int]) -> str:
    """A name that no other schema has: two types may be called the same."""
    taken = sum(json.loads(text)["title"] == title for text in schemas)
    return f"{title}_{taken + 1}" if taken else title


def _messages(topics: list[_Topic], channels: list[int]) -> Iterator[tuple[int, int, int, bytes]]:
    """All messages in the order of time, those of one time in the order of the streams."""
    if not topics:
        return
    times = np.concatenate([topic.time for topic in topics])
    owner = np.concatenate([np.full(len(topic.time), k) for k, topic in enumerate(topics)])
    row = np.concatenate([np.arange(len(topic.time)) for topic in topics])
    for k in np.argsort(times, kind="stable"):
        topic, at = topics[owner[k]], int(row[k])
        stamp = int(topic.stamp[at])
        message = {"timestamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9}, **topic.make(at)}
        yield channels[owner[k]], int(times[k]), stamp, json.dumps(message, allow_nan=False).encode()


def _topics(name: str, series: Series) -> tuple[list[_Topic], int]:
    """The topics of a stream, and how many rows have no place where others have."""
    root = "/" + name.replace(".", "/")
    found = [_Topic(root, of_type(series.type), series.time, series.stamp, _fields(series))]
    place, earth = placed(series), fixes(series)

    def topic(name: str, schema: dict[str, Any], rows: np.ndarray, make: Make) -> None:
        found.append(_Topic(name, schema, series.time[rows], series.stamp[rows], make))

    if place is not None:
        if place.position is not None and place.attitude is not None:
            topic(f"{root}/pose", POSE, place.rows, _pose(place.frame, place.position, place.attitude))
        elif place.position is not None:
            topic(f"{root}/point", POINT, place.rows, _point(place.frame, place.position))
        if place.attitude is not None:
            at = np.zeros((len(place.rows), 3)) if place.position is None else place.position
            topic("/tf", TRANSFORM, place.rows, _transform(place.frame, name, at, place.attitude))
    if earth is not None:
        degrees = np.degrees(np.stack([earth.latitude, earth.longitude], axis=-1))
        topic(f"{root}/fix", FIX, earth.rows, _fix(name, degrees, earth.height, earth.covariance))
    return found, max((p.lacking for p in (place, earth) if p is not None), default=0)


def _fields(series: Series) -> Make:
    """All fields of a row, nested as their names are; without those that are not finite."""
    columns = [(leaf.split("."), array.tolist()) for leaf, array in series.leaves.items()]
    good = [
        np.isfinite(array).all(axis=tuple(range(1, array.ndim))).tolist() for array in series.leaves.values()
    ]

    def make(row: int) -> dict[str, Any]:
        message: dict[str, Any] = {}
        for (words, values), finite in zip(columns, good, strict=True):
            if finite[row]:
                inner = message
                for word in words[:-1]:
                    inner = inner.setdefault(word, {})
                inner[words[-1]] = values[row]
        return message

    return make


def _vector(values: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))


def _turn(values: np.ndarray) -> dict[str, float]:
    return dict(zip("wxyz", values.tolist(), strict=True))


def _pose(frame: str, position: np.ndarray, attitude: np.ndarray) -> Make:
    return lambda row: {
        "frame_id": frame,
        "pose": {"position": _vector(position[row]), "orientation": _turn(attitude[row])},
    }


def _point(frame: str, position: np.ndarray) -> Make:
    return lambda row: {"frame_id": frame, "point": _vector(position[row])}


def _transform(frame: str, child: str, position: np.ndarray, attitude: np.ndarray) -> Make:
    return lambda row: {
        "parent_frame_id": frame,
        "child_frame_id": child,
        "translation": _vector(position[row]),
        "rotation": _turn(attitude[row]),
    }


def _fix(frame: str, degrees: np.ndarray, height: np.ndarray, covariance: np.ndarray | None) -> Make:
    def make(row: int) -> dict[str, Any]:
        spread = [0.0] * 9 if covariance is None else covariance[row].ravel().tolist()
        known = covariance is not None and all(map(math.isfinite, spread))
        return {
            "frame_id": frame,
            "latitude": float(degrees[row, 0]),
            "longitude": float(degrees[row, 1]),
            "altitude": float(height[row]),
            "position_covariance": spread if known else [0.0] * 9,
            "position_covariance_type": KNOWN if known else 0,
        }

    return make


__all__ = ["write_mcap"]

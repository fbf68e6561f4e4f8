"""Rerun: the streams of a run as a recording that its viewer scrubs through.

The entity `world/belief` is the pose of a stream `belief`, `paths/belief` its whole way as a line,
`earth/gps` a fix on the map, and `fields/belief/covariance` the numbers of a field as they are. What is drawn
is kept by Rerun in single precision; the numbers under `fields` are in double. The timeline is called `time`:
seconds of the flight, or a date where the stamps are of one.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.export.packages import needed
from flowgraph.data.export.places import fixes, placed
from flowgraph.data.files import put
from flowgraph.data.frames import part_words
from flowgraph.data.notes import note
from flowgraph.data.series import Series

_DATED = 10 * 365 * 86_400 * 10**9
"""Stamps beyond ten years are dates."""


def write_rerun(
    streams: Mapping[str, Series],
    file: str | Path,
    *,
    name: str = "run",
    about: Mapping[str, object] | None = None,
) -> tuple[str, ...]:
    """Write streams as a recording of Rerun.

    Args:
        streams: by name.
        file: to be written, mostly with the suffix .rrd.
        name: of the recording.
        about: shown as a text document, `about`.

    Returns:
        Notes: what is not drawn because it is not finite.

    Raises:
        MissingDependencyError: without the package rerun-sdk.
        OutputError: where the file cannot be written.
    """
    rr = needed("rerun", "a recording of Rerun", "rerun")
    recording = rr.RecordingStream("flowgraph")
    memory = recording.binary_stream()
    recording.send_recording_name(name)
    rr.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True, recording=recording)
    lines = "\n".join(f"{key}: {value}" for key, value in (about or {}).items())
    rr.log("about", rr.TextDocument(lines), static=True, recording=recording)
    last = max((int(s.time[-1]) for s in streams.values() if len(s)), default=0)
    kind = ("timestamp", "datetime64[ns]") if last > _DATED else ("duration", "timedelta64[ns]")
    notes: list[str] = []
    for stream, series in streams.items():
        if not len(series):
            continue
        entity = stream.replace(".", "/")

        def send(place: str, rows: Any, columns: Any, time: np.ndarray = series.time) -> None:
            stamps = {kind[0]: time[rows].astype(kind[1])}
            rr.send_columns(
                place, indexes=[rr.TimeColumn("time", **stamps)], columns=columns, recording=recording
            )

        lacking = _place(rr, recording, entity, series, send)
        if lacking:
            words = f"{lacking} of {len(series)} rows of {stream} are not drawn: not finite"
            notes.append(note("skipped", words))
        for field, array in series.leaves.items():
            flat = array.reshape(len(array), -1).astype(np.float64)
            shape = array.shape[1:]
            names = [".".join([field, *part_words(field, shape, at)]) for at in np.ndindex(*shape)]
            where = f"fields/{entity}/{field.replace('.', '/')}"
            rr.log(where, rr.SeriesLines(names=names), static=True, recording=recording)
            send(where, slice(None), rr.Scalars.columns(scalars=flat))
    content = memory.read(flush=True)
    recording.disconnect()
    put(file, content or b"")
    return tuple(notes)


def _place(rr: Any, recording: Any, entity: str, series: Series, send: Any) -> int:
    """Send what a stream has of a place; returns how many rows have none."""
    lacking = 0
    place = placed(series)
    if place is not None and len(place.rows):
        position = np.zeros((len(place.rows), 3)) if place.position is None else place.position
        if place.attitude is not None:
            turns = place.attitude[:, [1, 2, 3, 0]]
            send(
                f"world/{entity}", place.rows, rr.Transform3D.columns(translation=position, quaternion=turns)
            )
            rr.log(f"world/{entity}", rr.TransformAxes3D(0.3), static=True, recording=recording)
        else:
            send(f"world/{entity}", place.rows, rr.Points3D.columns(positions=position))
        if place.position is not None:
            rr.log(f"paths/{entity}", rr.LineStrips3D([position]), static=True, recording=recording)
        lacking = place.lacking
    earth = fixes(series)
    if earth is not None and len(earth.rows):
        degrees = np.degrees(np.stack([earth.latitude, earth.longitude], axis=-1))
        send(f"earth/{entity}", earth.rows, rr.GeoPoints.columns(positions=degrees))
        lacking = max(lacking, earth.lacking)
    return lacking


__all__ = ["write_rerun"]

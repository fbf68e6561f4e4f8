"""Bags of ROS 1 and ROS 2, without ROS: in all containers of `bag_file`, all messages of `bag_messages`.

Where a bag has several topics of one kind, each stream is named by its topic (/left/imu becomes left_imu),
and `topics` can name them. Topics that are passed over are named in a note. A stream is what one frame says
of one body: where a topic has several, `STREAM.frame` and `STREAM.body` choose.

The work is done by the `rosbags` library: pip install "flowgraph-filters[ros]".
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.bag_file import Bag
from flowgraph.blocks.datasets.bag_messages import KINDS, TRANSFORMS, Kind, kind_of
from flowgraph.blocks.datasets.bag_topics import named, nothing, passed_over, readable, usual, wanted
from flowgraph.blocks.datasets.shape import (
    MEASURED_NOISE,
    NOISE_SETTINGS,
    Recording,
    chosen,
    imu_noise,
    known,
    measured_noise,
    policy,
    stream_settings,
)
from flowgraph.blocks.datasets.tables import POLICIES
from flowgraph.data.notes import note
from flowgraph.errors import DataError, UnknownNameError

__all__ = ["KINDS", "SETTINGS", "load"]

_OF_A_STREAM: Mapping[str, str] = {
    "stamp": "as `stamp`, for this stream",
    "frame": "of which frame_id, where a topic has several",
    "body": "of which child_frame_id, where a topic has several",
}

SETTINGS: Mapping[str, str] = {
    "topics": "NAME:TOPIC, comma-separated: which topics to read, and their streams' names; truth is one",
    "stamp": "header (when it was measured), bag (when it was recorded), or both: true by the header, and "
    "arrived as the bag says",
    **{f"STREAM.{name}": meaning for name, meaning in _OF_A_STREAM.items()},
    **NOISE_SETTINGS,
    **MEASURED_NOISE,
    "bad_time": "messages out of order: " + ", ".join(POLICIES),
    **stream_settings("STREAM"),
}
"""The settings of `load` and what they mean. STREAM stands for the name of any."""

STAMPS = ("header", "bag", "both")
_DOWN = re.compile(r"(^|_)(ned|frd|esd)($|_)", re.IGNORECASE)
_STRANGE = 3_600 * 10**9
"""ns: stamps that are farther from a stamp of 0 were not counted from there."""


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read the topics of the `KINDS` of a bag.

    Args:
        argument: a file (.bag, .mcap, .db3), or a folder with such files or a metadata.yaml.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight` with a stream a topic. truth: the topic that `topics` calls truth. info: `topics` (by
        stream), `frames` (frame_id by stream), `bodies` (child_frame_id by stream), `absent`; with an imu
        `imu_noise`. notes: topics and values that were passed over, and what was assumed.

    Raises:
        MissingDependencyError: without the rosbags library.
        DataError: there is no such bag, it is damaged or holds none of the `KINDS`; a topic holds several
            bodies, or says that nothing was measured; topics would have one name; stamps are not set or out
            of order (topic, message), or values cannot be of the unit that ROS gives them.
        DeclarationError, UnknownNameError: for a setting, or a topic or body that is not there.
    """
    given = settings or {}
    asked = wanted(str(given["topics"]), given) if "topics" in given else None
    known(given, SETTINGS, "rosbag")
    stamp = chosen(given, "stamp", STAMPS, "rosbag")
    made = Recording(
        Path(argument).stem,
        policy(given, "rosbag"),
        kind="rosbag",
        given=given,
        clock="stamp=bag takes the clock of the recorder" if stamp != "bag" else "check the bag",
        units="mend the driver: ROS has SI units",
        place=argument,
    )
    path = Path(argument).expanduser()
    made.info.update(topics={}, frames={}, bodies={})
    with Bag(path) as bag:
        if len(bag.files) > 1:
            parts = ", ".join(f.name for f in bag.files)
            made.notes.append(note("assumed", f"the files of the folder are one recording: {parts}"))
        types = readable(bag)
        plan = named(bag, types, asked) if asked is not None else usual(bag, types)
        _of_streams(given, [name for name, _ in plan])
        for name, topic in plan:
            _read(made, bag, name, topic, types[topic], given, asked=asked is not None)
        if not made.streams and made.truth is None:
            raise nothing(bag)
        made.notes.extend(passed_over(bag, types, made.info["topics"].values()))
    _frames_apart(made)
    if any({"gyro", "rate"} & set(s.leaves) for s in made.streams.values()):
        made.info["imu_noise"] = imu_noise(given, "rosbag", made.notes)
    measured_noise(given, "rosbag", made.info)
    return made.flight()


def _of_streams(given: Mapping[str, Any], streams: Sequence[str]) -> None:
    """Refuse a setting of a stream that is not read.

    Raises:
        UnknownNameError: listing those that are.
    """
    for setting in given:
        stream, _, what = str(setting).rpartition(".")
        if what in _OF_A_STREAM and stream and stream not in streams:
            raise UnknownNameError("stream", stream, streams, path=f"rosbag.{setting}")


class _Messages(NamedTuple):
    """What a topic holds: times (ns) in the header and the bag, numbers, frame and body of each reading.

    flags: how often a value was not measured. beside: how often there is what is not read. others: how many
    readings are of frames and bodies that were not asked for.
    """

    header: list[int]
    bag: list[int]
    rows: list[list[float]]
    who: list[tuple[str, str]]
    flags: Counter[str]
    beside: Counter[str]
    others: Counter[str]


def _all(bag: Bag, topic: str, kind: str, how: Kind, only: Sequence[str | None]) -> _Messages:
    """All readings of a topic of the frame and body that were asked for (None for any)."""
    found = _Messages([], [], [], [], Counter(), Counter(), Counter())
    for time, message in bag.messages(topic, kind):
        for reading in how.parts(message):
            header = reading.header
            who = (header.frame_id.lstrip("/"), getattr(reading, "child_frame_id", "").lstrip("/"))
            if any(w is not None and w != h for w, h in zip(only, who, strict=True)):
                found.others[_pair(who)] += 1
                continue
            numbers, flags = how.read(reading)
            found.header.append(header.stamp.sec * 10**9 + header.stamp.nanosec)
            found.bag.append(time)
            found.rows.append(numbers)
            found.who.append(who)
            found.flags.update(flags)
            found.beside.update(how.beside(reading))
    return found


def _pair(who: tuple[str, str]) -> str:
    frame, body = who
    return f"{frame!r}" + (f" -> {body!r}" if body else "")


def _read(
    made: Recording,
    bag: Bag,
    name: str,
    topic: str,
    kind: str,
    given: Mapping[str, Any],
    *,
    asked: bool,
) -> None:
    """One stream, into the recording."""
    place, how = f"{bag.path}: {topic}", kind_of(kind, name)
    only = [
        str(given[key]).lstrip("/") if (key := f"{name}.{part}") in given else None
        for part in ("frame", "body")
    ]
    found = _all(bag, topic, kind, how, only)
    pairs = Counter(found.who)
    if not pairs:
        if found.others:
            missing = " -> ".join(repr(w) if w is not None else "any" for w in only)
            raise UnknownNameError("frame and body", missing, list(found.others), path=place)
        if asked:
            raise _empty(place, kind)
        return
    if len(pairs) > 1:
        if kind in TRANSFORMS and not asked and made.streams:  # a robot's tree, which nobody asked for
            text = ", ".join(_pair(p) for p in sorted(pairs))
            made.notes.append(
                note("skipped", f"{topic}: transforms of several bodies ({text}); {name}.body=... chooses")
            )
            return
        raise _several(place, name, topic, pairs)
    _measured(made, place, name, topic, how, found)
    stamp = chosen(given, f"{name}.stamp" if f"{name}.stamp" in given else "stamp", STAMPS, "rosbag")
    table = np.array(found.rows, dtype=float)
    made.add(
        name,
        place,
        _stamps(place, name, found, "bag" if stamp == "bag" else "header"),
        {field: table[:, part] for field, part in how.fields.items()},
        how.signal,
        row=lambda k: f"{place}, message {k + 1}",
        arrival=_stamps(place, name, found, "bag") if stamp == "both" and name != "truth" else None,
    )
    frame, body = found.who[0]
    made.info["topics"][name], made.info["frames"][name] = topic, frame
    if body:
        made.info["bodies"][name] = body
    _remarks(made, name, topic, kind, frame, found, asked=asked)


def _empty(place: str, kind: str) -> DataError:
    return DataError(
        "this topic holds no messages",
        path=place,
        expected=f"messages of {kind}",
        got="none",
        fix="leave it out",
    )


def _several(place: str, name: str, topic: str, pairs: Counter[tuple[str, str]]) -> DataError:
    """That a topic holds several bodies or frames, and how to choose."""
    bodies, frames = ({p[i] for p in pairs} for i in (1, 0))
    part, values = ("body", sorted(bodies)) if len(bodies) > 1 else ("frame", sorted(frames))
    return DataError(
        "one topic holds several bodies or frames",
        path=place,
        expected="one frame, and one body in it, for a stream",
        got=", ".join(f"{_pair(who)} ({n})" for who, n in pairs.items()),
        fix=f"choose: {name}.{part}={values[0]}; or a stream each, for example "
        f"topics={name}:{topic},truth:{topic} with {name}.{part}={values[0]} and truth.{part}={values[1]}",
    )


def _measured(made: Recording, place: str, name: str, topic: str, how: Kind, found: _Messages) -> None:
    """Notes on flags that say 'not measured'; an error where all messages say so.

    Raises:
        DataError: naming the field.
    """
    for flag, count in found.flags.items():
        if count == len(found.rows):
            what = "gyroscope" if "angular" in flag else "accelerometer" if "linear" in flag else "reading"
            other = {"gyroscope": "accelerometer", "accelerometer": "gyro"}.get(what)
            raise DataError(
                f"all messages of this topic say that there is no {what}",
                path=place,
                expected="a reading in some message",
                got=f"{flag}, 'not measured', in all of {count}",
                fix=f"topics={other}:{topic},... reads the other part of it"
                if other and name not in ("gyro", "accelerometer")
                else "leave the topic out, or take one that measured",
            )
        said = f"{name}: {count} of {len(found.rows)} messages of {topic} were not measured: {flag}"
        made.notes.append(note("skipped", said))


def _stamps(place: str, name: str, found: _Messages, stamp: str) -> np.ndarray:
    """The times (n,) ns of the readings.

    Raises:
        DataError: for stamps of the header that nobody set, and those beyond 64 bits.
    """
    times = found.header if stamp == "header" else found.bag
    zeros, far = times.count(0), [k for k, t in enumerate(times) if not -(2**63) <= t < 2**63]
    if far:
        raise DataError(
            "a stamp is beyond 64 bits",
            path=f"{place}, message {far[0] + 1}",
            expected="nanoseconds within 64 bits",
            got=f"{times[far[0]]} ns",
            fix=f"{name}.stamp=bag takes the times of recording" if stamp == "header" else "mend the bag",
        )
    unset = zeros > 1 or (zeros and max(map(abs, times)) > _STRANGE)
    if stamp == "header" and (unset or (len(times) > 1 and len(set(times)) == 1)):
        raise DataError(
            "the stamps of the headers are not set",
            path=f"{place}, message {times.index(0 if zeros else times[0]) + 1}",
            expected="when each message was measured",
            got=f"{zeros} of {len(times)} are 0" if zeros else f"{times[0]} ns in all {len(times)}",
            fix=f"{name}.stamp=bag takes the times of recording; stamp=bag does so for all streams",
        )
    return np.array(times, dtype=np.int64)


def _remarks(
    made: Recording, name: str, topic: str, kind: str, frame: str, found: _Messages, *, asked: bool
) -> None:
    """Notes on what a topic holds beside what was read, and on its frame."""
    for what in found.beside:
        made.notes.append(note("skipped", f"{name}: the {what} in the messages of {topic}"))
    if found.others:
        others = ", ".join(f"{who} ({n})" for who, n in sorted(found.others.items()))
        made.notes.append(note("skipped", f"{name}: others of {topic}: {others}"))
    if name == "truth" and not asked:
        made.notes.append(note("assumed", f"{topic} is the truth, by its name"))
    if "Twist" in kind:
        made.notes.append(note("assumed", f"{name}: in the axes of the world; its frame is {frame!r}"))
    if _DOWN.search(frame) and kind != "sensor_msgs/msg/Imu":
        made.notes.append(note("warning", f"{name}: its frame is {frame!r}; here the world has z up"))


def _frames_apart(made: Recording) -> None:
    """A note where positions are given in frames of several names."""
    series = {**made.streams, **({"truth": made.truth} if made.truth is not None else {})}
    frames = {n: made.info["frames"][n] for n, s in series.items() if "position" in s.leaves}
    if len({f for f in frames.values() if f}) > 1:
        text = ", ".join(f"{n} in {f!r}" for n, f in frames.items())
        made.notes.append(note("assumed", f"these frames are one: {text}"))

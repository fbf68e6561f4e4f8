"""Which topics of a bag are read, what their streams are called, and what is passed over."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from flowgraph.blocks.datasets.bag_file import Bag
from flowgraph.blocks.datasets.bag_messages import KINDS, TRANSFORMS, VELOCITIES
from flowgraph.data.notes import note
from flowgraph.errors import DataError, DeclarationError, UnknownNameError

__all__ = ["named", "nothing", "passed_over", "readable", "usual", "wanted"]


def wanted(text: str, given: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Stream and topic of each part of the setting."""
    pairs = [part.strip().partition(":") for part in text.split(",")]
    for name, colon, topic in pairs:
        if not name or not colon or not topic:
            raise DeclarationError(
                "this is no list of topics",
                path="rosbag.topics",
                expected="NAME:TOPIC, comma-separated",
                got=repr(text),
                fix="for example topics=imu:/imu0,vicon:/vicon/pose,truth:/ground_truth",
            )
    names = [name for name, _, _ in pairs]
    what = [  # one topic may be read twice where that is not the same
        (
            t,
            given.get(f"{n}.body"),
            given.get(f"{n}.frame"),
            n in ("gyro", "accelerometer", *VELOCITIES) and n,
        )
        for n, _, t in pairs
    ]
    if len({*names}) < len(names) or len({*what}) < len(what):
        raise DeclarationError(
            "a stream or topic is named twice",
            path="rosbag.topics",
            expected="each once, or another STREAM.body or STREAM.frame for each",
            got=text,
            fix="leave one of them out",
        )
    return [(name, topic) for name, _, topic in pairs]


def _listed(bag: Bag) -> dict[tuple[str, str], int]:
    """How many messages there are, by topic and type."""
    found: dict[tuple[str, str], int] = {}
    for c in bag.connections:
        found[c.topic, c.msgtype] = found.get((c.topic, c.msgtype), 0) + c.msgcount
    return found


def _text(topic: str, kind: str, count: int) -> str:
    return f"{topic} ({kind}, {count} message{'' if count == 1 else 's'})"


def nothing(bag: Bag) -> DataError:
    """That nothing in a bag can be read, and what it holds."""
    held = [_text(topic, kind, count) for (topic, kind), count in _listed(bag).items()]
    return DataError(
        "there is nothing to read in this bag",
        path=str(bag.path),
        expected="messages of " + ", ".join(KINDS),
        got=", ".join(held) or "an empty bag",
        fix="record the topics of the sensors; a Twist is read when `topics` names it",
    )


def readable(bag: Bag) -> dict[str, str]:
    """The type of message of each topic that can be read."""
    types: dict[str, list[str]] = {}
    for topic, kind in _listed(bag):
        if kind in KINDS:
            types.setdefault(topic, []).append(kind)
    for topic, kinds in types.items():
        if len(kinds) > 1:
            raise DataError(
                "one topic holds messages of several types",
                path=f"{bag.path}: {topic}",
                expected="one type a topic",
                got=", ".join(kinds),
                fix="give them topics of their own (ros2 bag convert, rosbag filter)",
            )
    return {topic: kinds[0] for topic, kinds in types.items()}


def named(bag: Bag, readable: Mapping[str, str], wanted: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """The streams that the setting names."""
    if not readable:
        raise nothing(bag)
    others = {topic: kind for topic, kind in _listed(bag) if kind not in KINDS}
    for _, topic in wanted:
        if topic not in readable and topic in others:
            raise DataError(
                "messages of this type are not read",
                path=f"{bag.path}: {topic}",
                expected="one of " + ", ".join(KINDS),
                got=others[topic],
                fix="leave the topic out, or convert its messages",
            )
        if topic not in readable:
            raise UnknownNameError("topic", topic, readable, path=str(bag.path))
    return wanted


def usual(bag: Bag, readable: Mapping[str, str]) -> list[tuple[str, str]]:
    """The streams that are read unless they are named: by kind, or by topic where a kind has several."""
    counted = any(c.msgcount for c in bag.connections)  # some recorders leave the counts out
    kinds = {
        topic: KINDS[kind]
        for topic, kind in sorted(readable.items(), key=lambda item: item[1] in TRANSFORMS)
        if not KINDS[kind].named and not topic.endswith("tf_static") and (bag.count(topic) or not counted)
    }
    posed = [t for t, k in kinds.items() if k.stream == "vicon" and readable[t] not in TRANSFORMS]
    kinds = {t: k for t, k in kinds.items() if not posed or readable[t] not in TRANSFORMS}
    if not kinds:
        raise nothing(bag)
    streams: dict[str, str] = {}
    for topic, kind in kinds.items():
        rivals = [k for k in kinds.values() if k.stream == kind.stream]
        before = [k for k in rivals if k.first] or rivals
        alone = kind in before and len(before) == 1
        name = kind.stream if alone else topic.strip("/").replace("/", "_")
        if not name or name in streams:
            raise DataError(
                "two topics would have one name" if name else "this topic has no name",
                path=f"{bag.path}: {topic}",
                expected="a name of its own for each stream",
                got=f"{name or 'nothing'!r} for {topic} and {streams.get(name, 'no other')}",
                fix=f"name them: topics=vicon:{topic}"
                + (f",truth:{streams[name]}" if name in streams else "")
                + ", and with them all others that you want",
            )
        streams[name] = topic
    return list(streams.items())


def passed_over(bag: Bag, readable: Mapping[str, str], read: Collection[str]) -> list[str]:
    """Notes on the topics that were not read."""
    notes = []
    left = {key: n for key, n in _listed(bag).items() if key[0] not in read or key[1] not in KINDS}
    named = {key for key in left if key[0] in readable and key[1] in KINDS and left[key]}
    for keys, why in ((set(left) - named, ""), (named, "; `topics` reads those that it names")):
        if keys:
            text = ", ".join(_text(*key, left[key]) for key in sorted(keys))
            notes.append(note("skipped", text + why))
    return notes

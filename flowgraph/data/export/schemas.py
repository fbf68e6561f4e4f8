"""JSON schemas of messages: those that Foxglove draws by their names, and one a signal type of ours.

Of the standard schemas, the fields that are written here are declared, under the names and with the types
that Foxglove publishes. They were chosen before the messages of ROS because they need no package of message
definitions to be read, and hold a covariance of a fix as well; who works in ROS converts them by name.
"""

from __future__ import annotations

from typing import Any

from flowgraph.types import ArrayType, StructType, Type

_NUMBER = {"type": "number"}
_TIME = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
}


def _object(title: str, properties: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


def _numbers(title: str, names: str) -> dict[str, Any]:
    return _object(title, {name: _NUMBER for name in names})


_VECTOR = _numbers("foxglove.Vector3", "xyz")
_TURN = _numbers("foxglove.Quaternion", "xyzw")

POSE = _object(
    "foxglove.PoseInFrame",
    {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "pose": _object("foxglove.Pose", {"position": _VECTOR, "orientation": _TURN}),
    },
)
"""A pose: position in m, and the turn from the body to the frame."""

POINT = _object(
    "foxglove.Point3InFrame",
    {"timestamp": _TIME, "frame_id": {"type": "string"}, "point": _numbers("foxglove.Point3", "xyz")},
)
"""A point in m."""

TRANSFORM = _object(
    "foxglove.FrameTransform",
    {
        "timestamp": _TIME,
        "parent_frame_id": {"type": "string"},
        "child_frame_id": {"type": "string"},
        "translation": _VECTOR,
        "rotation": _TURN,
    },
)
"""Where a child frame is in its parent, in m, and how it is turned."""

FIX = _object(
    "foxglove.LocationFix",
    {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "latitude": _NUMBER,
        "longitude": _NUMBER,
        "altitude": _NUMBER,
        "position_covariance": {"type": "array", "items": _NUMBER, "minItems": 9, "maxItems": 9},
        "position_covariance_type": {
            "title": "foxglove.PositionCovarianceType",
            "oneOf": [
                {"title": "UNKNOWN", "const": 0},
                {"title": "APPROXIMATED", "const": 1},
                {"title": "DIAGONAL_KNOWN", "const": 2},
                {"title": "KNOWN", "const": 3},
            ],
        },
    },
)
"""A fix on the Earth, in degrees, with its covariance east, north, up in m^2."""


def of_type(type_: Type) -> dict[str, Any]:
    """The schema of one value of a signal type, with `timestamp`; units and frames are descriptions.

    No field is required but the time: one that is not finite is left out of its message, for JSON has no
    word for it.
    """
    whole = _described(type_)
    if isinstance(type_, ArrayType):
        whole = {"type": "object", "properties": {"value": whole}}
    whole["title"] = f"flowgraph.{type_.name if isinstance(type_, StructType) else 'Value'}"
    whole["properties"] = {"timestamp": _TIME, **whole["properties"]}
    whole["required"] = ["timestamp"]
    return whole


def _described(type_: Type) -> dict[str, Any]:
    if isinstance(type_, StructType):
        return {"type": "object", "properties": {name: _described(field) for name, field in type_.fields}}
    kind = {"real": "number", "bool": "boolean"}.get(type_.dtype, "integer")
    found: dict[str, Any] = {"type": kind}
    for size in reversed(type_.shape):
        found = {"type": "array", "items": found, "minItems": size, "maxItems": size}
    said = ", ".join(word for word in (type_.unit, type_.frame) if word)
    return {**found, "description": said} if said else found


__all__ = ["FIX", "POINT", "POSE", "TRANSFORM", "of_type"]

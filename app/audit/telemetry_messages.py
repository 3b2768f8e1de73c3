"""The messages of a telemetry file that Foxglove knows by name, and `reins.Scene`, which it shows as plain data."""

from __future__ import annotations

from math import cos, isfinite, sin
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

NANOSECONDS: Final = 1_000_000_000
WORLD: Final = "world"  # the frame of the site
BASE: Final = "base"  # the frame of the robot's base, which the arm's kinematics begin in

NUMBER: Final = {"type": "number"}
STAMP: Final = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
LOG_SCHEMA: Final = {
    "title": "foxglove.Log",
    "type": "object",
    "properties": {
        "timestamp": STAMP,
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer"},
        "detail": {"type": "object"},
    },
}
POSE_SCHEMA: Final = {
    "title": "foxglove.PoseInFrame",
    "type": "object",
    "properties": {
        "timestamp": STAMP,
        "frame_id": {"type": "string"},
        "pose": {
            "type": "object",
            "properties": {
                "position": {"type": "object", "properties": dict.fromkeys("xyz", NUMBER)},
                "orientation": {"type": "object", "properties": dict.fromkeys("xyzw", NUMBER)},
            },
        },
    },
}
TRANSFORM_SCHEMA: Final = {
    "title": "foxglove.FrameTransform",
    "type": "object",
    "properties": {
        "timestamp": STAMP,
        "parent_frame_id": {"type": "string"},
        "child_frame_id": {"type": "string"},
        "translation": {"type": "object", "properties": dict.fromkeys("xyz", NUMBER)},
        "rotation": {"type": "object", "properties": dict.fromkeys("xyzw", NUMBER)},
    },
}
SCENE_SCHEMA: Final = {
    "title": "reins.Scene",
    "type": "object",
    "properties": {
        "timestamp": STAMP,
        "frame_id": {"type": "string"},
        "time_s": NUMBER,
        "people": {
            "type": "array",
            "items": {"type": "object", "properties": {"id": {"type": "integer"}, "x_m": NUMBER, "y_m": NUMBER}},
        },
        "bodies": {
            "type": "object",
            "additionalProperties": {
                "type": "array",
                "items": NUMBER,
                "description": "x, y, z in metres and qw, qx, qy, qz",
            },
        },
    },
}


def pose_of(row: Sequence[float], columns: Sequence[int | None]) -> dict[str, dict[str, float]] | None:
    """Return a row's pose as Foxglove writes one; an axis without a channel is 0. None where one is not finite."""
    axes = [0.0 if column is None else row[column] for column in columns]
    if not all(map(isfinite, axes)):
        return None
    x, y, z, yaw = axes
    return {
        "position": {"x": x, "y": y, "z": z},
        "orientation": {"x": 0.0, "y": 0.0, "z": sin(yaw / 2), "w": cos(yaw / 2)},
    }


def transform_message(at: int, base: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Return a `foxglove.FrameTransform` that says where the frame of the robot's base is."""
    frames = {"parent_frame_id": WORLD, "child_frame_id": BASE}
    return {"timestamp": stamp(at), **frames, "translation": base["position"], "rotation": base["orientation"]}


def stamp(at: int) -> dict[str, int]:
    """Return nanoseconds as Foxglove writes a time."""
    sec, nsec = divmod(at, NANOSECONDS)
    return {"sec": sec, "nsec": nsec}

"""What the flow network remembers of the place where it was trained (docs/flow-network.md, Room and Scene)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .geometry import CameraInput, Place, Turn, Vector, Viewer, centred, on_rows
from .graph import Tensor, Value, concat, for_each_row, where
from .layers import Layers, silu

_LEAST_STD = 1e-3
_FIRST_SIDES = np.array([-2.6, 2.6, -2.6, 2.6, -0.8, 2.0])
_POSE = ["x", "y", "heading_cos", "heading_sin"]
_POINT_OCTAVES, _PLACE_OCTAVES = 5, 4


class Pose(NamedTuple):
    """Where a camera stands."""

    x: Value
    y: Value
    heading: Turn

    def moved(self, yaw: Value, ahead: Value, left: Value) -> Pose:
        """After driving ahead and left, then turning."""
        way = Vector(ahead, left, 0).turned(self.heading)
        return Pose(self.x + way.ahead, self.y + way.left, self.heading.then(Turn.by(yaw)))

    def each(self, change: Callable[..., Tensor]) -> Pose:
        """With each number ``[rows, 1, 1, 1]`` changed by a function of it and its shape."""
        x, y, cos, sin = (change(number, 1, 1, 1) for number in (self.x, self.y, *self.heading))
        return Pose(x, y, Turn(cos, sin))


def pose_in(state: Tensor, channels: list[int]) -> Pose:
    """The pose in a state ``[rows, channels]``."""
    x, y, cos, sin = (state[:, channel : channel + 1].reshape(-1, 1, 1, 1) for channel in channels)
    length = np.sqrt(cos * cos + sin * sin)
    # A heading without cosine and sine counts as 0.
    is_heading = length > 0
    return Pose(x, y, Turn(where(is_heading, cos / length, 1.0), where(is_heading, sin / length, 0.0)))


def pose_channels(states: list[dict[str, Any]]) -> list[int] | None:
    """The channels of a pose, if the state has them."""
    names = [channel["name"] for channel in states]
    return [names.index(name) for name in _POSE] if all(name in names for name in _POSE) else None


class Room:
    """An upright box with learned sides."""

    def __init__(self, spec: dict[str, Any], layers: Layers, channels: list[int]) -> None:
        x, y = (spec["states"][channel] for channel in channels[:2])
        self.middle = Vector(x["mean"], y["mean"], 0.0)
        self.unit = max((x["std"] + y["std"]) / 2, _LEAST_STD)
        self.sides = (_FIRST_SIDES + 2 * layers.weights["flow.scene.room"]).reshape(3, 2)
        self.camera, self.layers, self.channels = spec["camera"], layers, channels
        self.shape = (int(spec["frame_height_px"]), int(spec["frame_width_px"]))
        self.half = (self.shape[0] // 2, self.shape[1] // 2)

    def pose_in(self, state: Tensor) -> Pose:
        return pose_in(state, self.channels)

    def _viewer(self, shape: tuple[int, int]) -> Viewer:
        return Viewer(self.camera["horizontal_fov_rad"], self.camera["tilt_down_rad"], shape)

    def _origin(self, pose: Pose, above: Value = 0.0) -> Vector:
        return Vector((pose.x - self.middle.ahead) / self.unit, (pose.y - self.middle.left) / self.unit, above / self.unit)

    def places(self, pose: Pose, before: Pose) -> Place:
        """Where the points that a camera sees from a pose were in its frame before."""
        viewer = self._viewer(self.shape)
        origin, there = self._origin(pose), self._origin(before)
        _, points, _, _ = self._hits(origin, pose, viewer)
        return viewer.project(points.plus(-there.ahead, -there.left).turned(before.heading.back()))

    def scene(self, pose: Pose) -> Value:
        """12 channels on the half grid, for the camera by which the room was learned."""
        return self._scene(self._viewer(self.half), pose, self._origin(pose))

    def scene_by(self, camera: CameraInput, pose: Pose) -> Value:
        """The same for another camera."""
        height = self.camera.get("height_m")
        above = 0.0 if height is None else camera.height - height
        return self._scene(camera.viewer(self.half), pose, self._origin(pose, above))

    def _scene(self, viewer: Viewer, pose: Pose, origin: Vector) -> Value:
        x = self._described_rays(viewer, pose, origin)
        for index, name in enumerate(("inputs", "hidden", "output")):
            x = self.layers.at_each_place(silu(x) if index else x, "flow.scene." + name)
        return x + 0.5

    def _hits(self, origin: Vector, pose: Pose, viewer: Viewer) -> tuple[Vector, Vector, list[Tensor], Tensor]:
        """Directions, points met, for each side whether it is met, and times of a view's rays."""
        directions = viewer.rays().turned(pose.heading)
        times, far = [], []
        for start, direction, sides in zip(origin, directions, self.sides):
            far.append(on_rows(direction > 0, pose.x))
            end = where(far[-1], sides[1], sides[0])
            speed = where(on_rows(np.abs(direction) < 1e-6, pose.x), 1e-6, direction)
            times.append((end - start) / speed)
        met_x = (times[0] <= times[1]) & (times[0] <= times[2])
        met_y = ~met_x & (times[1] <= times[2])
        met = [met_x, met_y, ~(met_x | met_y)]
        sides_met = [is_met & side for is_met, is_far in zip(met, far) for side in (~is_far, is_far)]
        time = np.maximum(np.minimum(np.minimum(times[0], times[1]), times[2]), 0.02)
        points = Vector(*(start + time * direction for start, direction in zip(origin, directions)))
        return directions, points, sides_met, time

    def _described_rays(self, viewer: Viewer, pose: Pose, origin: Vector) -> Tensor:
        directions, points, sides_met, time = self._hits(origin, pose, viewer)
        met = concat(points)
        octaves = (np.pi / 4 * 2.0 ** np.arange(_POINT_OCTAVES)).reshape(1, 1, -1, 1, 1, 1)
        angles = met.reshape(-1, 3, 1, 1, *self.half) * octaves
        waves = concat([np.sin(angles), np.cos(angles)], axis=3).reshape(-1, 6 * _POINT_OCTAVES, *self.half)
        rays = viewer.rays()
        level = np.maximum(np.sqrt(rays.ahead * rays.ahead + rays.left * rays.left), 1e-6)
        x, y, z = (part / level for part in directions)
        distance = time * np.sqrt(level * level + rays.up * rays.up)
        everywhere = np.zeros((1, 1, *self.half))
        rest = [origin.ahead + everywhere, origin.left + everywhere, x, y, z, origin.ahead * y - origin.left * x]
        rest += [0.25 * distance, 0.05 * distance * distance, 1 / (distance + 0.3)]
        return concat([waves, *(where(is_met, 1.0, 0.0) for is_met in sides_met), met, *rest])


class Picture:
    """The scene of a model without a room: a learned picture, which state and motion change if the camera moves."""

    def __init__(self, spec: dict[str, Any], layers: Layers) -> None:
        self.layers, self.moves = layers, "action" in spec["conditioning"]
        self.half = (int(spec["frame_height_px"]) // 2, int(spec["frame_width_px"]) // 2)
        image = layers.weights["flow.scene.image"].reshape(1, *self.half, 12)
        self.image = image.transpose(0, 3, 1, 2) + 0.5

    def scene(self, known: Tensor) -> Value:
        """12 channels on the half grid. ``known``: scaled state and motion ``[rows, numbers, 1, 1]``."""
        if not self.moves:
            return for_each_row(self.image, known)
        places = []
        for at in centred(self.half):
            angles = [np.pi / 2 * 2**octave * at for octave in range(_PLACE_OCTAVES)]
            places += [at, *(wave for angle in angles for wave in (np.sin(angle), np.cos(angle)))]
        x = concat([np.concatenate(places, 1), known + np.zeros((1, 1, *self.half))])
        for index, name in enumerate(("inputs", "hidden", "output")):
            x = self.layers.at_each_place(silu(x) if index else x, "flow.scene." + name)
        return x + self.image

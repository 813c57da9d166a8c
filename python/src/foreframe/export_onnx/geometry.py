"""Cameras, places in a frame, and sampling. Values are ``[rows or 1, 1, height, width]``, or ``[rows, 1, 1, 1]`` of a window."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .graph import Tensor, Value, clip, concat, for_each_row


class Place(NamedTuple):
    """0, 0 is the middle of the first pixel."""

    column: Value
    row: Value

    def moved(self, columns: Value, rows: Value) -> Place:
        return Place(self.column + columns, self.row + rows)

    def outside(self, shape: tuple[int, int]) -> Value:
        """How far it lies outside the frame, columns plus rows."""
        beyond = [np.maximum(np.maximum(-at, at - (side - 1)), 0) for at, side in zip(self, shape[::-1])]
        return beyond[0] + beyond[1]

    def is_near(self, shape: tuple[int, int], low: float, beyond: float) -> Value:
        """Whether column and row are from ``low`` to the side plus ``beyond``."""
        column, row = ((at >= low) & (at <= side + beyond) for at, side in zip(self, shape[::-1]))
        return column & row


class Turn(NamedTuple):
    """An angle about the vertical, counter-clockwise."""

    cos: Value
    sin: Value

    @classmethod
    def by(cls, angle: Value) -> Turn:
        return cls(np.cos(angle), np.sin(angle))

    def back(self) -> Turn:
        return Turn(self.cos, -self.sin)

    def then(self, turn: Turn) -> Turn:
        return Turn(self.cos * turn.cos - self.sin * turn.sin, self.sin * turn.cos + self.cos * turn.sin)


class Vector(NamedTuple):
    """In the axes of a robot, or of a room: x, y, up."""

    ahead: Value
    left: Value
    up: Value

    def turned(self, turn: Turn) -> Vector:
        ahead, left = turn.cos * self.ahead - turn.sin * self.left, turn.sin * self.ahead + turn.cos * self.left
        return Vector(ahead, left, self.up)

    def plus(self, ahead: Value, left: Value) -> Vector:
        return Vector(self.ahead + ahead, self.left + left, self.up)

    def times(self, factor: Value) -> Vector:
        return Vector(*(part * factor for part in self))


def own_places(shape: tuple[int, int]) -> Place:
    """Where each pixel is."""
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    return Place(columns[None, None], rows[None, None])


def centred(shape: tuple[int, int]) -> Place:
    """Columns and rows from −1 to 1."""
    places = own_places(shape)
    return Place((2 * places.column + 1) / shape[1] - 1, (2 * places.row + 1) / shape[0] - 1)


class Viewer:
    """A camera that takes frames of some shape."""

    def __init__(self, horizontal_fov: Value, tilt_down: Value, shape: tuple[int, int]) -> None:
        self.sin, self.cos = np.sin(tilt_down), np.cos(tilt_down)
        self.pixel = 2 * np.tan(horizontal_fov / 2) / shape[1]
        self.shape = shape

    def rays(self) -> Vector:
        """The ray of each pixel, 1 long along the camera's axis."""
        places = own_places(self.shape).moved(0.5 - self.shape[1] / 2, 0.5 - self.shape[0] / 2)
        right, down = places.column * self.pixel, places.row * self.pixel
        return Vector(self.cos - down * self.sin, -right, -self.sin - down * self.cos)

    def depth(self, points: Vector) -> Value:
        return np.maximum(self.cos * points.ahead - self.sin * points.up, 1e-3)

    def project(self, points: Vector) -> Place:
        scale = self.depth(points) * self.pixel
        down = self.sin * points.ahead + self.cos * points.up
        return Place((self.shape[1] - 1) / 2 - points.left / scale, (self.shape[0] - 1) / 2 - down / scale)

    def turned(self, yaw: Value) -> Place:
        """Where each pixel's ray was before the camera turned."""
        return self.project(self.rays().turned(Turn.by(yaw)))


class CameraInput(NamedTuple):
    """Field of view, tilt and height ``[rows, 1, 1, 1]``."""

    horizontal_fov: Tensor
    tilt_down: Tensor
    height: Tensor

    def viewer(self, shape: tuple[int, int]) -> Viewer:
        return Viewer(self.horizontal_fov, self.tilt_down, shape)


def sample(image: Tensor, place: Place, shape: tuple[int, int]) -> Tensor:
    """Bilinear, from an image of this shape; beyond the border, the border's pixel counts."""
    sides = zip(place, shape[::-1])
    grid = concat([on_rows(clip(at, 0, side - 1) * (2 / (side - 1)) - 1, image) for at, side in sides])
    last = image.graph.node("Transpose", grid, perm=[0, 2, 3, 1])
    return image.graph.node("GridSample", image, last, mode="bilinear", padding_mode="border", align_corners=1)


def on_rows(value: Value, like: Tensor) -> Tensor:
    """The value itself, or a constant for each row of a tensor."""
    return value if isinstance(value, Tensor) else for_each_row(value, like)

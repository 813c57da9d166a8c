"""The form of the flow network that estimates depth (docs/flow-network.md, Depth form)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .flow import FlowLayers, quarter_places
from .geometry import CameraInput, Place, Turn, Vector, Viewer, centred, sample
from .graph import Graph, Tensor, Value, clip, concat, for_each_row, mean, where
from .inputs import Inputs
from .layers import block_mean, limited, shuffle, silu, unshuffle
from .model_directory import ModelDirectory
from .motion import Motion, speed_channels
from .scene import Room, pose_channels, pose_in

_WALL_M, _FARTHER, _LEAST_SPREAD = 2.2, 1.25, 0.04
_DEPTH_ROUNDS = 3


class _View(NamedTuple):
    """The last frames with what is known of them; of windows, or of their steps."""

    camera: CameraInput
    frame: Tensor
    coarse: Tensor
    depth: Tensor
    #: Column, row and mean inverse first depth of each 2×2 block.
    block_values: Tensor


class _Levels(NamedTuple):
    """Mean and standard deviation of the last frames ``[rows, 1, 1, 1]``."""

    mean: Tensor
    spread: Tensor


class DepthNetwork(FlowLayers):
    """Frames are normalized with the last frame's mean and standard deviation."""

    def __init__(self, model: ModelDirectory) -> None:
        super().__init__(model)
        self.pose_channels = pose_channels(self.states)
        self.read_states = [channel for channel in self.read_states if channel not in (self.pose_channels or [])]
        remembers = self.sizes.get("memory", False)
        self.room = Room(self.spec, self.layers, self.pose_channels) if remembers and self.pose_channels else None

    def add_window(self, graph: Graph) -> None:
        """All frames of the context in; the predicted frames, the last one's depth and the movers out."""
        frames, inputs = self.frames_input(graph), Inputs(graph, self.spec)
        given = graph.input("camera", ["batch", 3], "horizontal field of view (rad), tilt down (rad), height (m)")
        camera = CameraInput(*(given[:, part : part + 1].reshape(-1, 1, 1, 1) for part in range(3)))
        level = mean(frames[0], [1, 2, 3])
        spread = np.maximum(np.sqrt(mean((frames[0] - level) * (frames[0] - level), [1, 2, 3])), _LEAST_SPREAD)
        levels = _Levels(level, spread)
        view = self._view([(frame - level) / spread for frame in frames], camera, inputs, levels)
        state = self.scaled_state(inputs.state)
        actions = None if inputs.actions is None else limited(inputs.actions, self.spec["actions"])
        motion = None if actions is None else Motion(self.spec, self.layers)(actions, inputs.state, state)
        modulation = self.modulation(range(self.horizon), state, actions, motion, view.frame)
        moved = for_each_row(np.zeros((1, self.horizon, 3)), view.frame) if motion is None else motion
        remembered = self._remembered_ahead(inputs, camera, moved.reshape(-1, 3, 1, 1), levels)
        drawn, z = self._steps(view, moved.reshape(-1, 3, 1, 1), modulation, remembered)
        drawn = drawn.reshape(-1, self.horizon, *self.shape)
        self.frames_output(graph, clip(drawn * spread + level, 0, 1))
        graph.output("depth", view.depth.reshape(-1, *self.shape), ["batch", *self.shape], "of the last frame, in metres")
        if self.sizes.get("movers", False):
            coming = self._movers(z, "coming").reshape(-1, self.horizon, *self.shape)
            movers = concat([self._movers(view.coarse, "seen"), coming])
            about = "in the last frame and the next ones, logits: above 0 a pixel is more likely a mover's than not"
            graph.output("movers", movers, ["batch", 1 + self.horizon, *self.shape], about)

    def _view(self, frames: list[Tensor], camera: CameraInput, inputs: Inputs, levels: _Levels) -> _View:
        """The last frame, encoded with its depth from how the earlier ones differ."""
        viewer = camera.viewer(self.shape)
        first_depth = _first_depth(viewer, camera.height)
        block_values = concat([*centred(self.half), block_mean(1 / first_depth)])
        blocks, shifts = [unshuffle(frames[0])], []
        for back, earlier in enumerate(frames[1:], 1):
            places, shift = self._moved_back(self._motion_back(inputs, back), viewer, first_depth)
            is_inside = places.is_near(self.shape, -0.5, -0.5)
            blocks.append(unshuffle(where(is_inside, sample(earlier, places, self.shape), frames[0])))
            shifts += shift
        seen = self.layers.conv3(concat([*blocks, *shifts, block_values]), "flow.stem")
        if self.room and inputs.state is not None:
            now = self._counted(self.room.scene_by(camera, self.room.pose_in(inputs.state)), levels)
            seen = seen + self.layers.conv3(now[:, 8:], "flow.memory.seen")
        first = silu(seen)
        coarse = self.encoded(first)
        enlarged = silu(shuffle(self.layers.at_each_place(silu(coarse), "flow.depth.enlarge")))
        logarithm = shuffle(self.layers.conv3(concat([enlarged, first]), "flow.depth.output"))
        return _View(camera, frames[0], coarse, first_depth * np.exp(1.5 * np.tanh(logarithm)), block_values)

    def _counted(self, scene: Value, levels: _Levels) -> Tensor:
        """Features of the scene, then its content counted as the frames are."""
        return concat([scene[:, :8], (scene[:, 8:] - levels.mean) / levels.spread])

    def _remembered_ahead(self, inputs: Inputs, camera: CameraInput, motion: Tensor, levels: _Levels) -> Value:
        """What is remembered of the room at each step; None for a model without a memory."""
        if not self.room or inputs.state is None:
            return None
        before = self.room.pose_in(inputs.state).each(self.for_each_step)
        pose = before.moved(*(motion[:, part : part + 1] for part in range(3)))
        levels = _Levels(*(self.for_each_step(level, 1, 1, 1) for level in levels))
        return self._counted(self.room.scene_by(self._camera_ahead(camera), pose), levels)

    def _camera_ahead(self, camera: CameraInput) -> CameraInput:
        return CameraInput(*(self.for_each_step(number, 1, 1, 1) for number in camera))

    def _motion_back(self, inputs: Inputs, back: int) -> tuple[Turn, Value, Value]:
        """Where the camera stood at an earlier frame, as seen from the last one: turn, ahead, left."""
        back = min(back, int(self.spec["context"]) - 1)
        if inputs.states is not None and self.pose_channels:
            here, there = (pose_in(inputs.states[:, -1 - frame], self.pose_channels) for frame in (0, back))
            turned = Vector(there.x - here.x, there.y - here.y, 0.0).turned(here.heading.back())
            return there.heading.then(here.heading.back()), turned.ahead, turned.left
        speeds = [channel for channel in speed_channels(self.states) if channel is not None]
        if inputs.state is None or len(speeds) < 2:
            return Turn(1.0, 0.0), 0.0, 0.0
        forward, rate = (inputs.state[:, channel : channel + 1].reshape(-1, 1, 1, 1) for channel in speeds)
        time = -self.spec["frame_period_s"] * back
        way, half = forward * time, rate * (time / 2)
        return Turn.by(rate * time), way * np.cos(half), way * np.sin(half)

    def _moved_back(self, motion: tuple[Turn, Value, Value], viewer: Viewer, depth: Value) -> tuple[Place, list[Tensor]]:
        """Where pixels were in an earlier frame, and how far each block shifts if everything is farther away."""
        turn, ahead, left = motion
        near, far = (
            viewer.project(viewer.rays().times(times * depth).plus(-ahead, -left).turned(turn.back())) for times in (1, _FARTHER)
        )
        # The sum of the four pixels of a block.
        return near, [4 * block_mean(clip((b - a) / 4, -4, 4) / 4) for a, b in zip(near, far)]

    def _steps(self, view: _View, motion: Tensor, modulation: Tensor, remembered: Value) -> tuple[Tensor, Tensor]:
        """The frames of all steps at once, and their states. Each window has a row for each step."""
        rows = self.for_each_step
        viewer = self._camera_ahead(view.camera).viewer(self.shape)
        last, depth = rows(view.frame, 1, *self.shape), rows(view.depth, 1, *self.shape)
        coarse, block_values = rows(view.coarse, self.channels, *self.quarter), rows(view.block_values, 3, *self.half)
        yaw, ahead, left = (motion[:, part : part + 1] for part in range(3))
        directions = viewer.rays().turned(Turn.by(yaw))
        turned = viewer.project(directions)
        guess: Value = sample(depth, turned, self.shape)
        for _ in range(_DEPTH_ROUNDS):
            points = directions.times(guess).plus(ahead, left)
            found = sample(depth, viewer.project(points), self.shape)
            guess = guess * clip(found / viewer.depth(points), 0.5, 2)
        room = viewer.project(directions.times(guess).plus(ahead, left))
        places = quarter_places(room)
        is_seen = where(places.is_near(self.quarter, -0.5, -0.5), 1.0, 0.0)
        mixed = concat([self.warped(coarse, places), block_values[:, :, ::2, ::2], is_seen])
        z = self.refined(self.layers.at_each_place(mixed, "flow.mix"), modulation)
        upper_left = Place(*(at[:, :, ::2, ::2] for at in room))
        far = np.minimum(upper_left.outside(self.shape) / 8, 4)
        beside = concat([block_values, 1 / np.maximum(guess[:, :, ::2, ::2], 0.05), far])
        return self.drawn(z, last, beside, 0.0, room, turned, remembered), z

    def _movers(self, z: Tensor, name: str) -> Tensor:
        return shuffle(shuffle(self.layers.at_each_place(silu(z), "flow.movers." + name)))


def _first_depth(viewer: Viewer, height: Value) -> Value:
    """Of each pixel, as if there were only the floor and a wall around the camera."""
    rays = viewer.rays()
    level = np.sqrt(rays.ahead * rays.ahead + rays.left * rays.left)
    # Above the horizon, the floor is farther than any wall.
    return np.minimum(_WALL_M / np.maximum(level, 1e-3), height / np.maximum(-rays.up, 1e-9))

"""The flow network (docs/flow-network.md): the form that knows its place, and the recurrent form."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .geometry import Place, Viewer, centred, own_places, sample
from .graph import Graph, Tensor, Value, clip, concat, for_each_row, repeated, total, where
from .inputs import Inputs
from .layers import Layers, block_mean, limited, scaled, shuffle, silu, unshuffle
from .model_directory import ModelDirectory
from .motion import Motion, speed_channels
from .scene import Picture, Pose, Room, pose_channels

#: Pixels that a unit of the head's output moves.
_REACH_PX = 4


class FlowLayers:
    """The layers and the sizes that all forms have in common."""

    def __init__(self, model: ModelDirectory) -> None:
        self.spec: dict[str, Any] = model.spec
        self.sizes: dict[str, Any] = model.spec["flow"]
        self.layers = Layers(model.weights)
        self.shape = (int(self.spec["frame_height_px"]), int(self.spec["frame_width_px"]))
        self.half, self.quarter = ((self.shape[0] // n, self.shape[1] // n) for n in (2, 4))
        self.horizon, self.channels = int(self.spec["horizon"]), int(self.sizes["channels"])
        self.moves = "action" in self.spec["conditioning"]
        self.states: list[dict[str, Any]] = self.spec["states"] if "state" in self.spec["conditioning"] else []
        #: The channels that the layers read.
        self.read_states = list(range(len(self.states)))

    def scaled_state(self, state: Tensor | None) -> Value:
        if state is None or not self.read_states:
            return None
        read = state.graph.node("Gather", state, np.array(self.read_states), axis=1)
        return scaled(read, [self.states[channel] for channel in self.read_states])

    def frames_input(self, graph: Graph) -> list[Tensor]:
        """The frames of the context, each ``[batch, 1, height, width]``, latest first, as many as are read."""
        context = int(self.spec["context"])
        frames = graph.input("frames", ["batch", context, *self.shape], "oldest first, 0 to 1")
        latest_first = [max(context - 1 - back, 0) for back in range(self.sizes.get("frames_read", 3))]
        return [frames[:, at].reshape(-1, 1, *self.shape) for at in latest_first]

    def frames_output(self, graph: Graph, frames: Tensor) -> None:
        whole = frames.reshape(-1, self.horizon, *self.shape)
        graph.output("predicted", whole, ["batch", self.horizon, *self.shape], "the next frames, 0 to 1")

    def for_each_step(self, x: Tensor, *shape: int) -> Tensor:
        """Each window's row once for each predicted step."""
        return repeated(x, self.horizon, shape)

    def encoded(self, first: Tensor) -> Tensor:
        x = self.layers.conv3(first, "flow.halving", stride=2)
        for block in range(self.sizes["encoder_blocks"]):
            name = f"flow.encoder.{block}"
            inner = self.layers.conv3(silu(x), name + ".first", dilation=1 << (block % 3))
            x = x + self.layers.conv3(silu(inner), name + ".second")
        return x

    def modulation(
        self, steps: range, state: Tensor | None, actions: Tensor | None, motion: Tensor | None, like: Tensor
    ) -> Value:
        """Scales and shifts of these steps ``[batch · steps, numbers, 1, 1]``. State: scaled; motion: ``[batch, horizon, 3]``."""
        known: list[Value] = []
        if state is not None:
            known.append(state.reshape(-1, 1, len(self.read_states)) + np.zeros((1, len(steps), 1)))
        if actions is not None:
            taken = scaled(actions, self.spec["actions"]).reshape(-1, 1, self.horizon * len(self.spec["actions"]))
            known.append(taken * np.tri(self.horizon).repeat(len(self.spec["actions"]), axis=1))
        known.append(for_each_row(np.eye(self.horizon)[None, steps.start : steps.stop], like))
        if motion is not None:
            known.append(motion)
        hidden = silu(self.layers.dense(concat(known, axis=2), "flow.modulation.inputs"))
        numbers = 4 * self.channels * self.sizes["decoder_blocks"]
        return self.layers.dense(hidden, "flow.modulation.output").reshape(-1, numbers, 1, 1)

    def refined(self, z: Tensor, modulation: Tensor) -> Tensor:
        for block in range(self.sizes["decoder_blocks"]):
            inner = z
            for part, name in enumerate(("first", "second")):
                at = (2 * block + part) * 2 * self.channels
                scale = modulation[:, at : at + self.channels]
                shift = modulation[:, at + self.channels : at + 2 * self.channels]
                inner = self.layers.conv3(silu(inner * (1 + scale) + shift), f"flow.decoder.{block}.{name}")
            z = z + inner
        return z

    def drawn(
        self, z: Tensor, last: Tensor, beside: Tensor, content: Value, room: Place, turned: Place, remembered: Value = None
    ) -> Tensor:
        """The frame of a state: pixels of the last frame, moved in two ways, content, and what is remembered."""
        layers, moved = self.layers, self.sampled(last, room)
        enlarged = shuffle(layers.at_each_place(silu(z), "flow.enlarge"))
        share = block_mean(inside(room.outside(self.shape), last))
        fine = layers.conv3(concat([enlarged, unshuffle(moved), share, beside]), "flow.fine")
        if remembered is not None:
            fine = fine + layers.conv3(remembered, "flow.memory.fine")
        fine = silu(fine)
        head = shuffle(layers.conv3(fine, "flow.head"))
        part = [head[:, index : index + 1] for index in range(8)]
        values = [
            sample(last, room.moved(_REACH_PX * part[0], _REACH_PX * part[1]), self.shape),
            sample(last, turned.moved(_REACH_PX * part[2], _REACH_PX * part[3]), self.shape),
            content + part[7],
        ]
        lost = [np.minimum(2 * place.outside(self.shape), 8) for place in (room, turned)]
        logits = concat([part[4] + 1.5 - lost[0], part[5] - lost[1], part[6]])
        drawn: Tensor = total(concat(values) * logits.graph.node("Softmax", logits, axis=1), 1)
        if remembered is not None:
            share = shuffle(layers.conv3(fine, "flow.memory.share"))
            drawn = drawn + (shuffle(remembered[:, 8:]) - drawn) / (1 + np.exp(3 - share))
        return drawn

    def sampled(self, image: Tensor, place: Place) -> Tensor:
        """The image at places. Those that are constant are the pixels' own."""
        return sample(image, place, self.shape) if isinstance(place.column, Tensor) else image

    def warped(self, coarse: Tensor, places: Place) -> Tensor:
        """The encoder's state at places of the quarter grid; zero more than a pixel outside."""
        if not isinstance(places.column, Tensor):
            return coarse
        return where(places.is_near(self.quarter, -1, 0), sample(coarse, places, self.quarter), 0.0)


def inside(outside: Value, like: Tensor) -> Tensor:
    """1 where the distance to the frame is 0, else 0."""
    if isinstance(outside, Tensor):
        return where(outside <= 0, 1.0, 0.0)
    return for_each_row((outside <= 0).astype(np.float32), like)


def quarter_places(places: Place) -> Place:
    """The places of the quarter grid: the mean of the four middle pixels of each 4×4 block."""
    return Place(*((block_mean(at[:, :, 1:-1, 1:-1], stride=4) - 1.5) / 4 for at in places))


class _Window(NamedTuple):
    """What is known of the windows; None where the model takes none."""

    last: Tensor
    pose: Pose | None
    #: Scaled.
    state: Tensor | None
    actions: Tensor | None
    #: ``[batch, horizon, 3]``.
    motion: Tensor | None


class FlowNetwork(FlowLayers):
    """The form that remembers the place where it was trained."""

    def __init__(self, model: ModelDirectory) -> None:
        super().__init__(model)
        self.camera: dict[str, float] | None = self.spec.get("camera")
        channels = pose_channels(self.states)
        self.room = Room(self.spec, self.layers, channels) if channels and self.moves and self.camera else None
        self.picture = None if self.room else Picture(self.spec, self.layers)

    def add_window(self, graph: Graph) -> None:
        """All frames of the context in, the predicted frames out."""
        frames, inputs = self.frames_input(graph), Inputs(graph, self.spec)
        actions = None if inputs.actions is None else limited(inputs.actions, self.spec["actions"])
        state = None if inputs.state is None else limited(inputs.state, self.states)
        scaled_state = self.scaled_state(state)
        motion = None if actions is None else Motion(self.spec, self.layers)(actions, state, scaled_state)
        pose = self.room.pose_in(state) if self.room and state is not None else None
        window = _Window(frames[0], pose, scaled_state, actions, motion)
        scene = self._scene(pose, self._known(window._replace(motion=None)))
        coarse = self._encoded(frames, scene[:, 8:], state)
        predict = self._recurrent_steps if self.sizes.get("recurrent", False) else self._steps
        self.frames_output(graph, predict(window, coarse, scene))

    def _known(self, window: _Window) -> Tensor:
        """What changes the picture of the scene: scaled state and motion, which is 0 at the last frame."""
        steps = 1 if window.motion is None else self.horizon
        known = [] if window.state is None else [window.state.reshape(-1, 1, len(self.read_states)) + np.zeros((1, steps, 1))]
        known.append(for_each_row(np.zeros((1, 1, 3)), window.last) if window.motion is None else window.motion)
        return concat(known, axis=2).reshape(-1, len(self.read_states) + 3, 1, 1)

    def _scene(self, pose: Pose | None, known: Tensor) -> Value:
        if self.room and pose:
            return self.room.scene(pose)
        assert self.picture
        return self.picture.scene(known)

    def _viewer(self, camera: dict[str, float], shape: tuple[int, int]) -> Viewer:
        return Viewer(camera["horizontal_fov_rad"], camera["tilt_down_rad"], shape)

    def _encoded(self, frames: list[Tensor], content: Tensor, state: Tensor | None) -> Tensor:
        _, rate = speed_channels(self.states)
        blocks = []
        for back, frame in enumerate(frames):
            if back and rate is not None and state is not None and self.camera:
                turn = state[:, rate : rate + 1].reshape(-1, 1, 1, 1) * (self.spec["frame_period_s"] * back)
                frame = sample(frame, self._viewer(self.camera, self.shape).turned(turn), self.shape)
            blocks.append(unshuffle(frame))
        return self.encoded(silu(self.layers.conv3(concat([*blocks, content, *centred(self.half)]), "flow.stem")))

    def _steps(self, window: _Window, coarse: Tensor, scene: Tensor) -> Value:
        """All steps at once: each window has a row for each step."""
        last, coarse = self.for_each_step(window.last, 1, *self.shape), self.for_each_step(coarse, self.channels, *self.quarter)
        turned, places = own_places(self.shape), own_places(self.quarter)
        room = turned
        if window.motion is None:
            scene = self.for_each_step(scene, 12, *self.half)
        else:
            motion = window.motion.reshape(-1, 3, 1, 1)
            turned, places = self._turned(motion)
            room, pose = turned, None
            if self.room and window.pose:
                before = window.pose.each(self.for_each_step)
                pose = before.moved(*(motion[:, part : part + 1] for part in range(3)))
                room = self.room.places(pose, before)
            scene = self._scene(pose, self._known(window))
        mixed = concat([self.warped(coarse, places), unshuffle(scene[:, :8])])
        z = self.layers.at_each_place(mixed, "flow.mix")
        z = self.refined(z, self.modulation(range(self.horizon), window.state, window.actions, window.motion, window.last))
        return clip(self.drawn(z, last, scene, shuffle(scene[:, 8:]), room, turned), 0, 1)

    def _recurrent_steps(self, window: _Window, z: Tensor, scene: Tensor) -> Tensor:
        """Each step continues from the state and the frame of the step before."""
        last, own, predicted = window.last, own_places(self.shape), []
        for step in range(self.horizon):
            inputs = concat([z, unshuffle(scene[:, :8]), unshuffle(unshuffle(last))])
            z = z + self.layers.at_each_place(inputs, "flow.advance")
            z = self.refined(z, self.modulation(range(step, step + 1), window.state, None, None, window.last))
            last = clip(self.drawn(z, last, scene, shuffle(scene[:, 8:]), own, own), 0, 1)
            predicted.append(last)
        return concat(predicted)

    def _turned(self, motion: Tensor) -> tuple[Place, Place]:
        """The turned places of pixels and of the quarter grid."""
        if self.camera:
            yaw = motion[:, 0:1]
            turned, places = (self._viewer(self.camera, shape).turned(yaw) for shape in (self.shape, self.quarter))
            return turned, places
        places, (height, width) = own_places(self.shape), self.shape
        matrix = (0.25 * self.layers.dense(motion.reshape(-1, 3), "flow.affine")).reshape(-1, 6, 1, 1)
        basis = (places.column / width * 2 - 1, places.row / height * 2 - 1, 1.0)
        by_column, by_row = (
            sum(part * matrix[:, 2 * row + side : 2 * row + side + 1] for row, part in enumerate(basis)) for side in (0, 1)
        )
        turned = places.moved(by_column * width, by_row * height)
        return turned, quarter_places(turned)

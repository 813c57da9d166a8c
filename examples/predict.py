#!/usr/bin/env python3
"""Predicts the frames that follow those in a directory, in NumPy alone: the whole forward pass of the networks.

Usage: predict.py --model models/moving --frames examples/frames --actions examples/frames/actions.json --at 4 --out predicted

Needs numpy and pillow. docs/dense-network.md, docs/flow-network.md and docs/sprite-network.md specify what is computed here. With --server URL, a
server is asked too, and each of its pixels must agree within one gray level.
"""

import argparse
import base64
import io
import json
import re
import struct
import sys
import urllib.request
from pathlib import Path

import numpy as np
from PIL import Image

LEAST_STD = 1e-3


def read_model(directory):
    """The manifest, and the tensors of the safetensors file as float32."""
    manifest = json.loads((directory / "manifest.json").read_text())
    data = (directory / "model.safetensors").read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    tensors = {}
    for name, entry in header.items():
        if name == "__metadata__":
            continue
        first, last = entry["data_offsets"]
        kind = {"F16": np.float16, "F32": np.float32}[entry["dtype"]]
        values = np.frombuffer(data[8 + length + first : 8 + length + last], kind)
        tensors[name] = values.reshape(entry["shape"]).astype(np.float32)
    return manifest, tensors


def scaled(values, channels):
    """(value − mean) / std along the last axis; a std below the least counts as the least."""
    mean = np.array([channel["mean"] for channel in channels], np.float32)
    std = np.array([max(channel["std"], LEAST_STD) for channel in channels], np.float32)
    return (np.asarray(values, np.float32).reshape(-1, len(channels)) - mean) / std


def limited(values, channels):
    """At most a million standard deviations from the mean."""
    mean = np.array([channel["mean"] for channel in channels], np.float32)
    most = 1e6 * np.array([max(channel["std"], LEAST_STD) for channel in channels], np.float32)
    return np.clip(np.asarray(values, np.float32).reshape(-1, len(channels)), mean - most, mean + most)


def dense(x, tensors, name):
    return x @ tensors[name + ".weight"] + tensors[name + ".bias"]


# The dense network.


def smoothed(image, sigma):
    """Gaussian smoothing; beyond the edges, the edge's pixels repeat."""
    if sigma <= 0:
        return image
    radius = int(np.ceil(3 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    kernel = (kernel / kernel.sum()).astype(np.float32)
    for axis in (1, 0):
        width = [(radius, radius) if at == axis else (0, 0) for at in (0, 1)]
        padded = np.pad(image, width, mode="edge")
        size = image.shape[axis]
        image = sum(w * padded.take(range(tap, tap + size), axis) for tap, w in enumerate(kernel))
    return image


def sigmoid(x):
    return 1 / (1 + np.exp(-np.clip(x, -87, 87)))


def lstm_step(x, h, c, tensors, name):
    """One step of the cell with peepholes; gate order i, f, c, o."""
    sums = x @ tensors[name + ".w_x"] + h @ tensors[name + ".w_h"] + tensors[name + ".bias"]
    i, f, g, o = np.split(sums, 4)
    i = sigmoid(i + tensors[name + ".peephole_i"] * c)
    f = sigmoid(f + tensors[name + ".peephole_f"] * c)
    c = f * c + i * np.tanh(g)
    o = sigmoid(o + tensors[name + ".peephole_o"] * c)
    return o * np.tanh(c), c


def predict_dense(spec, tensors, frames, actions, state):
    sigma, invert = spec["preprocess"]["blur_sigma_px"], spec["preprocess"]["invert"]
    size = (spec["frame_height_px"], spec["frame_width_px"])
    h = c = np.zeros(spec["hidden"], np.float32)
    for frame in frames:
        values = smoothed(frame, sigma)
        values = 1 - values if invert else values
        features = np.tanh(dense(values.reshape(-1), tensors, "frame_encoder"))
        h, c = lstm_step(features, h, c, tensors, "encoder")
    known_state = scaled(state, spec["states"])[0] if "state" in spec["conditioning"] else []
    predicted = []
    for step in range(spec["horizon"]):
        action = scaled(actions, spec["actions"])[step] if "action" in spec["conditioning"] else []
        inputs = np.concatenate([features, action, known_state]).astype(np.float32)
        h, c = lstm_step(inputs, h, c, tensors, "predictor")
        output = dense(h, tensors, "predictor.output")
        features = output if spec.get("predictor_output") == "absolute" else features + output
        values = np.clip(dense(features, tensors, "frame_decoder"), 0, 1).reshape(size)
        predicted.append(1 - values if invert else values)
    return predicted


# The flow network. A grid is [height, width, channels]; a place is a column and a row.


def silu(x):
    return x * sigmoid(x)


def conv3(x, tensors, name, stride=1, dilation=1):
    height, width, _ = x.shape
    padded = np.pad(x, [(dilation, dilation), (dilation, dilation), (0, 0)])
    taps = [
        padded[row * dilation : row * dilation + height : stride, column * dilation : column * dilation + width : stride]
        for row in range(3)
        for column in range(3)
    ]
    return dense(np.concatenate(taps, 2), tensors, name)


def shuffle(x):
    """Four groups of channels to the four places of each 2×2 block."""
    height, width, channels = x.shape
    blocks = x.reshape(height, width, 2, 2, channels // 4)
    return blocks.transpose(0, 2, 1, 3, 4).reshape(2 * height, 2 * width, channels // 4)


def unshuffle(x):
    height, width, channels = x.shape
    blocks = x.reshape(height // 2, 2, width // 2, 2, channels)
    return blocks.transpose(0, 2, 1, 3, 4).reshape(height // 2, width // 2, 4 * channels)


def sample(image, places):
    """Bilinear; beyond the border, the border's pixel counts. The image has channels or none."""
    height, width = image.shape[:2]
    x, y = np.clip(places[..., 0], 0, width - 1), np.clip(places[..., 1], 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    right, lower = x - left, y - top
    if image.ndim == 3:
        right, lower = right[..., None], lower[..., None]
    upper_value = image[top, left] * (1 - right) + image[top, left + 1] * right
    lower_value = image[top + 1, left] * (1 - right) + image[top + 1, left + 1] * right
    return upper_value * (1 - lower) + lower_value * lower


def outside(places, shape):
    """How far places lie outside the frame, columns plus rows."""
    x, y = places[..., 0], places[..., 1]
    beyond = lambda at, side: np.maximum(np.maximum(-at, at - (side - 1)), 0)
    return beyond(x, shape[1]) + beyond(y, shape[0])


def centred(count):
    return (2 * np.arange(count, dtype=np.float32) + 1) / count - 1


def own_places(shape):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.stack([columns, rows], 2).astype(np.float32)


class Viewer:
    """A camera that takes frames of some shape (height, width)."""

    def __init__(self, camera, shape):
        self.sin, self.cos = np.sin(camera["tilt_down_rad"]), np.cos(camera["tilt_down_rad"])
        self.pixel = 2 * np.tan(camera["horizontal_fov_rad"] / 2) / shape[1]
        self.shape = shape

    def rays(self):
        places = own_places(self.shape) + 0.5 - np.array([self.shape[1] / 2, self.shape[0] / 2])
        right, down = places[..., 0] * self.pixel, places[..., 1] * self.pixel
        return np.stack([self.cos - down * self.sin, -right, -self.sin - down * self.cos], 2)

    def project(self, points):
        ahead, left, up = points[..., 0], points[..., 1], points[..., 2]
        depth = np.maximum(self.cos * ahead - self.sin * up, 1e-3)
        down = -(self.sin * ahead + self.cos * up)
        column = (self.shape[1] - 1) / 2 - left / (depth * self.pixel)
        return np.stack([column, (self.shape[0] - 1) / 2 + down / (depth * self.pixel)], -1)

    def turned(self, yaw):
        return self.project(rotated(self.rays(), yaw))


def rotated(vectors, angle):
    sin, cos = np.sin(angle), np.cos(angle)
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], -1)


def moved(pose, motion):
    """A pose (x, y, heading) after driving ahead and left, then turning."""
    (x, y, heading), (yaw, ahead, left) = pose, motion
    sin, cos = np.sin(heading), np.cos(heading)
    return (x + cos * ahead - sin * left, y + sin * ahead + cos * left, heading + yaw)


class FlowNetwork:
    def __init__(self, spec, tensors):
        self.spec, self.tensors, self.camera = spec, tensors, spec.get("camera")
        self.shape = (spec["frame_height_px"], spec["frame_width_px"])
        self.half, self.quarter = ((self.shape[0] // n, self.shape[1] // n) for n in (2, 4))
        self.moves = "action" in spec["conditioning"]
        self.states = spec["states"] if "state" in spec["conditioning"] else []
        named = {channel["name"]: place for place, channel in enumerate(self.states)}
        pose = ["x", "y", "heading_cos", "heading_sin"]
        self.pose_channels = [named[name] for name in pose] if all(name in named for name in pose) else None
        self.has_room = bool(self.moves and self.camera and self.pose_channels)

    def pose_in(self, state):
        if self.pose_channels is None:
            return (0.0, 0.0, 0.0)
        x, y, cos, sin = (state[place] for place in self.pose_channels)
        return (x, y, np.arctan2(sin, cos))

    def by_unit(self, channels):
        """The first channel of each speed's unit."""
        places = {channel["unit"]: place for place, channel in reversed(list(enumerate(channels)))}
        return [places.get("m/s"), places.get("rad/s")]

    def motions(self, state, actions):
        """Yaw, ahead and left of each step since the last frame."""
        horizon = self.spec["horizon"]
        if not self.moves:
            return np.zeros((horizon, 3), np.float32)
        period = self.spec["frame_period_s"]
        commanded = self.by_unit(self.spec["actions"])
        measured = self.by_unit(self.states)
        before = [None if place is None else state[place] for place in measured]
        drive = self.tensors.get("flow.motion.drive", np.zeros(2))
        half_track, acceleration = np.array([0.15, 2.0]) * np.exp(np.clip(drive, -6, 6))

        def wheels(speeds):
            return np.array([speeds[0] - speeds[1] * half_track, speeds[0] + speeds[1] * half_track])

        def commanded_in(action):
            known = [before[part] if place is None else action[place] for part, place in enumerate(commanded)]
            return [speed or 0.0 for speed in known]

        first = commanded_in(actions[0])
        speed = wheels([first[part] if before[part] is None else before[part] for part in (0, 1)])
        pose, plain = (0.0, 0.0, 0.0), []
        for action in actions:
            target = wheels(commanded_in(action))
            difference = np.abs(target - speed)
            change = np.minimum(difference, acceleration * period)
            lost = change * (2 * difference - change) / (2 * acceleration * period)
            left, right = target - lost * np.sign(target - speed)
            speed = speed + change * np.sign(target - speed)
            turn, distance = (right - left) / (2 * half_track) * period, (left + right) / 2 * period
            pose = moved(pose, (turn, distance * np.cos(turn / 2), distance * np.sin(turn / 2)))
            plain.append([pose[2], pose[0], pose[1]])
        known = np.concatenate([self.scaled_state(state), scaled(actions, self.spec["actions"]).reshape(-1)])
        correction = dense(silu(dense(known, self.tensors, "flow.motion.inputs")), self.tensors, "flow.motion.output")
        return (np.array(plain) + 0.1 * correction.reshape(horizon, 3)).astype(np.float32)

    def scaled_state(self, state):
        return scaled(state, self.states)[0] if self.states else np.zeros(0, np.float32)

    def affine_places(self, motion):
        """The turned places without a camera model, of pixels and of quarter pixels."""
        places = own_places(self.shape)
        if self.moves:
            sides = np.array([self.shape[1], self.shape[0]], np.float32)
            basis = np.concatenate([places / sides * 2 - 1, np.ones(self.shape + (1,))], 2)
            places = places + basis @ (0.25 * dense(motion, self.tensors, "flow.affine")).reshape(3, 2) * sides
        inner = places.reshape(self.quarter[0], 4, self.quarter[1], 4, 2)[:, 1:3, :, 1:3]
        return places, (inner.mean((1, 3)) - 1.5) / 4

    # The room.

    def room(self):
        places = [self.states[place] for place in self.pose_channels[:2]]
        unit = max((places[0]["std"] + places[1]["std"]) / 2, LEAST_STD)
        first = np.array([-2.6, 2.6, -2.6, 2.6, -0.8, 2.0])
        return [place["mean"] for place in places], unit, first + 2 * self.tensors["flow.scene.room"]

    def origin(self, pose):
        middle, unit, _ = self.room()
        return np.array([(pose[0] - middle[0]) / unit, (pose[1] - middle[1]) / unit, 0.0])

    def hits(self, pose, viewer):
        """Origin, directions, points met, sides met and times of a view's rays."""
        origin, directions, sides = self.origin(pose), rotated(viewer.rays(), pose[2]), self.room()[2]
        far = directions > 0
        speeds = np.where(np.abs(directions) < 1e-6, 1e-6, directions)
        ends = np.where(far, sides[1::2], sides[::2])
        times = (ends - origin) / speeds
        axis = times.argmin(-1)
        side = 2 * axis + np.take_along_axis(far, axis[..., None], -1)[..., 0]
        time = np.maximum(times.min(-1), 0.02)
        return origin, directions, origin + time[..., None] * directions, side, time

    def room_places(self, pose, before):
        viewer = Viewer(self.camera, self.shape)
        points = self.hits(pose, viewer)[2] - self.origin(before)
        return viewer.project(rotated(points, -before[2]))

    def described_rays(self, pose):
        origin, directions, points, side, time = self.hits(pose, Viewer(self.camera, self.half))
        waves = []
        for axis in range(3):
            for octave in range(5):
                angle = np.pi / 4 * 2**octave * points[..., axis]
                waves += [np.sin(angle), np.cos(angle)]
        x, y, z = (directions[..., axis] for axis in range(3))
        level = np.maximum(np.hypot(x, y), 1e-6)
        distance = time * np.sqrt(level**2 + z**2)
        same = lambda value: np.full(self.half, value)
        rest = [same(origin[0]), same(origin[1]), x / level, y / level, z / level]
        rest += [(origin[0] * y - origin[1] * x) / level, 0.25 * distance, 0.05 * distance**2, 1 / (distance + 0.3)]
        met = np.eye(6)[side]
        return np.concatenate([np.stack(waves, 2), met, points, np.stack(rest, 2)], 2).astype(np.float32)

    def scene(self, state, motion, pose):
        """The surroundings on the half grid: 8 features, then the content of each block's pixels."""
        if not self.moves:
            return self.tensors["flow.scene.image"].reshape(self.half + (12,)) + 0.5
        if self.has_room:
            known = self.described_rays(pose)
        else:
            columns, rows = np.meshgrid(centred(self.half[1]), centred(self.half[0]))
            places = []
            for at in (columns, rows):
                places.append(at)
                for octave in range(4):
                    places += [np.sin(np.pi / 2 * 2**octave * at), np.cos(np.pi / 2 * 2**octave * at)]
            same = [np.full(self.half, value) for value in [*self.scaled_state(state), *motion]]
            known = np.stack(places + same, 2).astype(np.float32)
        x = known
        for index, name in enumerate(("inputs", "hidden", "output")):
            x = dense(silu(x) if index else x, self.tensors, "flow.scene." + name)
        if not self.has_room:
            x = x + self.tensors["flow.scene.image"].reshape(self.half + (12,))
        return x + 0.5

    def encode(self, frames, state):
        pose, nothing = self.pose_in(state), np.zeros(3, np.float32)
        _, rate = self.by_unit(self.states)
        inputs = []
        for back in range(self.spec["flow"].get("frames_read", 3)):
            frame = frames[max(len(frames) - 1 - back, 0)]
            if back and rate is not None and self.camera:
                turn = state[rate] * self.spec["frame_period_s"] * back
                frame = sample(frame, Viewer(self.camera, self.shape).turned(turn))
            inputs.append(unshuffle(frame[..., None]))
        inputs.append(self.scene(state, nothing, pose)[..., 8:])
        columns, rows = np.meshgrid(centred(self.half[1]), centred(self.half[0]))
        x = np.concatenate(inputs + [columns[..., None], rows[..., None]], 2).astype(np.float32)
        return self.encoded(silu(conv3(x, self.tensors, "flow.stem")))

    def encoded(self, first):
        x = conv3(first, self.tensors, "flow.halving", stride=2)
        for block in range(self.spec["flow"]["encoder_blocks"]):
            name = f"flow.encoder.{block}"
            inner = conv3(silu(x), self.tensors, name + ".first", dilation=1 << (block % 3))
            x = x + conv3(silu(inner), self.tensors, name + ".second")
        return x

    def predict(self, frames, actions, state):
        if self.moves:
            actions = limited(actions, self.spec["actions"])
        if self.states:
            state = limited(state, self.states)[0]
        motions, coarse = self.motions(state, actions), self.encode(frames, state)
        if self.spec["flow"].get("recurrent", False):
            return self.predict_recurrently(frames[-1], coarse, state)
        return [self.step(step, frames[-1], coarse, motions[step], (actions, state)) for step in range(len(motions))]

    def predict_recurrently(self, last, z, state):
        """Each step continues from the state and the frame of the step before."""
        nothing, own, predicted = np.zeros(3, np.float32), own_places(self.shape), []
        scene = self.scene(state, nothing, self.pose_in(state))
        for step in range(self.spec["horizon"]):
            seen = unshuffle(unshuffle(last[..., None]))
            inputs = np.concatenate([z, unshuffle(scene[..., :8]), seen], 2).astype(np.float32)
            z = z + dense(inputs, self.tensors, "flow.advance")
            z = self.refined(z, self.modulation(step, nothing, None, state))
            last = np.clip(self.drawn(z, last, scene, shuffle(scene[..., 8:])[..., 0], own, own), 0, 1)
            predicted.append(last)
        return predicted

    def modulation(self, step, motion, actions, state):
        horizon = self.spec["horizon"]
        known = [self.scaled_state(state)]
        if self.moves:
            taken = scaled(actions, self.spec["actions"])
            taken[step + 1 :] = 0
            known.append(taken.reshape(-1))
        known.append(np.eye(horizon)[step])
        if self.moves:
            known.append(motion)
        known = np.concatenate(known).astype(np.float32)
        return dense(silu(dense(known, self.tensors, "flow.modulation.inputs")), self.tensors, "flow.modulation.output")

    def step(self, step, last, coarse, motion, known):
        actions, state = known
        before = self.pose_in(state)
        pose = moved(before, motion)
        if self.moves and self.camera:
            turned = Viewer(self.camera, self.shape).turned(motion[0])
            coarse_places = Viewer(self.camera, self.quarter).turned(motion[0])
        else:
            turned, coarse_places = self.affine_places(motion)
        room = self.room_places(pose, before) if self.has_room else turned
        x, y = coarse_places[..., 0], coarse_places[..., 1]
        near = (x >= -1) & (x <= self.quarter[1]) & (y >= -1) & (y <= self.quarter[0])
        warped = np.where(near[..., None], sample(coarse, coarse_places), 0)
        scene = self.scene(state, motion, pose)
        modulation = self.modulation(step, motion, actions, state)
        z = dense(np.concatenate([warped, unshuffle(scene[..., :8])], 2).astype(np.float32), self.tensors, "flow.mix")
        content = shuffle(scene[..., 8:])[..., 0]
        return np.clip(self.drawn(self.refined(z, modulation), last, scene, content, room, turned), 0, 1)

    def refined(self, z, modulation):
        channels = self.spec["flow"]["channels"]
        for block in range(self.spec["flow"]["decoder_blocks"]):
            inner = z
            for part, name in enumerate(("first", "second")):
                at = (2 * block + part) * 2 * channels
                scale, shift = modulation[at : at + channels], modulation[at + channels : at + 2 * channels]
                inner = conv3(silu(inner * (1 + scale) + shift), self.tensors, f"flow.decoder.{block}.{name}")
            z = z + inner
        return z

    def drawn(self, z, last, beside, content, room, turned, remembered=None):
        """The frame of a state: pixels of the last frame, moved in two ways, content, and what is remembered."""
        enlarged = shuffle(dense(silu(z), self.tensors, "flow.enlarge"))
        inside = (outside(room, self.shape) == 0).astype(np.float32)[..., None]
        moved_pixels = unshuffle(sample(last, room)[..., None])
        share = unshuffle(inside).mean(2, keepdims=True)
        fine = conv3(np.concatenate([enlarged, moved_pixels, share, beside], 2).astype(np.float32), self.tensors, "flow.fine")
        if remembered is not None:
            fine = fine + conv3(remembered, self.tensors, "flow.memory.fine")
        head = shuffle(conv3(silu(fine), self.tensors, "flow.head"))
        values = [sample(last, room + 4 * head[..., 0:2]), sample(last, turned + 4 * head[..., 2:4]), content + head[..., 7]]
        lost = lambda places: np.minimum(2 * outside(places, self.shape), 8)
        logits = np.stack([head[..., 4] + 1.5 - lost(room), head[..., 5] - lost(turned), head[..., 6]], 2)
        shares = np.exp(logits - logits.max(2, keepdims=True))
        shares = shares / shares.sum(2, keepdims=True)
        drawn = (np.stack(values, 2) * shares).sum(2)
        if remembered is None:
            return drawn
        logits = shuffle(conv3(silu(fine), self.tensors, "flow.memory.share"))[..., 0]
        return drawn + (shuffle(remembered[..., 8:])[..., 0] - drawn) / (1 + np.exp(3 - logits))


class DepthNetwork(FlowNetwork):
    """The form of the flow network that estimates depth. Frames are counted from the last one's mean in its spread."""

    WALL, FARTHER, USUAL_HEIGHT = 2.2, 1.25, 0.3

    def __init__(self, spec, tensors):
        super().__init__(spec, tensors)
        self.camera = self.camera or {"horizontal_fov_rad": 1.05, "tilt_down_rad": 0.2}
        self.viewer = Viewer(self.camera, self.shape)
        rays = self.viewer.rays()
        wall = self.WALL / np.maximum(np.hypot(rays[..., 0], rays[..., 1]), 1e-3)
        height = self.camera.get("height_m") or self.USUAL_HEIGHT
        floor = np.where(rays[..., 2] < 0, height / np.maximum(-rays[..., 2], 1e-9), np.inf)
        self.first_depth = np.minimum(wall, floor)
        columns, rows = np.meshgrid(centred(self.half[1]), centred(self.half[0]))
        inverse = unshuffle(1 / self.first_depth[..., None]).mean(2)
        self.place_values = np.stack([columns, rows, inverse], 2)

    def scaled_state(self, state):
        """Without the pose: it says how the camera has moved, and to a memory where it is."""
        read = [place for place in range(len(self.states)) if place not in (self.pose_channels or [])]
        return super().scaled_state(state)[read]

    def motion_back(self, states, back):
        """Where the camera stood at an earlier frame, as seen from the last one: yaw, ahead, left."""
        back = min(back, self.spec["context"] - 1)
        if self.pose_channels and len(states) > back:
            (x, y, heading), (there_x, there_y, there) = (self.pose_in(states[at]) for at in (-1, -1 - back))
            sin, cos, x, y = np.sin(heading), np.cos(heading), there_x - x, there_y - y
            return (there - heading + np.pi) % (2 * np.pi) - np.pi, cos * x + sin * y, cos * y - sin * x
        speeds = self.by_unit(self.states)
        forward, turn = (0, 0) if None in speeds else (states[-1][place] for place in speeds)
        time = -self.spec["frame_period_s"] * back
        return turn * time, forward * time * np.cos(turn * time / 2), forward * time * np.sin(turn * time / 2)

    def moved_back(self, last, earlier, motion):
        """An earlier frame in the last one's view, and how much each block shifts if everything is farther away."""
        yaw, ahead, left = motion
        offset = np.array([ahead, left, 0])
        seen_at = lambda depth: self.viewer.project(rotated(self.viewer.rays() * depth[..., None] - offset, -yaw))
        near, far = seen_at(self.first_depth), seen_at(self.FARTHER * self.first_depth)
        is_inside = (near >= -0.5) & (near <= np.array([self.shape[1], self.shape[0]]) - 0.5)
        frame = np.where(is_inside.all(2), sample(earlier, near), last)
        return frame, unshuffle(np.clip((far - near) / 4, -4, 4) / 4).reshape(self.half + (4, 2)).sum(2)

    def predict(self, frames, actions, state):
        # Without states, all are empty.
        states = [[]] * len(frames) if state is None else state
        actions = limited(actions, self.spec["actions"]) if self.moves else None
        mean, spread = frames[-1].mean(), max(frames[-1].std(), 0.04)
        frames = [(frame - mean) / spread for frame in frames]
        blocks, shifts = [unshuffle(frames[-1][..., None])], []
        for back in range(1, self.spec["flow"]["frames_read"]):
            earlier = frames[max(len(frames) - 1 - back, 0)]
            frame, shift = self.moved_back(frames[-1], earlier, self.motion_back(states, back))
            blocks.append(unshuffle(frame[..., None]))
            shifts.append(shift)
        x = np.concatenate(blocks + shifts + [self.place_values], 2).astype(np.float32)
        seen = conv3(x, self.tensors, "flow.stem")
        now = self.remembered(states[-1], np.zeros(3), mean, spread)
        if now is not None:
            seen = seen + conv3(now[..., 8:], self.tensors, "flow.memory.seen")
        first = silu(seen)
        coarse = self.encoded(first)
        enlarged = silu(shuffle(dense(silu(coarse), self.tensors, "flow.depth.enlarge")))
        logarithm = conv3(np.concatenate([enlarged, first], 2), self.tensors, "flow.depth.output")
        depth = self.first_depth * np.exp(1.5 * np.tanh(shuffle(logarithm)[..., 0]))
        motions = self.motions(states[-1], actions)
        drawn = []
        for step, motion in enumerate(motions):
            remembered = self.remembered(states[-1], motion, mean, spread)
            drawn.append(self.step_with_depth(step, frames[-1], coarse, depth, motion, (actions, states[-1]), remembered))
        return [np.clip(frame * spread + mean, 0, 1) for frame in drawn]

    def remembered(self, state, motion, mean, spread):
        """The scene after a motion, its content counted as the frames are; None for a model without a memory."""
        if not self.spec["flow"].get("memory", False):
            return None
        scene = self.scene(state, motion, moved(self.pose_in(state), motion))
        return np.concatenate([scene[..., :8], (scene[..., 8:] - mean) / spread], 2).astype(np.float32)

    def step_with_depth(self, step, last, coarse, depth, motion, known, remembered=None):
        """Where the camera saw each pixel before it moved: the depth that is found there corrects the guess."""
        directions, offset = rotated(self.viewer.rays(), motion[0]), np.array([motion[1], motion[2], 0])
        turned = self.viewer.project(directions)
        guess = sample(depth, turned)
        for _ in range(3):
            points = offset + guess[..., None] * directions
            deep = np.maximum(self.viewer.cos * points[..., 0] - self.viewer.sin * points[..., 2], 1e-3)
            guess = guess * np.clip(sample(depth, self.viewer.project(points)) / deep, 0.5, 2)
        room = self.viewer.project(offset + guess[..., None] * directions)
        places = (room.reshape(self.quarter[0], 4, self.quarter[1], 4, 2)[:, 1:3, :, 1:3].mean((1, 3)) - 1.5) / 4
        x, y = places[..., 0], places[..., 1]
        near = (x >= -1) & (x <= self.quarter[1]) & (y >= -1) & (y <= self.quarter[0])
        is_seen = (x >= -0.5) & (x <= self.quarter[1] - 0.5) & (y >= -0.5) & (y <= self.quarter[0] - 0.5)
        warped = np.where(near[..., None], sample(coarse, places), 0)
        mixed = np.concatenate([warped, self.place_values[::2, ::2], is_seen[..., None]], 2).astype(np.float32)
        z = self.refined(dense(mixed, self.tensors, "flow.mix"), self.modulation(step, motion, *known))
        inverse, far = 1 / np.maximum(guess[::2, ::2], 0.05), np.minimum(outside(room[::2, ::2], self.shape) / 8, 4)
        beside = np.concatenate([self.place_values, inverse[..., None], far[..., None]], 2)
        return self.drawn(z, last, beside, np.zeros(self.shape), room, turned, remembered)


# The sprite network.


class SpriteNetwork:
    """Two pictures, cut out of the context, that move as wholes over black."""

    WINDOW, REACH, LEAST_ENERGY, CHANGE_COST, MOST_CHANGE, SPEED_FRAMES = (12, 16), 4, 1.0, 0.02, 8.0, 3
    FARTHEST, MISFIT_DECAY, MOST_CANDIDATES, LEAST_GAIN, LEAST_PART = 4.0, 10.0, 256, 4e-6, 1e-6

    def __init__(self, spec, tensors):
        self.spec, self.tensors = spec, tensors
        self.shape = (spec["frame_height_px"], spec["frame_width_px"])

    def layer(self, name, x):
        return dense(x, self.tensors, "sprites." + name)

    def convolution(self, name, x, **shape):
        return conv3(x, self.tensors, "sprites." + name, **shape)

    def predict(self, frames, actions, state):
        tracks, followed = self.tracks(frames[-1], frames[-2::-1])
        apart = self.two_ways(tracks, followed, unshuffle(unshuffle(frames[-1][..., None])).sum(2))
        shares, trust = self.see(frames, tracks, apart)
        layers = []
        for sprite in (0, 1):
            part = frames[-1] * (shares if sprite == 0 else 1 - shares)
            weight = np.exp(4 * np.tanh(trust[..., sprite] / 4) - apart[..., sprite] ** 2)
            weight = weight * unshuffle(unshuffle(part[..., None])).sum(2) + 1e-4
            earlier = (tracks[..., :2] * (weight / weight.sum())[..., None, None]).sum((0, 1))
            whole = self.whole(frames, part, earlier)
            moves, widths = self.way(whole, earlier)
            layers.append([placed(whole, move, width) for move, width in zip(moves, widths)])
        return [np.clip(one + other - one * other, 0, 1) for one, other in zip(*layers)]

    def see(self, frames, tracks, apart):
        """The first sprite's share of each pixel of the last frame, and what each block says of the motions."""
        half = (self.shape[0] // 2, self.shape[1] // 2)
        columns, rows = np.meshgrid(centred(half[1]), centred(half[0]))
        inputs = [unshuffle(frame[..., None]) for frame in frames[::-1]] + [columns[..., None], rows[..., None]]
        first = silu(self.convolution("stem", np.concatenate(inputs, 2).astype(np.float32)))
        scale = [[1 / (4 * frame), 1 / (4 * frame), 1] for frame in range(1, len(frames))]
        read = (tracks * np.array(scale)).reshape(tracks.shape[:2] + (-1,))
        read = np.concatenate([read, apart / self.FARTHEST], 2).astype(np.float32)
        x = self.convolution("halving", first, stride=2) + self.layer("tracks", read)
        for block in range(self.spec["sprites"]["encoder_blocks"]):
            inner = self.convolution(f"encoder.{block}.first", silu(x), dilation=1 << (block % 3))
            x = x + self.convolution(f"encoder.{block}.second", silu(inner))
        x = silu(x)
        fine = self.convolution("fine", np.concatenate([shuffle(self.layer("enlarge", x)), first], 2))
        logits = shuffle(self.convolution("head", silu(fine)))[..., 0]
        nearer = np.kron(apart[..., 1] - apart[..., 0], np.ones((4, 4)))
        return sigmoid(2 * logits + nearer), self.layer("trust", x)

    def tracks(self, frame, others):
        """How far each block of 4×4 px is in each other frame, to the right and down, and its misfit there; and whether it was followed."""
        height, width = self.WINDOW
        border = 4 * width
        # Not in f32, whose rounding would decide between places that cost the same.
        frame, *others = (np.pad(np.float64(each), border) for each in [frame, *others])
        tracks = np.zeros((self.shape[0] // 4, self.shape[1] // 4, len(others), 3), np.float32)
        followed = np.zeros(tracks.shape[:2], bool)
        steps = range(-self.REACH, self.REACH + 1)
        for block in np.ndindex(tracks.shape[:2]):
            top, left = (4 * block[axis] + 2 + border - self.WINDOW[axis] // 2 for axis in (0, 1))
            window = frame[top : top + height, left : left + width]
            energy, before, at = (window**2).sum(), (0, 0), (top, left)
            followed[block] = energy >= self.LEAST_ENERGY
            if not followed[block]:
                continue
            for index, other in enumerate(others):
                least, best = np.inf, before
                for step in ((down, right) for down in steps for right in steps):
                    there = (at[0] + step[0], at[1] + step[1])
                    seen = other[max(there[0], 0) : there[0] + height, max(there[1], 0) : there[1] + width]
                    if min(there) >= 0 and seen.shape == window.shape:
                        change = (step[0] - before[0]) ** 2 + (step[1] - before[1]) ** 2
                        cost = ((seen - window) ** 2).sum() + self.CHANGE_COST * min(change, self.MOST_CHANGE)
                        if cost < least * (1 - self.LEAST_PART) - self.LEAST_GAIN:
                            least, best = cost, step
                before = best
                at = (at[0] + best[0], at[1] + best[1])
                tracks[block][index] = at[1] - left, at[0] - top, min(least / energy, 1)
        return tracks, followed

    def two_ways(self, tracks, followed, light):
        """How far each block went from the way that most others follow, and from the one that most of the rest follow."""
        apart = np.full(tracks.shape[:2] + (2,), self.FARTHEST)
        ways, fits = tracks[followed][..., :2], np.exp(-self.MISFIT_DECAY * tracks[followed][..., 2])
        votes = light[followed] * fits.mean(1)
        if not followed.any():
            return apart
        # Each way once, where it comes first; of many, those whose own blocks have the most votes.
        _, first, which = np.unique(ways, axis=0, return_index=True, return_inverse=True)
        own = np.bincount(which.ravel(), votes, len(first))[first.argsort()]
        first = np.sort(first)
        first = first[np.sort(np.argsort(-own, kind="stable")[: self.MOST_CANDIDATES])]
        # Row by row, the distances of all blocks to one of the ways.
        distances = np.minimum(np.linalg.norm(ways[None] - ways[first][:, None], axis=3), self.FARTHEST)
        distances = (distances * fits).sum(2) / (fits.sum(1) + 1e-3)
        for way in (0, 1):
            best = distances[(np.exp(-(distances**2)) * votes).sum(1).argmax()]
            apart[followed, way] = best
            votes = votes * (1 - np.exp(-(best**2)))
        return apart

    def whole(self, frames, part, earlier):
        """A sprite with what the other one hides of it: all frames are laid over each other where it stands still."""
        followed = [placed(frame, -move, (1, 1)) for frame, move in zip(frames[-2::-1], earlier)]
        x = unshuffle(np.stack([frames[-1], *followed, part], 2).astype(np.float32))
        x = self.convolution("content.second", silu(self.convolution("content.first", x)))
        hidden = sigmoid(shuffle(self.convolution("content.output", silu(x)))[..., 0] - 4)
        return part + hidden - part * hidden

    def way(self, whole, earlier):
        """How far a sprite will have moved at each step, to the right and down, and how wide it is spread, in pixels."""
        units = np.array([self.shape[1], self.shape[0]]) / 4
        columns, rows = np.meshgrid(np.arange(self.shape[1]), np.arange(self.shape[0]))
        weight = whole**2
        middle = np.array([(weight * at).sum() for at in (columns - columns.mean(), rows - rows.mean())]) / (weight.sum() + 1e-3)
        measured = min(self.SPEED_FRAMES, len(earlier))
        place = middle / units
        speed = -5 * earlier[measured - 1] / measured / units
        known = np.stack([2 * place, 2 * place**2, speed, *(-3 * earlier / units)], 1).astype(np.float32)
        memory = self.layer("memory.output", silu(self.layer("memory.inputs", known)))
        moves, widths = [], []
        for _ in range(self.spec["horizon"]):
            known = np.concatenate([2 * place[:, None], 2 * speed[:, None], memory], 1).astype(np.float32)
            told = self.layer("step.output", silu(self.layer("step.hidden", silu(self.layer("step.inputs", known)))))
            speed = speed + told[:, 0]
            place = place + (speed + told[:, 1]) / 5
            memory = memory + told[:, 3:]
            moves.append(place * units - middle)
            widths.append(1 + np.logaddexp(0, 2 * told[:, 2] - 2))
        return moves, widths


def placed(picture, move, width):
    """A picture moved to the right and down by parts of pixels, and spread."""
    tents = []
    for axis, side in ((1, picture.shape[0]), (0, picture.shape[1])):
        distance = np.arange(side)[None] - (np.arange(side)[:, None] - move[axis])
        tents.append(np.maximum(1 - np.abs(distance) / width[axis], 0) / width[axis])
    return tents[0] @ picture @ tents[1].T


# Files and the comparison.


def natural(path):
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def ask(server, model, images, actions, state):
    """A server's prediction of the same frames."""
    request = {"frames": [base64.b64encode(image).decode() for image in images]}
    if actions is not None:
        known = "states" if np.ndim(state) == 2 else "state"
        request |= {"plan": actions, known: state}
    body = json.dumps(request).encode()
    url = f"{server}/v1/models/{model}/predict"
    with urllib.request.urlopen(urllib.request.Request(url, body, {"content-type": "application/json"})) as answer:
        frames = json.load(answer)["frames"]
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(frame)))) for frame in frames]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="directory of the model")
    parser.add_argument("--frames", type=Path, required=True, help="directory of PNG images of the model's size")
    parser.add_argument("--actions", type=Path, help="JSON file with the states and actions of the images")
    parser.add_argument("--at", type=int, help="last frame that the model sees [default: the last image]")
    parser.add_argument("--out", type=Path, required=True, help="directory for predicted-1.png and so on")
    parser.add_argument("--server", help="address of a server that serves the model, to compare with")
    arguments = parser.parse_args()

    manifest, tensors = read_model(arguments.model)
    spec = manifest["spec"]
    context, horizon = spec["context"], spec["horizon"]
    paths = sorted(arguments.frames.glob("*.png"), key=natural)
    last = len(paths) - 1 if arguments.at is None else arguments.at
    images = [path.read_bytes() for path in paths[last + 1 - context : last + 1]]
    frames = [np.asarray(Image.open(io.BytesIO(image)).convert("L"), np.float32) / 255 for image in images]
    has_depth = spec.get("flow", {}).get("depth", False)
    actions = state = None
    if spec["conditioning"] != "none":
        if arguments.actions is None:
            parser.error(f"{arguments.model.name} takes {spec['conditioning']}: give --actions")
        recorded = json.loads(arguments.actions.read_text())
        actions, states = recorded["actions"][last : last + horizon], recorded["states"]
        state = states[last + 1 - context : last + 1] if has_depth else states[last]

    if has_depth:
        predicted = DepthNetwork(spec, tensors).predict(frames, actions, state)
    elif spec.get("architecture", "dense") == "flow":
        predicted = FlowNetwork(spec, tensors).predict(frames, actions, state)
    elif spec.get("architecture", "dense") == "sprites":
        predicted = SpriteNetwork(spec, tensors).predict(frames, actions, state)
    else:
        predicted = predict_dense(spec, tensors, frames, actions, state)
    predicted = [(frame * 255 + 0.5).astype(np.uint8) for frame in predicted]
    arguments.out.mkdir(parents=True, exist_ok=True)
    for number, frame in enumerate(predicted, 1):
        Image.fromarray(frame).save(arguments.out / f"predicted-{number}.png")
    if arguments.server:
        expected = ask(arguments.server, arguments.model.name, images, actions, state)
        apart = max(int(np.abs(a.astype(int) - b).max()) for a, b in zip(predicted, expected, strict=True))
        print(f"{arguments.model.name}: at most {apart} gray levels from the server")
        if apart > 1:
            sys.exit(1)
    print(f"{arguments.out}: {len(predicted)} frames predicted")


if __name__ == "__main__":
    main()

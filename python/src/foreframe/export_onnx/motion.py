"""The motion of a camera on a base with two driven wheels (docs/flow-network.md, Motion of the camera)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .graph import Tensor, Value, concat
from .layers import Layers, scaled, silu

_HALF_TRACK_M, _ACCELERATION = 0.15, 2.0
_UNITS = ("m/s", "rad/s")


def speed_channels(channels: list[dict[str, Any]]) -> list[int | None]:
    """The first channel of each speed's unit: driving, turning."""
    units = [channel["unit"] for channel in channels]
    return [units.index(unit) if unit in units else None for unit in _UNITS]


class Motion:
    """Yaw, ahead and left of each step since the last frame, from limited actions and state."""

    def __init__(self, spec: dict[str, Any], layers: Layers) -> None:
        self.spec, self.layers, self.horizon = spec, layers, int(spec["horizon"])
        self.states: list[dict[str, Any]] = spec["states"] if "state" in spec["conditioning"] else []
        drive = np.exp(np.clip(layers.weights.get("flow.motion.drive", np.zeros(2, np.float32)), -6, 6))
        self.half_track, self.acceleration = float(_HALF_TRACK_M * drive[0]), float(_ACCELERATION * drive[1])

    def __call__(self, actions: Tensor, state: Tensor | None, scaled_state: Tensor | None) -> Value:
        """``[batch, horizon, 3]``."""
        known = scaled(actions, self.spec["actions"]).reshape(-1, self.horizon * len(self.spec["actions"]))
        known = known if scaled_state is None else concat([scaled_state, known])
        hidden = silu(self.layers.dense(known, "flow.motion.inputs"))
        correction = self.layers.dense(hidden, "flow.motion.output").reshape(-1, self.horizon, 3)
        return self._commanded(actions, state) + 0.1 * correction

    def _commanded(self, actions: Tensor, state: Tensor | None) -> Value:
        """The way of a base whose wheels follow the commanded speeds."""
        period, sides = self.spec["frame_period_s"], np.array([-self.half_track, self.half_track])
        speeds: list[Value] = []
        first: list[Value] = []
        for commanded, measured in zip(speed_channels(self.spec["actions"]), speed_channels(self.states)):
            before = 0.0 if measured is None or state is None else state[:, measured : measured + 1].reshape(-1, 1, 1)
            speeds.append(before if commanded is None else actions[:, :, commanded : commanded + 1])
            first.append(speeds[-1][:, :1] if measured is None and commanded is not None else before)
        if all(isinstance(speed, float) for speed in speeds):
            return np.zeros((1, self.horizon, 3))
        target = speeds[0] + speeds[1] * sides + np.zeros((1, self.horizon, 1))
        wheel, most, changes, missing = first[0] + first[1] * sides, self.acceleration * period, [], []
        for step in range(self.horizon):
            missing.append(target[:, step : step + 1] - wheel)
            changes.append(np.minimum(np.maximum(missing[-1], -most), most))
            wheel = wheel + changes[-1]
        change = concat(changes)
        mean = target - change * (2 * np.abs(concat(missing)) - np.abs(change)) / (2 * most)
        left, right = mean[:, :, 0], mean[:, :, 1]
        turn, distance = (right - left) * (period / (2 * self.half_track)), (left + right) * (period / 2)
        # Sums over the steps so far, without and with the step itself.
        until, through = (np.triu(np.ones((self.horizon, self.horizon)), diagonal) for diagonal in (1, 0))
        chord = turn @ until + turn / 2
        way = [turn @ through, (distance * np.cos(chord)) @ through, (distance * np.sin(chord)) @ through]
        return concat([part.reshape(-1, self.horizon, 1) for part in way], axis=2)

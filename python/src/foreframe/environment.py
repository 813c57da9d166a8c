"""A simulated robot on the server."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from . import calls
from .errors import ApiError, ForeframeError
from .images import Gray, decode_png
from .records import Channel, Floats, channels

if TYPE_CHECKING:
    from .client import Client


@dataclass(frozen=True)
class Observation:
    """What the robot senses."""

    #: ``[height, width]``.
    frame: Gray
    state: Floats
    #: Seconds since the start of the episode.
    time_s: float
    #: The next action of the simulator's own driver.
    policy_action: Floats
    #: The random parameters of the episode; only at its start.
    trial: Mapping[str, Any] | None

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> Observation:
        observed, info = body["observation"], body["info"]
        return cls(
            frame=decode_png(base64.b64decode(observed["frame"])),
            state=np.asarray(observed["state"], np.float32),
            time_s=info["time_s"],
            policy_action=np.asarray(info["policy_action"], np.float32),
            trial=info.get("trial"),
        )


@dataclass(frozen=True)
class Step:
    """The result of an action."""

    observation: Observation
    reward: float
    terminated: bool
    truncated: bool


class Environment:
    """An environment of the server. It ends with ``close``, or when nobody steps it for a while; then ``reset`` makes it anew."""

    def __init__(self, client: Client, scenario: str, seed: int, world: Mapping[str, Any] | None) -> None:
        self._client = client
        self._scenario, self._seed, self._world = scenario, seed, world
        #: The number of the episode among those of the seed.
        self._trial = 0
        self._is_closed = False
        #: The first observation.
        self.observation = Observation.of(self._create(seed))

    def _create(self, seed: int) -> Mapping[str, Any]:
        body = self._client.run(calls.create_environment(self._scenario, seed, self._world))
        self.id: str = body["id"]
        #: Components of an action, with what the robot can do as their bounds.
        self.actions: tuple[Channel, ...] = channels(body["action"], body["action_bounds"])
        #: Components of a state; they have no bounds.
        self.states: tuple[Channel, ...] = channels(body["state"], [{"low": -np.inf, "high": np.inf}] * len(body["state"]))
        self.world: Mapping[str, Any] = body["world"]
        return body

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of a frame."""
        return self.world["frame_height_px"], self.world["frame_width_px"]

    def reset(self, seed: int | None = None) -> Observation:
        """Begins the first episode of a seed; without a seed, the next one."""
        begun, trial = (self._seed, self._trial + 1) if seed is None else (seed, 0)
        try:
            body = self._client.run(calls.reset_environment(self.id, seed))
        except ApiError as error:
            if error.status != 404 or self._is_closed:
                raise
            # The server dropped it. The new one comes to the same episode.
            body = self._create(begun)
            for _ in range(trial):
                body = self._client.run(calls.reset_environment(self.id, None))
        self._seed, self._trial = begun, trial
        self.observation = Observation.of(body)
        return self.observation

    def step(self, action: calls.Vector) -> Step:
        """Acts until the next frame."""
        body = self._client.run(calls.step_environment(self.id, action))
        self.observation = Observation.of(body)
        return Step(self.observation, body["reward"], body["terminated"], body["truncated"])

    def close(self) -> None:
        """Deletes the environment; does nothing if it is gone."""
        self._is_closed = True
        try:
            self._client.run(calls.delete_environment(self.id))
        except ApiError as error:
            if error.status != 404:
                raise

    def __enter__(self) -> Environment:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        try:
            self.close()
        except ForeframeError:
            if error is None:
                raise

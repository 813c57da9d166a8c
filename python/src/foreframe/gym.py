"""Gymnasium environments: a simulated robot of the server, and a dream, whose dynamics are a model.

Both have the same observations: ``frame`` uint8[height, width, 1] and, if there is one, ``state`` float32. Needs the extra
``gym``: ``pip install './python[gym]'`` in a clone of Foreframe.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from .client import Client
from .environment import Environment
from .images import Gray
from .records import Channel, Floats
from .session import Session

Observed: TypeAlias = "dict[str, NDArray[Any]]"
#: The reward of a step, from the frame ``[height, width]`` and the state after it, and the action.
Reward: TypeAlias = "Callable[[Gray, Floats | None, Floats], float]"
#: The state after an action, from the state before it, the action, and the seconds between two frames.
NextState: TypeAlias = "Callable[[Floats, Floats, float], Floats]"

#: Steps of an episode of a dream: 2 s at five frames a second.
DREAM_STEPS = 10
_SEEDS = 2**31


def action_space(channels: Sequence[Channel]) -> spaces.Box:
    """The space of actions within the channels' bounds."""
    low = np.array([channel.low for channel in channels], np.float32)
    high = np.array([channel.high for channel in channels], np.float32)
    return spaces.Box(low, high, dtype=np.float32)


def observation_space(size: tuple[int, int], states: int) -> spaces.Dict:
    """The space of frames of this height and width, with ``states`` components of a state, which have no bounds."""
    parts: dict[str, spaces.Space[Any]] = {"frame": spaces.Box(0, 255, (*size, 1), np.uint8)}
    if states:
        parts["state"] = spaces.Box(-np.inf, np.inf, (states,), np.float32)
    return spaces.Dict(parts)


def _observed(frame: Gray, state: Floats | None) -> Observed:
    parts: Observed = {"frame": frame[:, :, None].copy()}
    if state is not None:
        parts["state"] = np.asarray(state, np.float32)
    return parts


class _CameraEnv(gymnasium.Env[Any, Any]):
    """What both environments show."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}
    render_mode: str | None
    _frame: Gray

    def __init__(self, render_mode: str | None, period_s: float) -> None:
        self.metadata = {**type(self).metadata, "render_fps": round(1 / period_s)}
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode is {render_mode}; it can be rgb_array")
        self.render_mode = render_mode

    def render(self) -> Any:
        """The last frame, uint8[height, width, 3]."""
        return np.repeat(self._frame[:, :, None], 3, axis=2) if self.render_mode == "rgb_array" else None


class SimulatorEnv(_CameraEnv):
    """A simulated robot of the server.

    ``actions``: channels whose bounds become those of the action space; without them, what the robot can do. The channels of a
    model, ``client.spec(model).actions``, give the actions that it knows from its training.
    """

    def __init__(
        self,
        client: Client,
        scenario: str = "moving-observer",
        *,
        actions: Sequence[Channel] | None = None,
        world: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._environment: Environment | None = client.environment(scenario, world=world)
        super().__init__(render_mode, self._environment.world["frame_period_s"])
        self.action_space = action_space(actions or self._environment.actions)
        self.observation_space = observation_space(self._environment.size, len(self._environment.states))
        self._frame = self._environment.observation.frame

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observed, dict[str, Any]]:
        """Begins an episode: with a seed its first, without one the next."""
        super().reset(seed=seed)
        observation = self._open().reset(seed)
        self._frame = observation.frame
        return _observed(observation.frame, observation.state), {"policy_action": observation.policy_action}

    def step(self, action: Floats) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Acts until the next frame. The reward is 1 if the other robot is in the middle of the view; minus 1 for a collision."""
        stepped = self._open().step(action)
        observation = stepped.observation
        self._frame = observation.frame
        info = {"policy_action": observation.policy_action, "time_s": observation.time_s}
        seen = _observed(observation.frame, observation.state)
        return seen, float(stepped.reward), stepped.terminated, stepped.truncated, info

    def close(self) -> None:
        """Deletes the environment on the server."""
        environment, self._environment = self._environment, None
        if environment is not None:
            environment.close()

    def _open(self) -> Environment:
        if self._environment is None:
            raise RuntimeError("the environment is closed")
        return self._environment


@dataclass(frozen=True)
class Start:
    """Where a dream begins: the model's context."""

    #: ``[context, height, width]``, oldest first.
    frames: Gray
    #: ``[context - 1, actions]``: the action from each frame to the next.
    actions: Floats
    #: ``[context, states]``; None for a model that takes no state.
    states: Floats | None


class Starts(Protocol):
    """Gives a start for each episode."""

    def __call__(self, random: np.random.Generator) -> Start: ...


class SimulatorStarts:
    """Starts from a simulated robot: a random moment of a random episode, driven by the simulator's own driver."""

    def __init__(
        self,
        client: Client,
        context: int,
        scenario: str = "moving-observer",
        *,
        latest: int = 25,
        world: Mapping[str, Any] | None = None,
    ) -> None:
        if not isinstance(context, int):
            raise TypeError(f"context is {context!r}; give the frames that the model sees, client.spec(model).context")
        self._environment = client.environment(scenario, world=world)
        self._context = context
        self._latest = latest

    def __call__(self, random: np.random.Generator) -> Start:
        environment = self._environment
        observation = environment.reset(int(random.integers(_SEEDS)))
        observations, actions = [observation], []
        for _ in range(self._context - 1 + int(random.integers(self._latest))):
            actions.append(observation.policy_action)
            step = environment.step(observation.policy_action)
            observation = step.observation
            observations.append(observation)
            if step.terminated or step.truncated:
                break
        seen = observations[-self._context :]
        between = actions[len(observations) - len(seen) :]
        return Start(
            frames=np.stack([observed.frame for observed in seen]),
            actions=np.asarray(between, np.float32),
            states=np.stack([observed.state for observed in seen]),
        )

    def close(self) -> None:
        """Deletes the environment on the server."""
        self._environment.close()


class DreamEnv(_CameraEnv):
    """An environment whose dynamics are a model: each next frame is the model's own prediction.

    ``starts`` gives the context of each episode; ``reward`` judges each predicted frame. A model predicts frames only, so
    ``next_state`` computes the state after an action, for a model that takes one; default: the simulated robot's wheels. The
    info of a step has the ``novelty`` of the context: near 1, the dream is unlike the training data and not to be trusted.
    """

    def __init__(
        self,
        client: Client,
        model: str,
        starts: Starts,
        reward: Reward,
        *,
        max_steps: int = DREAM_STEPS,
        next_state: NextState | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._client = client
        self._model = model
        self._spec = client.spec(model)
        super().__init__(render_mode, self._spec.period_s)
        if not self._spec.takes_actions:
            raise ValueError(f"model {model} takes no actions, so nothing can be done in its dream")
        self._starts = starts
        self._reward = reward
        self._max_steps = max_steps
        self._next_state = next_state or drive
        self.action_space = action_space(self._spec.actions)
        self.observation_space = observation_space(self._spec.size, len(self._spec.states) if self._spec.takes_state else 0)
        self._session: Session | None = None
        self._state: Floats | None = None
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observed, dict[str, Any]]:
        """Begins an episode from a new start."""
        super().reset(seed=seed)
        start = self._starts(self.np_random)
        # A session of its own for each episode: nothing is left of the one before.
        self.close()
        self._session = self._client.session(self._model)
        for index, action in enumerate(start.actions):
            state = start.states[index] if start.states is not None else None
            self._send(start.frames[index], state, action)
        self._frame = start.frames[-1]
        self._state = start.states[-1] if self._spec.takes_state and start.states is not None else None
        self._steps = 0
        return _observed(self._frame, self._state), {"imagined_s": 0.0}

    def step(self, action: Floats) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Predicts the next frame."""
        action = np.asarray(action, np.float32)
        answer = self._send(self._frame, self._state, action)
        if answer.prediction is None:
            raise ValueError(f"the start of this episode has fewer than {answer.need} frames")
        self._frame = answer.prediction.frames[0]
        if self._state is not None:
            self._state = np.asarray(self._next_state(self._state, action, self._spec.period_s), np.float32)
        self._steps += 1
        reward = float(self._reward(self._frame, self._state, action))
        info = {"imagined_s": self._steps * self._spec.period_s, "novelty": answer.prediction.novelty}
        return _observed(self._frame, self._state), reward, False, self._steps >= self._max_steps, info

    def _send(self, frame: Gray, state: Floats | None, action: Floats) -> Any:
        if self._session is None:
            raise RuntimeError("reset the environment first")
        known = state if self._spec.takes_state else None
        return self._session.step(frame, action=action, state=known, plan=[action], steps=1)

    def close(self) -> None:
        """Ends the session on the server."""
        session, self._session = self._session, None
        if session is not None:
            session.close()


#: The simulated robot, a TurtleBot 2: distance of its wheels, and the highest speeds and acceleration of their rims.
WHEEL_BASE_M, MAX_LINEAR_M_S, MAX_ANGULAR_RAD_S, MAX_RIM_ACCELERATION_M_S2 = 0.23, 0.7, 1.92, 1.2
_PHYSICS_STEP_S = 0.02


def drive(state: Floats, action: Floats, period_s: float) -> Floats:
    """The state (x, y, cos and sin of the heading, linear, angular) of the simulated robot after a command (linear, angular)."""
    if len(state) != 6 or len(action) != 2:
        raise ValueError(f"this model has {len(state)} components of a state; give a next_state of your own")
    x, y, cos, sin, linear, angular = (float(value) for value in state)
    heading = np.arctan2(sin, cos)
    speeds = linear + np.array([-1, 1]) * angular * WHEEL_BASE_M / 2
    wanted_linear = np.clip(action[0], -MAX_LINEAR_M_S, MAX_LINEAR_M_S)
    wanted_angular = np.clip(action[1], -MAX_ANGULAR_RAD_S, MAX_ANGULAR_RAD_S)
    wanted = wanted_linear + np.array([-1, 1]) * wanted_angular * WHEEL_BASE_M / 2
    steps = max(1, round(period_s / _PHYSICS_STEP_S))
    seconds = period_s / steps
    for _ in range(steps):
        most = MAX_RIM_ACCELERATION_M_S2 * seconds
        speeds = speeds + np.clip(wanted - speeds, -most, most)
        linear, angular = speeds.mean(), (speeds[1] - speeds[0]) / WHEEL_BASE_M
        middle = heading + angular * seconds / 2
        x, y = x + linear * seconds * np.cos(middle), y + linear * seconds * np.sin(middle)
        heading += angular * seconds
    return np.array([x, y, np.cos(heading), np.sin(heading), linear, angular], np.float32)

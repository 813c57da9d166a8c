"""Both environments pass Gymnasium's own checks."""

import warnings

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import foreframe
from foreframe.gym import DreamEnv, SimulatorEnv, SimulatorStarts, drive

MODEL = "moving-flow"


def brightness(frame: np.ndarray, state: np.ndarray | None, action: np.ndarray) -> float:
    return float(frame.mean()) / 255


def test_the_simulator_passes_the_check(client: foreframe.Client) -> None:
    env = SimulatorEnv(client, render_mode="rgb_array")
    assert env.action_space.high == pytest.approx([0.7, 1.92], abs=1e-3)
    check_env(env)
    env.close()


def test_the_dream_passes_the_check(client: foreframe.Client) -> None:
    starts = SimulatorStarts(client, client.spec(MODEL).context)
    env = DreamEnv(client, MODEL, starts, brightness, render_mode="rgb_array")
    assert env.action_space.high == pytest.approx([0.5, 0.8])
    check_env(env)
    env.close()
    starts.close()


def test_an_environment_that_the_server_dropped_is_made_again(client: foreframe.Client) -> None:
    whole, dropped = SimulatorEnv(client), SimulatorEnv(client)
    starts = SimulatorStarts(client, 5)
    for seed in (4, None, None, 7):
        expected, _ = whole.reset(seed=seed)
        drop(client, dropped._environment)
        found, _ = dropped.reset(seed=seed)
        assert np.array_equal(found["state"], expected["state"]) and np.array_equal(found["frame"], expected["frame"])
    drop(client, starts._environment)
    assert len(starts(np.random.default_rng(1)).frames) == 5
    for env in (whole, dropped, starts):
        env.close()
    with pytest.raises(foreframe.ApiError) as gone:
        starts._environment.reset()
    assert gone.value.status == 404, "it stays closed"


def drop(client: foreframe.Client, environment: foreframe.Environment) -> None:
    """The server deletes an environment, as it does when nobody steps it for a while."""
    client.run(foreframe.calls.delete_environment(environment.id))


@pytest.mark.parametrize("context", [1, 5])
def test_a_start_has_an_action_between_each_two_frames(client: foreframe.Client, context: int) -> None:
    starts = SimulatorStarts(client, context)
    start = starts(np.random.default_rng(1))
    starts.close()
    assert (len(start.frames), len(start.actions), len(start.states)) == (context, context - 1, context)


def test_a_dream_continues_on_its_own_frames(client: foreframe.Client) -> None:
    starts = SimulatorStarts(client, client.spec(MODEL).context)
    env = DreamEnv(client, MODEL, starts, brightness, max_steps=4)
    env.reset(seed=1)
    start = starts(np.random.Generator(np.random.PCG64(5)))
    frames, actions, states = list(start.frames), list(start.actions), list(start.states)
    env._starts = lambda random: start
    env.reset(seed=1)
    for number in range(4):
        action = np.array([0.3, 0.4], np.float32)
        observed, reward, terminated, truncated, info = env.step(action)
        alone = client.predict(
            MODEL, frames[-5:], actions=[*actions[-4:], action], state=states[-1], plan=[action], steps=1
        ).frames[0]
        assert np.abs(observed["frame"][:, :, 0].astype(int) - alone).max() <= 1
        frames.append(observed["frame"][:, :, 0])
        actions.append(action)
        states.append(observed["state"])
        assert (terminated, truncated) == (False, number == 3) and reward == brightness(frames[-1], None, action)
        assert 0 <= info["novelty"] <= 1
    env.close()
    starts.close()


def test_the_wheels_of_the_dream_are_those_of_the_simulator(client: foreframe.Client) -> None:
    with client.environment("moving-observer", seed=4) as environment:
        state = environment.observation.state
        for number in range(6):
            action = np.array([0.4, 0.8 if number < 3 else -0.6], np.float32)
            state = drive(state, action, 0.2)
            found = environment.step(action).observation.state
            assert state == pytest.approx(found, abs=0.02), number


def test_a_dream_needs_a_model_that_takes_actions(client: foreframe.Client) -> None:
    with pytest.raises(ValueError, match="takes no actions"):
        DreamEnv(client, "static-flow", lambda random: None, brightness)

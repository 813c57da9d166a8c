"""Checks OpenEnv's interface with the client and the validator of its package, unmodified: openenv_client.py HOST:PORT KEY.

Prints a line for each call. The server asks for KEY, which the client sends as the password of its address.
"""

import asyncio
import base64
import io
import sys

import numpy as np
import requests
from openenv.cli._validation import validate_running_environment
from openenv.core.env_server.types import EnvironmentMetadata, HealthResponse, ResetResponse, SchemaResponse, State, StepResponse
from openenv.core.generic_client import GenericEnvClient
from PIL import Image

address, key = sys.argv[1], sys.argv[2]
base_url = f"http://robot:{key}@{address}/openenv/crowded"


def passed(call):
    print(f"{call}: ok")


def image(observation):
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(observation["frame"]))))


async def refused(call, code, words):
    try:
        await call
    except RuntimeError as error:
        assert f"code: {code}" in str(error) and words in str(error), error
        return
    raise AssertionError(f"not refused: {words}")


async def episodes():
    for wrong in (f"http://{address}/openenv/crowded", base_url.replace(key, "ffk_wrong"), base_url.replace("crowded", "moon")):
        try:
            await GenericEnvClient(wrong).connect()
            raise AssertionError(wrong)
        except ConnectionError as error:
            assert ("404" if "moon" in wrong else "401") in str(error), error
    passed("401 without the right key, 404 for an unknown scenario")

    async with GenericEnvClient(base_url) as env:
        state = await env.state()
        assert state["step_count"] == 0 and state["episode_id"] is None and state["scenario"] == "crowded"
        await refused(env.step({"action": [0.1, 0.0]}), "EXECUTION_ERROR", "has not been reset")
        first = await env.reset(seed=7, episode_id="mine")
        assert first.reward is None and not first.done and image(first.observation).ndim == 2
        driver = first.observation["info"]["policy_action"]
        second = await env.step({"action": driver})
        assert -1 <= second.reward <= 1 and second.observation["info"]["time_s"] > 0
        assert not np.array_equal(image(first.observation), image(second.observation))
        state = State.model_validate(await env.state())
        assert (state.episode_id, state.step_count) == ("mine", 1)
        passed("reset, step and state")

        again = await env.reset(seed=7)
        assert again.observation["frame"] == first.observation["frame"] and (await env.state())["episode_id"] != "mine"
        assert (await env.step({"action": driver})).observation["frame"] == second.observation["frame"]
        assert (await env.reset()).observation["frame"] != first.observation["frame"]
        passed("the same seed and actions give the same frames")

        for action in ([0.1], [0.1, 0.2, 0.3]):
            await refused(env.step({"action": action}), "VALIDATION_ERROR", "action")
        await refused(env.step({"wheel": 1}), "VALIDATION_ERROR", "data.action is missing")
        await refused(env.step({"action": "left"}), "VALIDATION_ERROR", "invalid type")
        await refused(env.reset(seed=-1), "VALIDATION_ERROR", "seed")
        await refused(env._send_and_receive({"type": "jump"}), "UNKNOWN_TYPE", "must be reset")
        await env._ws.send("{")
        assert '"INVALID_JSON"' in await env._ws.recv()
        steps = 0
        result = await env.reset(seed=7)
        while not result.done and steps < 600:
            result, steps = await env.step({"action": result.observation["info"]["policy_action"]}), steps + 1
        assert result.done
        await refused(env.step({"action": driver}), "EXECUTION_ERROR", "over")
        passed("errors in the server's words, and an episode to its end")

    with GenericEnvClient(base_url.replace("crowded", "moving-observer")).sync() as env:
        assert env.reset(seed=1).observation["state"] and env.step({"action": [0.2, 0.1]}).reward is not None
    passed("the client's other form, and another scenario")


asyncio.run(episodes())

ResetResponse.model_validate(requests.post(f"{base_url}/reset", json={"seed": 7}).json())
StepResponse.model_validate(requests.post(f"{base_url}/step", json={"action": {"action": [0.1, 0.0]}}).json())
State.model_validate(requests.get(f"{base_url}/state").json())
SchemaResponse.model_validate(requests.get(f"{base_url}/schema").json())
EnvironmentMetadata.model_validate(requests.get(f"{base_url}/metadata").json())
HealthResponse.model_validate(requests.get(f"{base_url}/health").json())
assert requests.post(f"{base_url}/step", json={"action": {"action": [1]}}).status_code == 422
assert requests.post(f"http://{address}/openenv/crowded/reset", json={}).status_code == 401
passed("requests without a socket")

report = validate_running_environment(base_url)
assert report["passed"], report
passed("the package's validator")

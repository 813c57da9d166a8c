"""Checks the sessions of vLLM-Omni's world-model environment against that package's own request and response classes:
world_model_env.py SERVER FRAMES KEY.

Prints a line for each call. The package has no client; its classes are read from their file, because the package itself needs vLLM.
SERVER is http://HOST:PORT; it serves the shipped models and asks for KEY. FRAMES has frames, actions and states.
"""

import base64
import importlib.util
import json
import pathlib
import sys

import httpx
import numpy as np
from PIL import Image

server, directory, key = sys.argv[1], pathlib.Path(sys.argv[2]), sys.argv[3]
package = pathlib.Path(importlib.util.find_spec("vllm_omni").submodule_search_locations[0])
spec = importlib.util.spec_from_file_location("rollout", package / "entrypoints/openai/protocol/rollout.py")
rollout = importlib.util.module_from_spec(spec)
sys.modules["rollout"] = rollout
spec.loader.exec_module(rollout)

trace = json.loads((directory / "actions.json").read_text())
frames = [np.asarray(Image.open(directory / f"frame-{number:03}.png").convert("L")) for number in range(7)]
SESSIONS = "/v1/realtime/sessions"
client = httpx.Client(base_url=server, headers={"Authorization": f"Bearer {key}"})


def step(session, number, status=200, images=None, action=None, **more):
    observation = rollout.Observation(
        images={"front": frames[number].tolist()} if images is None else images, state=trace["states"][number], prompt="drive"
    )
    action = rollout.Action(joint_positions=trace["actions"][number] if action is None else action)
    request = rollout.RolloutStepRequest(**{"step_id": number, "observation": observation, "action": action, **more})
    found = client.post(f"{SESSIONS}/{session}/step", content=request.model_dump_json(), headers={"Content-Type": "application/json"})
    assert found.status_code == status, (found.status_code, found.text[:300])
    answer = rollout.RolloutStepResponse.model_validate(found.json())
    assert (answer.error is None) == (status == 200) and answer.step_id == request.step_id
    return answer


def refused(session, number, status, code, words, **more):
    answer = step(session, number, status, **more)
    assert answer.error.code == code and words in answer.error.message, answer.error
    assert answer.next_observation is None and answer.error.committed_step_id == answer.model_metadata.committed_step_id


def state(session):
    return rollout.SessionStatusResponse.model_validate(client.get(f"{SESSIONS}/{session}/status").json())


def passed(call):
    print(f"{call}: ok")


assert httpx.post(server + SESSIONS, json={"model": "moving-flow"}).status_code == 401
passed("401 without a key")

opened = client.post(SESSIONS, content=rollout.CreateSessionRequest(model="moving-flow").model_dump_json(), headers={"Content-Type": "application/json"})
opened = rollout.CreateSessionResponse.model_validate(opened.json())
session = opened.session_id
assert opened.mode == "world_model_env" and opened.created_at > 1.7e9 and state(session).committed_step_id == -1
passed("create")

for number in range(4):
    answer = step(session, number)
    assert answer.next_observation is None and answer.model_metadata.steps_generated == 0
    assert answer.model_metadata.committed_step_id == number
answer = step(session, 4)
found, about = answer.next_observation, answer.model_metadata
assert found["encoding"] == "base64_raw_tensor" and found["shape"] == [5, 64, 64] and about.steps_generated == 5
predicted = np.frombuffer(base64.b64decode(found["video"]), found["dtype"]).reshape(found["shape"])
error = np.mean((predicted[0] / 255 - frames[5] / 255) ** 2)
assert error < np.mean((frames[4] / 255 - frames[5] / 255) ** 2)
assert about.uncertainty == found["mse_band_90"][0][1] and 0 <= found["novelty"] <= 1 and about.latency_ms > 0
assert (about.committed_step_id, about.context_length) == (4, 5)
passed("steps, with the next observation and its uncertainty")

refused(session, 4, 400, "step_already_committed", "step 5 is next")
refused(session, 6, 400, "step_out_of_order", "step 5 is next")
refused(session, 5, 400, "invalid_request", "without the session's context", use_session_context=False)
refused(session, 5, 400, "invalid_request", "takes 64×64", images={"front": [[0, 0], [0, 0]]})
refused(session, 5, 400, "invalid_request", "whole number", images={"front": [[0.5]]})
refused(session, 5, 400, "invalid_request", "one image", images={})
refused(session, 5, 400, "invalid_request", "action", action=[1.0])
refused("nothing", 0, 404, "session_not_found", "there is no session")
assert client.post(f"{SESSIONS}/{session}/step", json={"step_id": 5}).status_code == 422
assert client.post(SESSIONS, json={"model": "nothing"}).status_code == 404
assert client.post(SESSIONS, json={"model": "moving-flow", "mode": "policy_inference"}).status_code == 422
assert step(session, 5).model_metadata.committed_step_id == 5
passed("errors in the server's words, and the session goes on")

reset = rollout.ResetSessionResponse.model_validate(client.post(f"{SESSIONS}/{session}/reset").json())
assert reset.committed_step_id == -1 and state(session).context_length == 0
assert step(session, 0, images={"front": np.repeat(frames[0][..., None], 3, 2).tolist()}).model_metadata.committed_step_id == 0
passed("reset, and an image with colours")

assert client.post(f"{SESSIONS}/{session}/close").json() == {"session_id": session, "closed": True}
assert client.post(f"{SESSIONS}/{session}/close").status_code == 200 and state(session).closed and state(session).committed_step_id == 0
refused(session, 1, 410, "session_closed", "closed")
assert client.post(f"{SESSIONS}/{session}/reset").status_code == 410 and client.get(f"{SESSIONS}/nothing/status").status_code == 404
passed("close")

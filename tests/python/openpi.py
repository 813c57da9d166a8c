"""Checks openpi's WebSocket with the client that its users have, unmodified: openpi.py HOST PORT FRAMES KEY.

Prints a line for each call. The server serves the shipped models and asks for KEY. FRAMES has frames, actions and states.
"""

import json
import pathlib
import sys

import msgpack
import numpy as np
from openpi_client import msgpack_numpy
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from PIL import Image
from websockets.exceptions import ConnectionClosed, InvalidStatus

host, port, directory, key = sys.argv[1], int(sys.argv[2]), pathlib.Path(sys.argv[3]), sys.argv[4]
trace = json.loads((directory / "actions.json").read_text())
images = [Image.open(directory / f"frame-{number:03}.png").convert("L") for number in range(6)]
frames = [np.asarray(image) for image in images]


def observation(number, **more):
    return {
        "model": "moving-flow",
        "frame": frames[number],
        "state": np.array(trace["states"][number], np.float32),
        "actions": np.array(trace["actions"][number : number + 5]),
        **more,
    }


def passed(call):
    print(f"{call}: ok")


def refused(words, **more):
    try:
        policy.infer(observation(0, **more))
    except RuntimeError as error:
        assert words in str(error), error
        return
    raise AssertionError(f"not refused: {words}")


for wrong in (None, "ffk_wrong"):
    try:
        WebsocketClientPolicy(host, port, api_key=wrong)
        raise AssertionError("a key is needed")
    except InvalidStatus as error:
        assert error.response.status_code == 401, error
passed("401 without the right key")

policy = WebsocketClientPolicy(host, port, api_key=key)
about = policy.get_server_metadata()
assert about["server"] == "foreframe" and about["model"] == "home" and "moving-flow" in about["models"] and about["spec"]["context"] == 5
passed("metadata")

for number in range(4):
    answer = policy.infer(observation(number))
    assert answer["missing"] == 4 - number and "frames" not in answer, answer
answer = policy.infer(observation(4))
predicted = answer["frames"]
assert (answer["missing"], answer["model"], predicted.shape, predicted.dtype) == (0, "moving-flow", (5, 64, 64), np.uint8)
assert answer["expected_mse"].shape == (5,) and answer["mse_band_90"].shape == (5, 2) and 0 <= answer["novelty"] <= 1
error = np.mean((predicted[0] / 255 - frames[5] / 255) ** 2)
assert error < np.mean((frames[4] / 255 - frames[5] / 255) ** 2)
passed("the context is gathered, then frames are predicted")

answer = policy.infer(observation(5, steps=2, actions=observation(5)["actions"][:2]))
assert answer["frames"].shape == (2, 64, 64) and answer["frames"].flags["C_CONTIGUOUS"]
held = {name: value for name, value in observation(5).items() if name != "actions"}
assert policy.infer({**held, "action": [0.3, 0.0]})["frames"].shape == (5, 64, 64)
passed("steps, and one action that is held")

assert policy.infer(observation(0, reset=True))["missing"] == 4
assert policy.infer({"endpoint": "reset"}) == {"status": "reset successful"}
for number in range(4):
    colour = np.asarray(images[number].resize((128, 96)).convert("RGB"))
    policy.infer(observation(number, frame=colour, resize="stretch"))
assert policy.infer(observation(4))["missing"] == 0
passed("reset, colour and resize")

refused("takes 64×64", frame=np.zeros((32, 64), np.uint8))
refused("must be uint8", frame=frames[0] / 255)
refused("state is missing", state=None)
refused("has the shape [5, 64, 64]", frame=np.stack(frames[:5]))
refused("actions holds 3", actions=np.zeros((3, 2)))
refused("no model", model="nothing")
refused("unknown field `prompt`", prompt="drive on")
assert policy.infer(observation(5))["missing"] == 0
passed("errors in the server's words, and the session goes on")

for damaged in (b"", b"\xc1", msgpack.packb([1]), msgpack_numpy.packb({"frame": frames[0]})[:-9]):
    policy._ws.send(damaged)
    assert "not an observation" in policy._ws.recv(), damaged
assert policy.infer(observation(5))["missing"] == 0
passed("damaged messages")

other = WebsocketClientPolicy(f"ws://{host}:{port}/v1/models/static-flow/openpi", api_key=key)
assert other.get_server_metadata()["model"] == "static-flow"
assert other.infer({"frame": frames[0]})["missing"] == 4
passed("a model by its path")

try:
    other.infer({"frame": np.zeros((4000, 4000), np.uint8)})
    raise AssertionError("too long")
except RuntimeError as error:
    assert "Message too long" in str(error), error
except ConnectionClosed as error:
    # The client can notice the close while it still sends.
    assert error.rcvd and error.rcvd.code == 1009, error
passed("a message over the limit")

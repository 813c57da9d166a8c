"""Checks the Open Inference Protocol with the client that its users have, unmodified: inference_protocol.py SERVER FRAMES KEY.

Prints a line for each call. SERVER is HOST:PORT; it serves `moving-flow` and asks for KEY. FRAMES has frames, actions and states.
"""

import json
import pathlib
import sys

import numpy as np
import tritonclient.http as triton
from PIL import Image
from tritonclient.utils import InferenceServerException

address, directory = sys.argv[1], pathlib.Path(sys.argv[2])
MODEL = "moving-flow"
trace = json.loads((directory / "actions.json").read_text())
frames = np.stack([np.asarray(Image.open(directory / f"frame-{number:03}.png").convert("L")) for number in range(5)])
state = np.array(trace["states"][4], np.float32)
plan = np.array(trace["actions"][4:9], np.float32)
client = triton.InferenceServerClient(address)


def key():
    # The client adds headers to the dictionary that it is given.
    return {"Authorization": f"Bearer {sys.argv[3]}"}


def tensor(name, values, binary=True):
    given = triton.InferInput(name, list(values.shape), "UINT8" if values.dtype == np.uint8 else "FP32")
    given.set_data_from_numpy(values, binary_data=binary)
    return given


def passed(call):
    print(f"{call}: ok")


def refused(words, **request):
    try:
        client.infer(request.pop("model", MODEL), **{"headers": key(), **request})
    except InferenceServerException as error:
        assert words in error.message(), error
        return
    raise AssertionError(f"not refused: {words}")


assert client.is_server_live() and client.is_server_ready()
passed("live and ready, without a key")
about = client.get_server_metadata()
assert about["name"] == "foreframe" and "binary_tensor_data" in about["extensions"]
passed("server metadata")
try:
    client.get_model_metadata(MODEL)
    raise AssertionError("a key is needed")
except InferenceServerException as error:
    assert error.status() == "401" and "key" in error.message()
passed("401 without a key")

assert client.is_model_ready(MODEL, headers=key()) and client.is_model_ready(MODEL, "1", headers=key())
assert not client.is_model_ready("nothing", headers=key()) and not client.is_model_ready(MODEL, "7", headers=key())
passed("model ready")
described = client.get_model_metadata(MODEL, headers=key())
assert [(i["name"], i["datatype"], i["shape"]) for i in described["inputs"]][0] == ("frames", "UINT8", [5, 64, 64])
assert described["versions"] == ["1"] and described == client.get_model_metadata(MODEL, "1", headers=key())
passed("model metadata")
config = client.get_model_config(MODEL, headers=key())
assert config["max_batch_size"] == 0 and config["input"][0]["data_type"] == "TYPE_UINT8"
passed("model config")
index = client.get_model_repository_index(headers=key())
assert {"name": MODEL, "version": "1", "state": "READY", "reason": ""} in index
passed("repository index")

answer = client.infer(MODEL, [tensor("frames", frames), tensor("state", state), tensor("plan", plan)], request_id="a", headers=key())
predicted = answer.as_numpy("predicted")
assert predicted.shape == (5, 64, 64) and predicted.dtype == np.uint8 and answer.get_response()["id"] == "a"
assert answer.as_numpy("expected_mse").shape == (5,) and answer.as_numpy("mse_band_90").shape == (5, 2)
assert 0 <= answer.as_numpy("novelty")[0] <= 1
true = np.asarray(Image.open(directory / "frame-005.png").convert("L")) / 255
assert np.mean((predicted[0] / 255 - true) ** 2) < np.mean((frames[4] / 255 - true) ** 2)
passed("infer UINT8, binary in both directions")

text = [tensor("frames", frames, False), tensor("state", state, False), tensor("plan", plan, False)]
outputs = [triton.InferRequestedOutput("predicted", binary_data=False)]
answer = client.infer(MODEL, text, model_version="1", outputs=outputs, headers=key())
assert np.array_equal(answer.as_numpy("predicted"), predicted) and len(answer.get_response()["outputs"]) == 1
passed("infer UINT8, JSON in both directions, one output")

floats = tensor("frames", (frames / 255).astype(np.float32)[None])
mixed = [floats, tensor("state", state, False), tensor("plan", plan)]
both = [triton.InferRequestedOutput("novelty", binary_data=False), triton.InferRequestedOutput("predicted")]
answer = client.infer(MODEL, mixed, outputs=both, headers=key())
assert np.abs(answer.as_numpy("predicted") * 255 - predicted).max() < 0.01
passed("infer FP32, mixed binary and JSON")

plans = np.stack([np.tile(np.float32([0.3, turn]), (3, 1)) for turn in (-0.5, 0.0, 0.5)])
inputs = [tensor("frames", frames), tensor("state", state), tensor("plans", plans)]
answer = client.infer(MODEL, inputs, parameters={"steps": 3}, headers=key())
assert answer.as_numpy("predicted").shape == (3, 3, 64, 64) and answer.as_numpy("mse_band_90").shape == (3, 3, 2)
passed("infer with plans")

pending = [client.async_infer(MODEL, inputs, parameters={"steps": 3}, headers=key()) for _ in range(2)]
assert all(found.get_result().as_numpy("predicted").shape[0] == 3 for found in pending)
passed("async infer")

fast = tensor("plan", np.tile(np.float32([9, 0]), (5, 1)))
answer = client.infer(MODEL, [tensor("frames", frames), tensor("state", state), fast], headers=key())
assert "action linear is 9 m/s" in answer.get_response()["parameters"]["warnings"]
passed("warnings")

rest = [tensor("state", state), tensor("plan", plan)]
context = [tensor("frames", frames), *rest]
refused("state is missing", inputs=[tensor("frames", frames), rest[1]])
refused("no model", model="nothing", inputs=context)
refused("is not active", model_version="7", inputs=context)
refused("takes 5", inputs=[tensor("frames", frames[:4]), *rest])
refused("has the shape [5, 32, 64]", inputs=[tensor("frames", frames[:, :32].copy()), *rest])
refused("input \"colour\" is unknown", inputs=[*context, tensor("colour", state)])
refused("output \"depth\" is unknown", inputs=context, outputs=[triton.InferRequestedOutput("depth")])
refused("intensity from 0 to 1", inputs=[tensor("frames", frames.astype(np.float32)), *rest])
refused("sequences are not supported", inputs=context, sequence_id=1, sequence_start=True)
refused("Content-Encoding", inputs=context, request_compression_algorithm="gzip")
passed("errors in the server's words")

counts = client.get_inference_statistics(MODEL, headers=key())["model_stats"][0]
assert counts["inference_count"] == 7 and counts["inference_stats"]["fail"]["count"] > 0, counts
assert len(client.get_inference_statistics(headers=key())["model_stats"]) == len(index)
passed("statistics")

"""Exported models predict as the NumPy forward passes of examples/predict.py do, and as the server does."""

import importlib.util
import json
import re
import shutil
import struct
import subprocess
import sys
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import MODELS, ROOT, Drive

import foreframe

pytest.importorskip("onnx", reason="the extra foreframe[onnx] is not installed")
onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime runs the exported models")
pytest.importorskip("PIL", reason="examples/predict.py imports Pillow")

from foreframe.export_onnx import UnsupportedModel, export_onnx  # noqa: E402

NAMES = sorted(path.parent.name for path in MODELS.glob("*/manifest.json"))
DENSE, FLOW = ["moving", "static"], ["moving-flow", "rooms"]
#: Of full scale. Sums are in another order, and NumPy computes places in float64.
TOLERANCE = 1e-5
#: At sharp edges, rounding moves a place and so changes the depth found there.
DEPTH_TOLERANCE = 5e-5

Window = dict[str, np.ndarray]


def numpy_networks() -> Any:
    spec = importlib.util.spec_from_file_location("predict", ROOT / "examples" / "predict.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class ByNumpy:
    """A model's directory by the forward passes in NumPy."""

    def __init__(self, directory: Path) -> None:
        self.module = numpy_networks()
        manifest, self.tensors = self.module.read_model(directory)
        self.spec = manifest["spec"]
        self.flow = self.spec.get("flow", {})
        #: How far the camera is above the one by which a room was learned.
        self.above_m = 0.0

    def window(self, drive: Drive, last: int) -> Window:
        """The inputs of the window of a drive that ends with its frame ``last``, without the batch."""
        context, horizon = self.spec["context"], self.spec["horizon"]
        seen = slice(last + 1 - context, last + 1)
        given = {"frames": drive.frames[seen] / 255}
        if "action" in self.spec["conditioning"]:
            given["actions"] = self.in_range(drive.actions[last : last + horizon], self.spec["actions"])
        if self.flow.get("depth"):
            given["states"] = drive.states[seen]
            given["camera"] = np.array(list(self.spec["camera"].values()))
        elif "state" in self.spec["conditioning"]:
            given["state"] = drive.states[last]
        return {name: values.astype(np.float32) for name, values in given.items()}

    def in_range(self, values: np.ndarray, channels: list[dict[str, Any]]) -> np.ndarray:
        """The values themselves, or for a model with other channels than the drive as far from the mean as they are from 0."""
        if channels[0]["unit"] == "m/s":
            return values
        return np.array([channel["mean"] for channel in channels]) + values * [channel["std"] for channel in channels]

    def predict(self, window: Window) -> np.ndarray:
        state = window.get("states", window.get("state"))
        if not self.flow:
            frames = self.module.predict_dense(self.spec, self.tensors, window["frames"], window.get("actions"), state)
        else:
            frames = self.network().predict(list(window["frames"]), window.get("actions"), state)
        return np.stack(frames)

    def network(self) -> Any:
        kind = self.module.DepthNetwork if self.flow["depth"] else self.module.FlowNetwork
        network = kind(self.spec, self.tensors)
        origin = network.origin
        network.origin = lambda pose: origin(pose) + np.array([0, 0, self.above_m / network.room()[1]])
        return network


class ByOnnx:
    """An exported model in onnxruntime."""

    def __init__(self, directory: Path, step: bool = False) -> None:
        model = export_onnx(directory, step=step)
        self.session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])

    def __call__(self, *windows: Window) -> dict[str, np.ndarray]:
        """The outputs of a batch."""
        batch = {name: np.stack([window[name] for window in windows]) for name in windows[0]}
        names = [output.name for output in self.session.get_outputs()]
        return dict(zip(names, self.session.run(None, batch)))


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_of_windows_is_as_by_numpy_and_by_the_server(name: str, client: foreframe.Client, drive: Drive) -> None:
    by_numpy = ByNumpy(MODELS / name)
    tolerance = DEPTH_TOLERANCE if by_numpy.flow.get("depth") else TOLERANCE
    windows = [by_numpy.window(drive, last) for last in (4, 6)]
    for window, predicted in zip(windows, ByOnnx(MODELS / name)(*windows)["predicted"], strict=True):
        assert np.abs(predicted - by_numpy.predict(window)).max() < tolerance
        levels = np.rint(window["frames"] * 255).astype(np.uint8)
        known = {key: window[key] for key in ("state", "states") if key in window}
        served = client.predict(name, levels, plan=window.get("actions"), **known).frames
        # The server rounds to a level.
        assert np.abs(predicted * 255 - served).max() < 0.5 + 255 * tolerance


@pytest.mark.parametrize("name", DENSE)
def test_steps_of_a_stream_predict_what_windows_predict(name: str, drive: Drive) -> None:
    by_numpy, step, window = ByNumpy(MODELS / name), ByOnnx(MODELS / name, step=True), ByOnnx(MODELS / name)
    spec = by_numpy.spec
    features = np.zeros((spec["context"] - 1, spec["features"]), np.float32)
    for at in range(7):
        known = by_numpy.window(drive, max(at, spec["context"] - 1))
        del known["frames"]
        frame = drive.frames[at].astype(np.float32) / 255
        answer = step(known | {"frame": frame, "past_features": features})
        features = answer["next_features"][0]
        if at >= spec["context"] - 1:
            expected = window(by_numpy.window(drive, at))["predicted"]
            assert np.abs(answer["predicted"] - expected).max() < TOLERANCE


def test_depth_and_movers_are_as_by_numpy(drive: Drive) -> None:
    by_numpy = ByNumpy(MODELS / "rooms")
    module, network, window = by_numpy.module, by_numpy.network(), by_numpy.window(drive, 4)
    depths: list[np.ndarray] = []
    states: list[np.ndarray] = []
    encoded, refined, step = network.encoded, network.refined, network.step_with_depth

    def kept(values: np.ndarray) -> np.ndarray:
        states.append(values)
        return values

    def step_of(number: int, last: Any, coarse: Any, depth: np.ndarray, *rest: Any) -> Any:
        depths.append(depth)
        return step(number, last, coarse, depth, *rest)

    network.encoded, network.refined = lambda x: kept(encoded(x)), lambda z, m: kept(refined(z, m))
    network.step_with_depth = step_of
    network.predict(list(window["frames"]), window["actions"], window["states"])
    answer = ByOnnx(MODELS / "rooms")(window)
    assert np.abs(answer["depth"][0] / depths[0] - 1).max() < TOLERANCE
    for number, (state, movers) in enumerate(zip(states, answer["movers"][0], strict=True)):
        name = "flow.movers." + ("coming" if number else "seen")
        logits = module.shuffle(module.shuffle(module.dense(module.silu(state), by_numpy.tensors, name)))[..., 0]
        assert np.abs(movers - logits).max() < 100 * TOLERANCE


@pytest.mark.parametrize("name", ["rooms", "home"])
def test_another_camera_gives_another_prediction(name: str, drive: Drive) -> None:
    by_numpy = ByNumpy(MODELS / name)
    window = by_numpy.window(drive, 5)
    camera = {"horizontal_fov_rad": 1.0, "tilt_down_rad": 0.35, "height_m": 0.3}
    by_numpy.above_m = camera["height_m"] - by_numpy.spec["camera"]["height_m"]
    by_numpy.spec["camera"] = camera
    other = window | {"camera": np.array(list(camera.values()), np.float32)}
    own, predicted = ByOnnx(MODELS / name)(window, other)["predicted"]
    assert np.abs(predicted - by_numpy.predict(window)).max() < DEPTH_TOLERANCE
    assert np.abs(predicted - own).max() > 0.01


def write_model(directory: Path, manifest: dict[str, Any], tensors: dict[str, np.ndarray]) -> None:
    header, data = {}, b""
    for name, values in tensors.items():
        content = values.astype("<f4").tobytes()
        header[name] = {"dtype": "F32", "shape": values.shape, "data_offsets": [len(data), len(data) + len(content)]}
        data += content
    text = json.dumps(header).encode()
    weights = struct.pack("<Q", len(text)) + text + data
    (directory / "model.safetensors").write_bytes(weights)
    (directory / "manifest.json").write_text(json.dumps(manifest | {"weights_sha256": sha256(weights).hexdigest()}))


def test_the_recurrent_form_is_as_by_numpy(drive: Drive, tmp_path: Path) -> None:
    """No shipped model has it: the weights of `static-flow`, and random ones for what it has not."""
    manifest, tensors = numpy_networks().read_model(MODELS / "static-flow")
    manifest["spec"]["flow"]["recurrent"] = True
    channels = manifest["spec"]["flow"]["channels"]
    inputs = channels + 32 + 16
    tensors["flow.advance.weight"] = np.random.default_rng(1).normal(size=(inputs, channels)) / inputs
    tensors["flow.advance.bias"] = np.zeros(channels)
    write_model(tmp_path, manifest, tensors)
    by_numpy = ByNumpy(tmp_path)
    window = by_numpy.window(drive, 4)
    assert np.abs(ByOnnx(tmp_path)(window)["predicted"][0] - by_numpy.predict(window)).max() < TOLERANCE


def test_the_example_predicts_by_depth_without_states(tmp_path: Path) -> None:
    """No shipped model has no states and estimates depth: the weights of `rooms` that such a model has."""
    manifest, tensors = numpy_networks().read_model(MODELS / "rooms")
    spec = manifest["spec"]
    name, steps = "flow.modulation.inputs.weight", spec["horizon"]
    first = len(tensors[name]) - steps - 3
    tensors[name] = tensors[name][first : first + steps]
    spec |= {"conditioning": "none", "actions": [], "states": [], "flow": spec["flow"] | {"memory": False}}
    write_model(tmp_path, manifest, tensors)
    command = [sys.executable, ROOT / "examples" / "predict.py", "--frames", ROOT / "examples" / "static"]
    done = subprocess.run([*command, "--model", tmp_path, "--out", tmp_path / "out"], capture_output=True, text=True)
    assert done.returncode == 0 and len(list((tmp_path / "out").iterdir())) == steps, done.stderr
    refused = subprocess.run([*command, "--model", MODELS / "rooms", "--out", tmp_path], capture_output=True, text=True)
    assert refused.returncode == 2 and "rooms takes state-action: give --actions" in refused.stderr


def test_what_cannot_be_exported_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedModel, match=r"not a directory with manifest\.json"):
        export_onnx(tmp_path)
    for name in FLOW:
        with pytest.raises(UnsupportedModel, match=f"{name} is a flow network, which has no step"):
            export_onnx(MODELS / name, step=True)
    manifest, tensors = numpy_networks().read_model(MODELS / "static")
    bias = tensors.pop("frame_decoder.bias")
    write_model(tmp_path, manifest, tensors)
    with pytest.raises(UnsupportedModel, match="no tensor 'frame_decoder.bias'"):
        export_onnx(tmp_path)
    manifest["spec"]["architecture"] = "transformer"
    write_model(tmp_path, manifest, tensors | {"frame_decoder.bias": bias})
    with pytest.raises(UnsupportedModel, match="'transformer'; dense and flow can be exported"):
        export_onnx(tmp_path)
    shutil.copy(MODELS / "static" / "manifest.json", tmp_path)
    with pytest.raises(UnsupportedModel, match="SHA-256"):
        export_onnx(tmp_path)


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("context", "5", "spec.context is '5'; it must be of the type int"),
        ("states", None, "spec.states is None"),
        ("features", 100, "do not have the shapes that manifest.json states"),
    ],
)
def test_a_damaged_specification_is_named(tmp_path: Path, field: str, value: Any, sentence: str) -> None:
    manifest, tensors = numpy_networks().read_model(MODELS / "moving")
    manifest["spec"][field] = value
    write_model(tmp_path, manifest, tensors)
    with pytest.raises(UnsupportedModel, match=re.escape(sentence)):
        export_onnx(tmp_path)


def test_a_flow_network_without_a_size_is_named(tmp_path: Path) -> None:
    manifest, tensors = numpy_networks().read_model(MODELS / "moving-flow")
    del manifest["spec"]["flow"]["channels"]
    write_model(tmp_path, manifest, tensors)
    with pytest.raises(UnsupportedModel, match="has no field 'channels'"):
        export_onnx(tmp_path)


@pytest.mark.parametrize("text", ["3", "[]", '{"name": "a"}', "{", '{"spec": [], "name": "a"}'])
def test_what_is_no_manifest_is_named(tmp_path: Path, text: str) -> None:
    shutil.copy(MODELS / "static" / "model.safetensors", tmp_path)
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(UnsupportedModel, match="not a manifest of Foreframe|is not JSON"):
        export_onnx(tmp_path)


def test_the_command_writes_the_file_and_says_what_it_takes(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "foreframe.export_onnx"]
    done = subprocess.run([*command, MODELS / "moving", tmp_path / "moving.onnx"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "takes frames [batch, 5, 64, 64]" in done.stdout and "gives predicted [batch, 5, 64, 64]" in done.stdout
    assert onnxruntime.InferenceSession(tmp_path / "moving.onnx").get_modelmeta().graph_name == "moving"
    absent = tmp_path / "absent" / "x.onnx"
    unwritten = subprocess.run([*command, MODELS / "moving", absent], capture_output=True, text=True)
    assert unwritten.returncode == 1 and "absent" in unwritten.stderr and unwritten.stderr.count("\n") == 1
    failed = subprocess.run([*command, tmp_path, tmp_path / "x.onnx"], capture_output=True, text=True)
    assert failed.returncode == 1 and failed.stderr.startswith("error: ") and not (tmp_path / "x.onnx").exists()

"""`foreframe bridge` with a robot that the Foxglove SDK plays.

    foxglove_bridge.py PROGRAM MODELS FRAMES [CERTIFICATE KEY]

With a certificate and its key as PEM files, the robot speaks wss://, for which the program needs the feature tls.
"""

import base64
import io
import json
import pathlib
import re
import struct
import subprocess
import sys
import threading
import time

import foxglove
import numpy
from foxglove import Channel, Schema
from foxglove.channels import CompressedImageChannel, RawImageChannel
from foxglove.messages import CompressedImage, RawImage
from foxglove.websocket import Capability, ServerListener
from PIL import Image

PERIOD_S = 0.2
HORIZON = 5


class Listener(ServerListener):
    """What the bridge publishes, by topic."""

    def __init__(self):
        self.published = {}
        self.came = threading.Condition()

    def on_message_data(self, client, client_channel_id, data):
        with self.came:
            self.published.setdefault(client_channel_id, []).append(bytes(data))
            self.came.notify_all()

    def on_client_advertise(self, client, channel):
        with self.came:
            self.published[channel.id] = []
            self.topics = {**getattr(self, "topics", {}), channel.topic: channel.id}
            self.came.notify_all()

    def of(self, topic):
        return self.published[self.topics[topic]]

    def wait(self, holds, what):
        with self.came:
            assert self.came.wait_for(holds, timeout=60), f"never: {what}"


def twist(linear, angular):
    return b"\0\1\0\0" + struct.pack("<6d", linear, 0, 0, 0, 0, angular)


def odometry(x, y, cos, sin, linear, angular):
    """Header, child frame, pose with covariance, twist with covariance; numbers start at multiples of their size."""
    heading = numpy.arctan2(sin, cos)
    head = struct.pack("<iI", 0, 0) + struct.pack("<I", 5) + b"odom\0" + b"\0" * 3 + struct.pack("<I", 5) + b"base\0"
    head += b"\0" * (-len(head) % 8)
    pose = struct.pack("<7d", x, y, 0, 0, 0, numpy.sin(heading / 2), numpy.cos(heading / 2)) + bytes(36 * 8)
    return b"\0\1\0\0" + head + pose + struct.pack("<6d", linear, 0, 0, 0, 0, angular) + bytes(36 * 8)


def picture(message):
    return numpy.asarray(Image.open(io.BytesIO(message[message.index(b"\x89PNG") :]))) / 255


def json_image(path, compressed):
    """A message of the schemas CompressedImage and RawImage in JSON."""
    pixels = numpy.asarray(Image.open(path).convert("L"))
    height, width = pixels.shape
    own = {"format": "png"} if compressed else {"width": width, "height": height, "encoding": "mono8", "step": width}
    data = base64.b64encode(path.read_bytes() if compressed else pixels.tobytes()).decode()
    return json.dumps({"timestamp": {"sec": 0, "nsec": 0}, "frame_id": "camera", "data": data, **own}).encode()


class CdrRobot:
    """Commands and odometry as a robot with ROS 2 has them. Only the names of the schemas count for the bridge."""

    encoding, arguments = "cdr", []
    schemas = {"encoding": "ros2msg", "data": b""}
    command, state = "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry"
    twist, odometry = staticmethod(twist), staticmethod(odometry)


def speeds(linear, angular):
    return {"linear": {"x": linear, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": angular}}


class JsonRosRobot(CdrRobot):
    """The same in JSON."""

    encoding, schemas = "json", {"encoding": "jsonschema", "data": b"{}"}

    @staticmethod
    def twist(linear, angular):
        return json.dumps(speeds(linear, angular)).encode()

    @staticmethod
    def odometry(x, y, cos, sin, linear, angular):
        heading = numpy.arctan2(sin, cos)
        pose = {"position": {"x": x, "y": y, "z": 0}, "orientation": {"x": 0, "y": 0, "z": numpy.sin(heading / 2), "w": numpy.cos(heading / 2)}}
        return json.dumps({"header": {}, "pose": {"pose": pose}, "twist": {"twist": speeds(linear, angular)}}).encode()


class OwnJsonRobot(JsonRosRobot):
    """JSON with types and names of its own, for which the topics are named."""

    command, state = "robot.Command", "robot.State"
    arguments = ["--action", "/cmd_vel", "--state", "/odom"]

    @staticmethod
    def twist(linear, angular):
        return json.dumps({"timestamp": {"sec": 0, "nsec": 0}, "linear": linear, "angular": angular, "mode": "auto"}).encode()

    @staticmethod
    def odometry(*values):
        return json.dumps(dict(zip(["x", "y", "heading_cos", "heading_sin", "linear", "angular"], values))).encode()


def drive(robot, compressed, as_json):
    """Plays the recorded frames as a robot, and compares what the bridge says of them."""
    program, models, frames = sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3])
    tls = [pathlib.Path(path) for path in sys.argv[4:6]]
    listener = Listener()
    context = foxglove.Context()
    identity = {"tls_cert": tls[0].read_bytes(), "tls_key": tls[1].read_bytes()} if tls else {}
    server = foxglove.start_server(
        name="test robot", port=0, capabilities=[Capability.ClientPublish], supported_encodings=["cdr"], server_listener=listener, context=context, **identity
    )
    if as_json:
        schema = Schema(name="foxglove." + ("CompressedImage" if compressed else "RawImage"), encoding="jsonschema", data=b"{}")
        camera = Channel("/camera", schema=schema, message_encoding="json", context=context)
    else:
        camera = (CompressedImageChannel if compressed else RawImageChannel)("/camera", context=context)
    command = Channel("/cmd_vel", schema=Schema(name=robot.command, **robot.schemas), message_encoding=robot.encoding, context=context)
    odom = Channel("/odom", schema=Schema(name=robot.state, **robot.schemas), message_encoding=robot.encoding, context=context)
    address = [f"wss://localhost:{server.port}", "--ca-certificate", str(tls[0])] if tls else [f"ws://127.0.0.1:{server.port}"]
    bridge = subprocess.Popen(
        [program, "bridge", *address, "--model", "moving-flow", "--models-dir", models, *robot.arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    lines = [bridge.stdout.readline().strip() for _ in range(4)]
    assert lines[0] == 'connected to "test robot"' and sorted(lines[1:]) == ["action: /cmd_vel", "image: /camera", "state: /odom"], lines
    listener.wait(lambda: len(listener.published) == 3, "three topics")
    # The subscriptions come after what the bridge says.
    time.sleep(0.5)
    recorded = json.loads((frames / "actions.json").read_text())
    paths = sorted(frames.glob("*.png"), key=lambda path: int(re.findall(r"\d+", path.name)[-1]))
    seen, start_ns = [], time.time_ns()
    for index, path in enumerate(paths):
        now_ns = start_ns + int(index * PERIOD_S * 1e9)
        seen.append(numpy.asarray(Image.open(path).convert("L")))
        height, width = seen[-1].shape
        command.log(robot.twist(*recorded["actions"][index]), log_time=now_ns)
        odom.log(robot.odometry(*recorded["states"][index]), log_time=now_ns)
        image = CompressedImage(data=path.read_bytes(), format="png") if compressed else RawImage(width=width, height=height, encoding="mono8", step=width, data=seen[-1].tobytes())
        camera.log(json_image(path, compressed) if as_json else image, log_time=now_ns)
        predictions = max(0, index + 1 - HORIZON + 1)
        listener.wait(lambda: len(listener.of("/foreframe/predicted")) >= predictions, f"prediction {predictions}")
    predicted = [picture(message) for message in listener.of("/foreframe/predicted")]
    listener.wait(lambda: len(listener.of("/foreframe/error")) == len(predicted) - HORIZON, "the last error")
    errors = [struct.unpack("<d", message[-8:])[0] for message in listener.of("/foreframe/error")]
    truth = seen[2 * HORIZON - 1 :]
    assert len(errors) == len(truth) > 0
    for error, prediction, frame in zip(errors, predicted, truth):
        own = float(numpy.mean((prediction - frame / 255) ** 2))
        assert abs(error - own) < 1e-6, (error, own)
    listener.wait(lambda: len(listener.of("/foreframe/expected_error")) == len(predicted), "the last expected error")
    mean, still = numpy.mean(errors), numpy.mean([numpy.mean((old / 255.0 - new / 255.0) ** 2) for old, new in zip(seen[HORIZON - 1 :], truth)])
    print(f"{robot.__name__}, {'compressed' if compressed else 'raw'} images in {'JSON' if as_json else 'Protocol Buffers'}: {len(predicted)} predictions, mean error {mean:.4f}; that of the last frame {still:.4f}")
    assert mean < still
    server.stop()
    assert bridge.wait(timeout=30) == 1, bridge.stderr.read()


for as_json in (False, True):
    for compressed in (True, False):
        drive(CdrRobot, compressed, as_json)
for robot in (JsonRosRobot, OwnJsonRobot):
    drive(robot, True, True)

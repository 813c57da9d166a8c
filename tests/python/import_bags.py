"""Writes bags with the packages rosbags and mcap, imports them with the program, and compares every frame and action. Then
exports one of the data sets as a bag, and reads it with both packages.

Usage: import_bags.py PROGRAM DIRECTORY. Needs rosbags, mcap, mcap-ros2-support, numpy, pillow and pyarrow.
"""

import io
import pathlib
import subprocess
import sys

import numpy as np
import pyarrow.parquet as parquet
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as McapWriter
from PIL import Image
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
FRAMES, HEIGHT, WIDTH = 20, 12, 16
# Name of the encoding, and how gray intensities are written in it.
ENCODINGS = {
    "mono8": lambda gray: gray,
    "rgb8": lambda gray: np.repeat(gray[..., None], 3, axis=2),
    "bgr8": lambda gray: np.repeat(gray[..., None], 3, axis=2),
    "rgba8": lambda gray: np.repeat(gray[..., None], 4, axis=2),
    "bgra8": lambda gray: np.repeat(gray[..., None], 4, axis=2),
    "mono16": lambda gray: gray.astype("<u2") * 257,
    "yuv422_yuy2": lambda gray: np.stack([gray, np.full_like(gray, 128)], axis=2),
    "uyvy": lambda gray: np.stack([np.full_like(gray, 128), gray], axis=2),
}


def gray(index):
    return ((np.arange(HEIGHT * WIDTH) * 5 + index * 7) % 256).astype(np.uint8).reshape(HEIGHT, WIDTH)


def header(time_ns):
    time = STORE.types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return STORE.types["std_msgs/msg/Header"](stamp=time, frame_id="camera")


def raw_image(time_ns, index, encoding):
    pixels = np.ascontiguousarray(ENCODINGS[encoding](gray(index))).view(np.uint8).reshape(-1)
    return STORE.types["sensor_msgs/msg/Image"](
        header=header(time_ns), height=HEIGHT, width=WIDTH, encoding=encoding, is_bigendian=0,
        step=len(pixels) // HEIGHT, data=pixels,
    )


def png_image(time_ns, index):
    file = io.BytesIO()
    Image.fromarray(gray(index)).save(file, "png")
    return STORE.types["sensor_msgs/msg/CompressedImage"](
        header=header(time_ns), format="png", data=np.frombuffer(file.getvalue(), np.uint8)
    )


def twist(value):
    vector = STORE.types["geometry_msgs/msg/Vector3"]
    return STORE.types["geometry_msgs/msg/Twist"](
        linear=vector(x=float(value), y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=-float(value))
    )


def joints(time_ns, value):
    return STORE.types["sensor_msgs/msg/JointState"](
        header=header(time_ns), name=["left", "right"], position=np.array([value, 2.0 * value]),
        velocity=np.array([0.5, 0.25]), effort=np.array([]),
    )


def messages(image):
    """Topic, type, time and content of every message."""
    for index in range(FRAMES):
        time_ns = START_NS + index * PERIOD_NS
        yield "/cmd_vel", "geometry_msgs/msg/Twist", time_ns, twist(index)
        yield "/joint_states", "sensor_msgs/msg/JointState", time_ns, joints(time_ns, index)
        yield "/camera/image", image(time_ns, index).__msgtype__, time_ns, image(time_ns, index)


def write_with_rosbags(path, image, plugin, compression=None):
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind, time_ns, message in messages(image):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], time_ns, STORE.serialize_cdr(message, kind))


def plain(message):
    """A message of rosbags as the dictionaries and lists that mcap_ros2 writes."""
    if isinstance(message, np.ndarray):
        return message.tobytes() if message.dtype == np.uint8 else message.tolist()
    if hasattr(message, "__msgtype__"):
        fields = (name for name in message.__dataclass_fields__ if name != "__msgtype__")
        return {name: plain(getattr(message, name)) for name in fields}
    return message


def write_with_mcap(path, image, compression):
    with open(path, "wb") as stream:
        writer = McapWriter(stream, chunk_size=4096, compression=compression)
        schemas = {}
        for topic, kind, time_ns, message in messages(image):
            if kind not in schemas:
                text, _ = STORE.generate_msgdef(kind, ros_version=2)
                schemas[kind] = writer.register_msgdef(kind, text)
            writer.write_message(topic, schemas[kind], plain(message), log_time=time_ns, publish_time=time_ns)
        writer.finish()


def check(dataset, place):
    table = parquet.read_table(dataset / "data/chunk-000/file-000.parquet").to_pylist()
    assert len(table) == FRAMES, f"{place}: {len(table)} frames"
    for index, row in enumerate(table):
        frame = np.asarray(Image.open(io.BytesIO(row["observation.image"]["bytes"])))
        assert np.array_equal(frame, gray(index)), f"{place}: frame {index} differs"
        assert row["action"] == [index, -index], f"{place}: action {index} is {row['action']}"
        state = [index, 2.0 * index, 0.5, 0.25]
        assert row["observation.state"] == state, f"{place}: state {index} is {row['observation.state']}"


def with_rosbags(path):
    """Topic, type, time and content of every message of a bag."""
    with AnyReader([path]) as bag:
        for connection, time_ns, content in bag.messages():
            yield connection.topic, connection.msgtype, time_ns, bag.deserialize(content, connection.msgtype)


def with_mcap(path):
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        # Reads the summary, then each chunk at its index.
        assert len(reader.get_summary().chunk_indexes) >= 1, f"{path} has no index of chunks"
        for schema, channel, message, content in reader.iter_decoded_messages():
            yield channel.topic, schema.name, message.log_time, content


def check_exported(found, place):
    """The data set of `messages`, exported: TwistStamped as actions, the joints as a JointState with positions only."""
    by_topic = {}
    for topic, kind, time_ns, content in found:
        stamp = content.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == time_ns, f"{place}: {topic} was made at another time"
        by_topic.setdefault((topic, kind), []).append((time_ns, content))
    kinds = {
        ("/camera/image_raw", "sensor_msgs/msg/Image"),
        ("/action", "geometry_msgs/msg/TwistStamped"),
        ("/state", "sensor_msgs/msg/JointState"),
    }
    assert set(by_topic) == kinds, f"{place}: {set(by_topic)}"
    images, actions, states = (by_topic[key] for key in sorted(kinds, key=lambda key: "cas".index(key[0][1])))
    assert len(images) == len(actions) == len(states) == FRAMES, place
    for index, ((time_ns, image), (_, action), (_, state)) in enumerate(zip(images, actions, states)):
        assert time_ns - images[0][0] == index * PERIOD_NS, f"{place}: time of frame {index}"
        assert (image.height, image.width, image.encoding, image.step) == (HEIGHT, WIDTH, "mono8", WIDTH), place
        pixels = np.frombuffer(bytes(image.data), np.uint8).reshape(HEIGHT, WIDTH)
        assert np.array_equal(pixels, gray(index)), f"{place}: frame {index} differs"
        assert (action.twist.linear.x, action.twist.angular.z) == (index, -index), f"{place}: action {index}"
        names = ["left.position", "right.position", "left.velocity", "right.velocity"]
        assert list(state.name) == names and list(state.position) == [index, 2.0 * index, 0.5, 0.25], f"{place}: state {index}"


def main():
    program, folder = sys.argv[1], pathlib.Path(sys.argv[2])
    folder.mkdir(parents=True)
    bags = []
    for encoding in ENCODINGS:
        bags.append(folder / f"raw-{encoding}")
        image = lambda time_ns, index: raw_image(time_ns, index, encoding)
        write_with_rosbags(bags[-1], image, StoragePlugin.MCAP)
    rosbags = [
        ("sqlite", StoragePlugin.SQLITE3, None),
        ("sqlite-message", StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
        ("mcap-message", StoragePlugin.MCAP, CompressionMode.MESSAGE),
        ("mcap-storage", StoragePlugin.MCAP, CompressionMode.STORAGE),
    ]
    for name, plugin, compression in rosbags:
        bags.append(folder / name)
        write_with_rosbags(bags[-1], png_image, plugin, compression)
    for compression in [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD]:
        bags.append(folder / f"{compression.name}.mcap")
        image = lambda time_ns, index: raw_image(time_ns, index, "rgb8")
        write_with_mcap(bags[-1], image, compression)
    bags += [path for path in folder.glob("sqlite/*.db3")]
    for number, bag in enumerate(bags):
        out = folder / f"imported-{number}"
        size = f"{WIDTH}x{HEIGHT}"
        subprocess.run([program, "import", bag, "--out", out, "--size", size], check=True, stdout=subprocess.DEVNULL)
        check(out, bag)
    print(f"{len(bags)} bags were imported as they were written")
    exported = folder / "exported.mcap"
    command = [program, "export", "--dataset", folder / "imported-0", "--to", "mcap", "--out", exported]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    check_exported(with_rosbags(exported), "exported, read with rosbags")
    check_exported(with_mcap(exported), "exported, read with mcap")
    print("rosbags and mcap read the exported bag as it was imported")


main()

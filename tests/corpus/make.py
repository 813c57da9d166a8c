"""Creates the corpus for tests/malformed: `python make.py` (needs Pillow). The first part of a file's name is the expected
outcome: `ok`, `refused` or the HTTP status. The files match the tests' models: 16×12 px, 3 frames of context, 2 predicted
frames, 8 features, an action of two numbers and a state of one."""

import base64
import io
import json
import sqlite3
import struct
import zlib
from pathlib import Path

from PIL import Image

HERE = Path(__file__).parent
SIZE = (16, 12)
PIXELS = bytes(range(192))
RAW = base64.b64encode(PIXELS).decode()


def write(folder, name, content):
    path = HERE / folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())


def chunk(kind, data, length=None, crc=None):
    crc = zlib.crc32(kind + data) if crc is None else crc
    return struct.pack(">I", len(data) if length is None else length) + kind + data + struct.pack(">I", crc)


def header(width, height, depth=8, color=0, interlaced=0):
    return chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, interlaced))


def png(*chunks):
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks) + chunk(b"IEND", b"")


def rows(width, height, data=PIXELS):
    lines = (b"\0" + data[at * width : (at + 1) * width].ljust(width, b"\0") for at in range(height))
    return chunk(b"IDAT", zlib.compress(b"".join(lines)))


def bomb(size):
    return zlib.compress(bytes(size), 9)


def saved(mode, kind, **options):
    out = io.BytesIO()
    Image.frombytes("L", SIZE, PIXELS).convert(mode).save(out, kind, **options)
    return out.getvalue()


def images():
    sound, jpeg = png(header(*SIZE), rows(*SIZE)), saved("L", "JPEG")
    frame = jpeg.index(b"\xff\xc0")
    huge = jpeg[: frame + 5] + b"\xff\xff\xff\xff" + jpeg[frame + 9 :]
    for name, content in {
        "ok-gray.png": sound,
        "ok-colour.png": saved("RGB", "PNG"),
        "ok-palette.png": saved("P", "PNG"),
        "ok-alpha.png": saved("RGBA", "PNG"),
        "ok-gray.jpeg": jpeg,
        "ok-colour.jpeg": saved("RGB", "JPEG"),
        "ok-progressive.jpeg": saved("RGB", "JPEG", progressive=True),
        "ok-more-rows-than-said.png": png(header(*SIZE), chunk(b"IDAT", bomb(16 << 20))),
        "refused-other-size.png": png(header(8, 8), rows(8, 8)),
        "refused-fewer-rows-than-said.png": png(header(*SIZE), rows(16, 2)),
        "refused-says-65535.png": png(header(65535, 65535), rows(*SIZE)),
        "refused-says-65535.jpeg": huge,
        "refused-says-2-gigapixels-a-side.png": png(header(0x7FFFFFFF, 0x7FFFFFFF), rows(*SIZE)),
        "refused-no-width.png": png(header(0, 12), rows(*SIZE)),
        "ok-profile-bomb.png": png(header(*SIZE), chunk(b"iCCP", b"a\0\0" + bomb(64 << 20)), rows(*SIZE)),
        "refused-chunk-of-4-gigabytes.png": png(header(*SIZE), chunk(b"eXIf", b"II", length=0x7FFFFFFF), rows(*SIZE)),
        "refused-wrong-checksum.png": png(header(*SIZE), chunk(b"PLTE", b"abc", crc=1), rows(*SIZE)),
        "refused-half.png": sound[: len(sound) // 2],
        "ok-restarts.jpeg": saved("RGB", "JPEG", restart_marker_blocks=1),
        "refused-half-a-header.jpeg": jpeg[: frame + 4],
        "refused-cut.jpeg": jpeg[: len(jpeg) - 20],
        "refused-cut-before-end-marker.jpeg": jpeg[:-20] + jpeg[-2:],
        "refused-no-end-marker.jpeg": jpeg[:-2],
        "refused-changed-scan.jpeg": jpeg[:-40] + bytes(byte ^ 0x24 for byte in jpeg[-40:-2]) + jpeg[-2:],
        "refused-animation.gif": saved("L", "GIF"),
        "refused-text.txt": b"no image at all",
        "refused-nothing.png": b"",
    }.items():
        write("images", name, content)


def pack(value):
    """MessagePack of what the messages hold."""
    if value is None:
        return b"\xc0"
    if isinstance(value, dict):
        return bytes([0x80 | len(value)]) + b"".join(pack(key) + pack(item) for key, item in value.items())
    if isinstance(value, list):
        return bytes([0x90 | len(value)]) + b"".join(map(pack, value))
    if isinstance(value, str):
        return bytes([0xA0 | len(value)]) + value.encode()
    if isinstance(value, bytes):
        return b"\xc4" + bytes([len(value)]) + value
    if isinstance(value, float):
        return b"\xca" + struct.pack(">f", value)
    return b"\xcf" + struct.pack(">Q", value)


def messages():
    frame = {"type": "frame", "seq": 0, "timestamp_us": 0, "image": RAW, "format": "raw", "action": [0.5, -0.5], "state": [1.0]}
    plan = frame | {"plan": [[0.5, 0.0], [0.0, 0.5]]}
    others = {"configure": {"type": "configure", "on_gap": "skip"}, "ping": {"type": "ping"}, "close": {"type": "close"}}
    for name, message in {"frame": frame, "plan": plan, **others}.items():
        write("messages", f"ok-{name}.json", json.dumps(message))
        image = {"image": PIXELS} if "image" in message else {}
        write("messages", f"ok-{name}.msgpack", pack(message | image))
    binary = frame | {"image": PIXELS}
    text, packed = json.dumps(frame), pack(binary)
    for name, content in {
        "ok-type-last.json": json.dumps({key: frame[key] for key in reversed(frame)}),
        "ok-not-a-number.msgpack": pack(binary | {"action": [float("nan"), float("inf")]}),
        "refused-unknown-field.json": json.dumps(frame | {"colour": 1}),
        "refused-long-key.json": json.dumps(frame | {"colour" * 10000: 1}),
        # The reader, the path and the error each hold the name; a mutation found it.
        "refused-long-key-with-escapes.json": json.dumps(frame | {("]" * 599 + "\n") * 330: 1}),
        "refused-field-of-another.json": '{"type":"close","seq":1}',
        "refused-unknown-type.json": '{"type":"dance"}',
        "refused-no-type.json": '{"seq":1}',
        "refused-key-twice.json": text[:-1] + ',"seq":1}',
        "refused-key-twice.msgpack": b"\x88" + packed[1:] + pack("seq") + pack(1),
        "refused-half.json": text[: len(text) // 2],
        "refused-half.msgpack": packed[: len(packed) // 2],
        "refused-two.json": text + text,
        "refused-two.msgpack": packed + packed,
        "refused-deep.json": '{"type":"frame","plan":' + "[" * 5000,
        "refused-deep.msgpack": b"\x82" + pack("type") + pack("frame") + pack("plan") + b"\x91" * 5000,
        "refused-huge-number.json": '{"type":"ping","timestamp_us":1e999}',
        "refused-seq-below-zero.json": json.dumps(frame | {"seq": -1}),
        "refused-image-is-a-list.json": json.dumps(frame | {"image": [0, 0]}),
        "refused-4097-numbers.json": json.dumps(frame | {"action": [0] * 4097}),
        "refused-image-of-4-gigabytes.msgpack": b"\x82" + pack("type") + pack("frame") + pack("image") + b"\xc6\xff\xff\xff\xff",
        "refused-list-of-4-billion.msgpack": b"\x82" + pack("type") + pack("frame") + pack("action") + b"\xdd\xff\xff\xff\xff",
        "refused-map-of-4-billion.msgpack": b"\xdf\xff\xff\xff\xff",
    }.items():
        write("messages", name, content)


def form(*parts):
    lines = [f'--X\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n'.encode() + data + b"\r\n" for name, data in parts]
    return b"".join(lines) + b"--X--\r\n"


def bodies():
    predict = {"frames": [RAW] * 3, "format": "raw", "actions": [[0.5, -0.5]], "state": [1.0]}
    rollouts = {"frames": [RAW] * 3, "format": "raw", "state": [1.0], "plans": [[[0.5, 0.0], [0.0, 0.5]]] * 3}
    collect = {"kind": "collect", "name": "small", "scenario": "crowded", "trials": 3}
    train = {"kind": "train", "name": "mine", "preset": "moving", "dataset": "none", "settings": {"sequence": {"steps": 10}}}
    evaluate = {"kind": "evaluate", "model": "moving", "dataset": "none"}
    small = {"frame_width_px": 16, "frame_height_px": 12}
    environment = {"scenario": "moving-observer", "seed": 7, "world": small}
    for name, body in {
        "200-predict-sound": predict,
        "200-rollouts-sound": rollouts,
        "200-step-sound": {"action": [0.3, -0.2]},
        "200-step-greatest-action": {"action": [1e30, -1e30]},
        "200-predict-greatest-action": predict | {"actions": [[1e30, -1e30]], "state": [1e30]},
        "201-sessions-sound": {"model": "moving", "on_gap": "skip", "format": "raw"},
        "201-environments-sound": environment,
        "202-jobs-collect": collect,
        "400-predict-number-beyond-f32": predict | {"state": [1e39]},
        "404-sessions-no-such-model": {"model": "../moving"},
        "422-predict-unknown-field": predict | {"colour": "red"},
        "422-predict-image-is-no-base64": predict | {"frames": ["%", RAW, RAW]},
        "422-predict-image-too-short": predict | {"frames": [RAW, "AAAA", RAW]},
        "422-predict-two-frames": predict | {"frames": [RAW] * 2},
        "422-predict-action-of-three": predict | {"actions": [[1, 2, 3]]},
        "422-predict-action-too-great": predict | {"actions": [[3e38, -3e38]]},
        "422-predict-state-is-null": predict | {"state": None},
        "422-rollouts-none": rollouts | {"plans": []},
        "422-rollouts-ragged": rollouts | {"plans": [[[0.0, 0.0], [0.0]]]},
        "422-sessions-unknown-gap": {"model": "moving", "on_gap": "dance"},
        "422-jobs-name-leaves": collect | {"name": "../outside"},
        "422-jobs-dataset-leaves": train | {"dataset": "../../etc"},
        "422-jobs-model-leaves": evaluate | {"model": "%2e%2e%2f"},
        "422-jobs-no-trials": collect | {"trials": 0},
        "422-jobs-unknown-kind": {"kind": "delete", "name": "all"},
        "422-jobs-huge-layer": train | {"settings": {"model": {"hidden": 10**9}}},
        "422-jobs-null-setting": train | {"settings": {"sequence": None}},
        "422-jobs-seed-below-zero": collect | {"seed": -1},
        "422-environments-huge-frame": environment | {"world": {"frame_width_px": 100000, "frame_height_px": 100000}},
        "422-environments-no-period": environment | {"world": small | {"frame_period_s": 0}},
        "422-environments-unknown-camera": environment | {"world": small | {"camera": {"zoom": 3}}},
        "422-step-action-of-three": {"action": [1, 2, 3]},
        "422-step-action-too-great": {"action": [3e38, 0]},
        "200-openenv-sound": {"action": {"action": [0.3, -0.2], "metadata": {}}, "timeout_s": 1},
        "422-openenv-no-action": {"action": {}},
        "422-openenv-action-of-three": {"action": {"action": [1, 2, 3]}},
    }.items():
        write("bodies", f"{name}.json", json.dumps(body))
    text = json.dumps(predict)
    for name, content in {
        "400-predict-half.json": text[:400],
        "400-predict-nothing.json": "",
        "422-predict-deep.json": '{"actions":' + "[" * 5000,
        "400-predict-not-a-number.json": '{"frames":[],"state":[NaN]}',
        "400-predict-not-utf8.json": b'{"format":"\xff\xfe"}',
        "422-predict-long-key.json": json.dumps({"colour" * 10000: 1}),
        "422-predict-key-twice.json": '{"format":"raw","format":"png"}',
        "400-jobs-deep.json": '{"kind":"train","settings":' + '{"a":' * 5000,
        "200-predict-sound.form": form(*[("frames", PIXELS)] * 3, ("request", json.dumps(predict | {"frames": []}).encode())),
        "400-predict-half.form": form(("frames", PIXELS))[:-20],
        "422-predict-unknown-part.form": form(("colour", b"red")),
        "422-predict-request-is-no-json.form": form(("request", b"{")),
        "422-predict-nothing.form": form(),
    }.items():
        write("bodies", name, content)


def states():
    snapshot = {"next_seq": 5, "features": [[0.25] * 8] * 3, "actions": [[0.5, -0.5]] * 2, "state": [1.0]}
    # tests/malformed replaces WEIGHTS with the model's hash.
    state = {"model": "moving", "version": 1, "weights_sha256": "WEIGHTS", "on_gap": "error", "snapshot": snapshot}
    with_snapshot = lambda **more: state | {"snapshot": snapshot | more}
    for name, content in {
        "201-sound": state,
        "201-of-a-fresh-session": with_snapshot(next_seq=0, features=[], actions=[], state=None),
        "201-greatest-seq": with_snapshot(next_seq=2**64 - 1),
        "404-other-model": state | {"model": "../moving"},
        "409-other-weights": state | {"weights_sha256": "00"},
        "422-unknown-field": state | {"colour": 1},
        "422-seq-too-great": with_snapshot(next_seq=2**64),
        "422-fewer-seen-than-kept": with_snapshot(next_seq=1),
        "422-too-many-frames": with_snapshot(features=[[0.25] * 8] * 4),
        "422-frame-of-one-feature": with_snapshot(features=[[0.25]] * 3),
        "422-feature-of-two": with_snapshot(features=[[2.0] * 8] * 3),
        "422-no-actions": with_snapshot(actions=[]),
        "422-action-too-great": with_snapshot(actions=[[3e38, 0]] * 2),
        "422-state-of-three": with_snapshot(state=[1, 2, 3]),
        "422-version-below-zero": state | {"version": -1},
    }.items():
        write("states", f"{name}.json", json.dumps(content))
    text = json.dumps(state)
    write("states", "400-half.json", text[: len(text) // 2])
    write("states", "422-deep.json", text.replace("[[", "[" * 5000, 1))
    write("states", "422-key-twice.json", text[:-1] + ',"version":1}')


def cdr_image(time_ns):
    """A `sensor_msgs/Image` of 4×3 gray pixels."""
    text = lambda value: struct.pack("<I", len(value) + 1) + value + b"\0"
    padded = lambda content: content + bytes(-len(content) % 4)
    head = padded(struct.pack("<II", *divmod(time_ns, 10**9)) + text(b"camera"))
    head = padded(head + struct.pack("<II", 3, 4) + text(b"mono8") + b"\0")
    return b"\0\1\0\0" + head + struct.pack("<II", 4, 12) + bytes(range(0, 240, 20))


TOPICS = "id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL"
MESSAGES = "id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL"
IMAGE = cdr_image(10**9)
# Rows that would be a bag, and as many as one likes.
ROWS = f"WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT 6) SELECT i AS id, 1 AS topic_id, i * 100000000 AS timestamp, x'{IMAGE.hex()}' AS data FROM n"


def database(*statements, messages=f"CREATE TABLE messages({MESSAGES})", topics=f"CREATE TABLE topics({TOPICS})", count=6):
    """A database of rosbag2 in small pages; `statements` come after its tables and rows."""
    path = HERE / "database.tmp"
    path.unlink(missing_ok=True)
    connection = sqlite3.connect(path, isolation_level=None)
    for statement in ("PRAGMA page_size = 512", topics, messages):
        connection.execute(statement)
    if "TABLE" in topics:
        connection.execute("INSERT INTO topics(id, name, type, serialization_format) VALUES (1, '/image', 'sensor_msgs/msg/Image', 'cdr')")
    if "topic_id" in messages and "VIEW" not in messages:
        stored = [row[1] for row in connection.execute("PRAGMA table_info(messages)") if row[1] != "data" or not row[4]]
        for index in range(1, count + 1):
            row = {"id": index, "topic_id": 1, "timestamp": index * 10**8, "data": cdr_image(index * 10**8)}
            row = {name: row[name] for name in stored if name in row}
            marks = ", ".join("?" * len(row))
            connection.execute(f"INSERT INTO messages({', '.join(row)}) VALUES ({marks})", tuple(row.values()))
    for statement in statements:
        connection.execute(statement)
    connection.close()
    content = bytearray(path.read_bytes())
    path.unlink()
    # The version of SQLite that wrote it.
    content[96:100] = bytes(4)
    return content


def endless(content, page, depth):
    """The rows below a table's first page again and again: above it come `depth` pages that each name the one below it 40 times."""
    pages = [bytearray(content[at : at + 512]) for at in range(0, len(content), 512)]
    root, start = pages[page - 1], 100 if page == 1 else 0
    # Cells stay at their places; only the head of the first page, which comes after the file's head, moves.
    head = (12 if root[start] == 5 else 8) + 2 * int.from_bytes(root[start + 3 : start + 5], "big")
    moved = bytearray(root)
    moved[:head] = root[start : start + head]
    pages.append(moved)
    for level in range(depth):
        first = start if level == depth - 1 else 0
        above, below = bytearray(512), len(pages)
        above[:first] = root[:first]
        above[first : first + 12] = struct.pack(">BHHHBI", 5, 0, 40, 312, 0, below)
        for cell in range(40):
            place = 312 + 5 * cell
            above[first + 12 + 2 * cell : first + 14 + 2 * cell] = struct.pack(">H", place)
            above[place : place + 5] = struct.pack(">IB", below, cell + 1)
        if level == depth - 1:
            pages[page - 1] = above
        else:
            pages.append(above)
    pages[0][28:32] = struct.pack(">I", len(pages))
    return b"".join(pages)


def bags():
    sound = database()
    view = f'CREATE VIEW "Messages" AS {ROWS}'
    edited = lambda change: ("PRAGMA writable_schema = ON", f"UPDATE sqlite_master SET {change} WHERE name = 'Messages'")
    without = lambda name: ", ".join(column for column in MESSAGES.split(", ") if not column.startswith(name))
    for name, content in {
        "ok-plain.db3": sound,
        "ok-other-case.db3": database(messages=f'CREATE TABLE "MESSAGES"({MESSAGES})', topics=f"CREATE TABLE [Topics]({TOPICS})"),
        "ok-index.db3": database("CREATE INDEX timestamp_idx ON messages (timestamp ASC)"),
        "ok-id-is-no-key.db3": database(messages=f"CREATE TABLE messages({MESSAGES.replace(' PRIMARY KEY', '')})"),
        "ok-view-of-another-name.db3": database(view.replace("Messages", "meſſages")),
        "ok-many-pages.db3": database(count=20),
        "refused-view.db3": database(messages=view),
        "refused-view-as-table.db3": database(*edited("type = 'table', rootpage = 2"), messages=view),
        "refused-view-under-another-name.db3": database(*edited("type = 'table', name = 'kept', tbl_name = 'kept'"), messages=view),
        "refused-view-of-topics.db3": database(topics="CREATE VIEW TOPICS AS SELECT 1 AS id, '/image' AS name, 'sensor_msgs/msg/Image' AS type, 'cdr' AS serialization_format"),
        "refused-virtual.db3": database(messages="CREATE VIRTUAL TABLE [MESSAGES] USING fts5(id, topic_id, timestamp, data)"),
        "refused-generated.db3": database(messages=f"CREATE TABLE messages({without('data')}, data BLOB AS(zeroblob(900000000)))"),
        "refused-generated-and-stored.db3": database(messages=f"CREATE TABLE messages({without('topic')}, topic_id INTEGER aS(1) STORED)"),
        "refused-default.db3": database(messages=f"CREATE TABLE messages({without('data')}, data BLOB DEFAULT x'{IMAGE.hex()}')"),
        "refused-without-rowid.db3": database(messages=f"CREATE TABLE messages({MESSAGES}) WITHOUT ROWID"),
        "refused-column-rowid.db3": database(messages=f"CREATE TABLE messages({MESSAGES}, ROWID TEXT)"),
        "refused-no-messages.db3": database(messages="CREATE TABLE message(id)"),
        "refused-rows-without-end.db3": endless(sound, 3, 6),
        "refused-topics-without-end.db3": endless(sound, 2, 6),
        "refused-schema-without-end.db3": endless(sound, 1, 6),
        "refused-cut.db3": sound[:1024],
        "refused-text.db3": b"no database at all, but long enough to look like one",
        "refused-nothing.db3": b"",
    }.items():
        write("bags", name, bytes(content))


if __name__ == "__main__":
    for make in (images, messages, bodies, states, bags):
        make()

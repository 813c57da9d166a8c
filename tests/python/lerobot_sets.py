#!/usr/bin/env python3
"""Writes small LeRobot data sets as its own tools lay them out, lets the program import them, and checks the result.

Usage: lerobot_sets.py PROGRAM DIRECTORY

Versions 2.1 and 3.0, with images in the tables and with videos (ffmpeg): the right frames, actions and states must arrive in the
right order. Then sets that cannot be imported: several cameras, a video that is shorter than its table. At last, the program exports a set
for LeRobot, and it is read here. Ends with status 1 and one line for each mismatch.
"""

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

FPS, LENGTHS, SIDE = 10, [30, 12, 21], 64
wrong = []


def expect(holds: bool, what: str) -> None:
    if not holds:
        wrong.append(what)


def frame(episode: int, index: int) -> np.ndarray:
    """A gray field of the episode with a white bar that moves with the index."""
    pixels = np.full((SIDE, SIDE, 3), 40 + 30 * episode, dtype=np.uint8)
    left = (index * 2) % (SIDE - 4)
    pixels[:, left : left + 4] = 250
    return pixels


def png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def write_video(path: Path, frames: list[np.ndarray]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{SIDE}x{SIDE}", "-r", str(FPS), "-i", "-"]
    out = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-g", "2", "-crf", "12", str(path)]
    subprocess.run(["ffmpeg", "-v", "error", "-y", *raw, *out], input=b"".join(f.tobytes() for f in frames), check=True)


def rows(episode: int, start: int) -> dict:
    count = LENGTHS[episode]
    return {
        "action": [[episode + i / 100, -i / 100] for i in range(count)],
        "observation.state": [[float(i)] * 3 for i in range(count)],
        "timestamp": np.arange(count, dtype=np.float32) / np.float32(FPS),
        "frame_index": list(range(count)),
        "episode_index": [episode] * count,
        "index": list(range(start, start + count)),
        "task_index": [0] * count,
    }


def table(parts: list[dict], fixed: bool, image: str | None) -> pa.Table:
    vector = lambda size: pa.list_(pa.float32(), size) if fixed else pa.list_(pa.float32())
    kinds = {"action": vector(2), "observation.state": vector(3), "timestamp": pa.float32()}
    columns = {}
    for key in parts[0]:
        values = [value for part in parts for value in part[key]]
        columns[key] = pa.array(values, kinds.get(key, pa.int64()))
    if image:
        stored = [
            {"bytes": png(frame(part["episode_index"][0], i)), "path": f"frame-{i:06d}.png"}
            for part in parts
            for i in part["frame_index"]
        ]
        columns[image] = pa.array(stored, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
    return pa.table(columns)


def info(version: str, cameras: list[str], kind: str) -> dict:
    is_old = version.startswith("v2")
    features = {camera: {"dtype": kind, "shape": [SIDE, SIDE, 3], "names": ["height", "width", "channels"]} for camera in cameras}
    features["action"] = {"dtype": "float32", "shape": [2], "names": {"motors": ["pan", "tilt"]}}
    features["observation.state"] = {"dtype": "float32", "shape": [3], "names": ["a", "b", "c"]}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for key in ("frame_index", "episode_index", "index", "task_index"):
        features[key] = {"dtype": "int64", "shape": [1], "names": None}
    video = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    if not is_old:
        video = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    return {
        "codebase_version": version,
        "robot_type": "so100",
        "total_episodes": len(LENGTHS),
        "total_frames": sum(LENGTHS),
        "total_tasks": 1,
        "chunks_size": 1000,
        "fps": FPS,
        "splits": {"train": f"0:{len(LENGTHS)}"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        if is_old
        else "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": video if kind == "video" else None,
        "features": features,
    }


def write(path: Path, value: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(value, path, row_group_size=16)


def write_set(root: Path, version: str, cameras: list[str], kind: str, lost_frames: int = 0) -> Path:
    (root / "meta").mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info(version, cameras, kind)))
    starts = np.cumsum([0, *LENGTHS])
    parts = [rows(episode, int(starts[episode])) for episode in range(len(LENGTHS))]
    column = cameras[0] if kind == "image" else None
    films = [[frame(episode, i) for i in range(count)] for episode, count in enumerate(LENGTHS)]
    if version.startswith("v2"):
        lines = []
        for episode, part in enumerate(parts):
            write(root / f"data/chunk-000/episode_{episode:06d}.parquet", table([part], False, column))
            lines.append(json.dumps({"episode_index": episode, "tasks": ["drive"], "length": LENGTHS[episode]}))
            for camera in cameras if kind == "video" else []:
                kept = films[episode][: len(films[episode]) - lost_frames]
                write_video(root / f"videos/chunk-000/{camera}/episode_{episode:06d}.mp4", kept)
        (root / "meta/episodes.jsonl").write_text("\n".join(lines) + "\n")
        (root / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "drive"}) + "\n")
        return root
    # The first file holds two episodes, the second one.
    files = [0, 0, 1]
    write(root / "data/chunk-000/file-000.parquet", table(parts[:2], True, column))
    write(root / "data/chunk-000/file-001.parquet", table(parts[2:], True, column))
    episodes = {
        "episode_index": [0, 1, 2],
        "tasks": [["drive"]] * 3,
        "length": LENGTHS,
        "data/chunk_index": [0, 0, 0],
        "data/file_index": files,
        "dataset_from_index": [int(start) for start in starts[:-1]],
        "dataset_to_index": [int(start) for start in starts[1:]],
    }
    for camera in cameras if kind == "video" else []:
        begins = [0.0, LENGTHS[0] / FPS, 0.0]
        episodes[f"videos/{camera}/chunk_index"] = [0, 0, 0]
        episodes[f"videos/{camera}/file_index"] = files
        episodes[f"videos/{camera}/from_timestamp"] = begins
        episodes[f"videos/{camera}/to_timestamp"] = [b + n / FPS for b, n in zip(begins, LENGTHS)]
        film = films[0] + films[1]
        write_video(root / f"videos/{camera}/chunk-000/file-000.mp4", film[: len(film) - lost_frames])
        write_video(root / f"videos/{camera}/chunk-000/file-001.mp4", films[2])
    write(root / "meta/episodes/chunk-000/file-000.parquet", pa.table(episodes))
    write(root / "meta/tasks.parquet", pa.table({"task_index": [0], "task": ["drive"]}))
    return root


def imported(program: str, source: Path, *options: str) -> tuple[Path, subprocess.CompletedProcess]:
    out = source.parent / f"{source.name}-imported{len(options)}"
    command = [program, "import", str(source), "--out", str(out), *options]
    return out, subprocess.run(command, capture_output=True, text=True)


def check_set(program: str, source: Path, *options: str) -> None:
    out, done = imported(program, source, *options)
    name = source.name
    if done.returncode != 0:
        wrong.append(f"{name}: {done.stderr.strip()}")
        return
    found = [row for path in sorted(out.glob("data/*/*.parquet")) for row in pq.read_table(path).to_pylist()]
    stamp = json.loads((out / "meta/foreframe.json").read_text())
    names = [channel["name"] for channel in stamp["action_channels"] + stamp["state_channels"]]
    expect(names == ["pan", "tilt", "a", "b", "c"], f"{name}: channels are {names}")
    expect(stamp["frame_period_s"] == 1 / FPS, f"{name}: period is {stamp['frame_period_s']}")
    expected = [(episode, i) for episode, count in enumerate(LENGTHS) for i in range(count)]
    expect(len(found) == len(expected), f"{name}: {len(found)} rows, {len(expected)} expected")
    for (episode, i), row in zip(expected, found):
        pixels = np.asarray(Image.open(io.BytesIO(row["observation.image"]["bytes"])), dtype=float)
        bar, field = int(pixels.mean(axis=0).argmax()), float(np.median(pixels))
        left = (i * 2) % (SIDE - 4)
        expect(left <= bar < left + 4, f"{name}: episode {episode} frame {i}: the bar is at {bar}, not {left}")
        expect(abs(field - (40 + 30 * episode)) < 4, f"{name}: episode {episode} frame {i}: gray is {field}")
        expect(row["episode_index"] == episode, f"{name}: row of episode {row['episode_index']}, not {episode}")
        expect(np.allclose(row["action"], [episode + i / 100, -i / 100], atol=1e-6), f"{name}: action {row['action']}")
        expect(row["observation.state"] == [float(i)] * 3, f"{name}: state {row['observation.state']}")


def check_refused(program: str, source: Path, *expected: str) -> None:
    _, done = imported(program, source)
    expect(done.returncode == 2, f"{source.name}: status {done.returncode}, not 2")
    for text in expected:
        expect(text in done.stderr, f"{source.name}: {text!r} is not in {done.stderr.strip()!r}")


def check_export(program: str, dataset: Path, kind: str) -> None:
    """Exports an imported set, and reads it as LeRobot does: rows by the table of episodes, frames of videos by time."""
    out = dataset.parent / f"{dataset.name}-{kind}"
    command = [program, "export", "--dataset", str(dataset), "--to", "lerobot", "--robot-type", "so100", "--out", str(out)]
    done = subprocess.run([*command, "--videos"] if kind == "videos" else command, capture_output=True, text=True)
    if done.returncode != 0:
        wrong.append(f"{out.name}: {done.stderr.strip()}")
        return
    described = json.loads((out / "meta/info.json").read_text())
    image = "observation.image"
    feature = described["features"][image]
    expect(feature["dtype"] == kind.rstrip("s"), f"{out.name}: dtype is {feature['dtype']}")
    expect(feature["shape"] == [SIDE, SIDE, 3], f"{out.name}: shape is {feature['shape']}")
    expect(described["robot_type"] == "so100", f"{out.name}: robot is {described['robot_type']}")
    stats = json.loads((out / "meta/stats.json").read_text())[image]
    shapes = {name: np.asarray(values).shape for name, values in stats.items()}
    expected = {name: (3, 1, 1) for name in ("min", "max", "mean", "std")} | {"count": (1,)}
    expect(shapes == expected, f"{out.name}: statistics have the shapes {shapes}")
    expect(described["fps"] == FPS and described["total_frames"] == sum(LENGTHS), f"{out.name}: {described}")
    columns = {key for key, value in described["features"].items() if value["dtype"] != "video"}
    for episode in pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist():
        number = episode["episode_index"]
        place = {"chunk_index": episode["data/chunk_index"], "file_index": episode["data/file_index"]}
        rows = pq.read_table(out / described["data_path"].format(**place))
        expect(set(rows.column_names) == columns, f"{out.name}: columns are {rows.column_names}")
        rows = [row for row in rows.to_pylist() if row["episode_index"] == number]
        expect(len(rows) == LENGTHS[number], f"{out.name}: episode {number} has {len(rows)} rows")
        film = None
        if kind == "videos":
            place = {name: episode[f"videos/{image}/{name}"] for name in ("chunk_index", "file_index")}
            path = out / described["video_path"].format(video_key=image, **place)
            command = ["ffmpeg", "-v", "error", "-i", str(path), "-pix_fmt", "gray", "-f", "rawvideo", "-"]
            raw = subprocess.run(command, capture_output=True, check=True).stdout
            film = np.frombuffer(raw, dtype=np.uint8).reshape(-1, SIDE, SIDE)
        for i, row in enumerate(rows):
            expect(abs(row["timestamp"] - i / FPS) < 1e-6, f"{out.name}: frame {i} is at {row['timestamp']} s")
            expect(np.allclose(row["action"], [number + i / 100, -i / 100], atol=1e-6), f"{out.name}: {row['action']}")
            if film is None:
                stored = Image.open(io.BytesIO(row[image]["bytes"]))
                expect(stored.mode == "RGB", f"{out.name}: an image is {stored.mode}")
                pixels = np.asarray(stored.convert("L"))
            else:
                pixels = film[round((episode[f"videos/{image}/from_timestamp"] + row["timestamp"]) * FPS)]
            bar, left = int(pixels.mean(axis=0).argmax()), (i * 2) % (SIDE - 4)
            expect(left <= bar < left + 4, f"{out.name}: episode {number} frame {i}: the bar is at {bar}, not {left}")


def main() -> int:
    if len(sys.argv) != 3:
        print(__doc__, file=sys.stderr)
        return 2
    program, root = sys.argv[1], Path(sys.argv[2])
    camera = "observation.images.front"
    cameras = [camera, "observation.images.wrist"]
    for version in ("v2.1", "v3.0"):
        check_set(program, write_set(root / f"{version}-images", version, [camera], "image"))
        check_set(program, write_set(root / f"{version}-videos", version, [camera], "video"))
        two = write_set(root / f"{version}-cameras", version, cameras, "video")
        check_refused(program, two, "choose one with --image", *cameras)
        check_set(program, two, "--image", "wrist")
        short = write_set(root / f"{version}-short", version, [camera], "video", lost_frames=3)
        check_refused(program, short, "the video is shorter than its table", ".parquet row ")
        out, done = imported(program, short, "--skip-bad")
        expect(done.returncode == 0 and "shorter than its table" in done.stdout, f"{short.name}: {done.stderr.strip()}")
    for kind in ("images", "videos"):
        check_export(program, root / "v3.0-images-imported0", kind)
    native = subprocess.run([program, "inspect", str(root / "v3.0-images")], capture_output=True, text=True)
    expect("foreframe import" in native.stderr, f"inspect of another tool's set says {native.stderr.strip()!r}")
    for line in wrong[:20]:
        print(f"mismatch: {line}", file=sys.stderr)
    if not wrong:
        print("LeRobot data sets of versions 2.1 and 3.0, with images and videos, are imported and exported")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

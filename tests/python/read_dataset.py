#!/usr/bin/env python3
"""Reads a data set of `foreframe collect` with pyarrow and pillow alone, and checks it.

Usage: read_dataset.py DIRECTORY

Checks what any Python user relies on: file hashes, counts, indexes, frame sizes, masks, finite numbers, and that the
statistics are those of the data. Prints a summary; ends with status 1 and one line for each mismatch.
"""

import hashlib
import io
import json
import math
import sys
from pathlib import Path

import pyarrow.parquet as pq
from PIL import Image


def check(directory: Path) -> tuple[list[str], str]:
    """The mismatches found, and a summary."""
    wrong = []

    def expect(holds: bool, what: str) -> None:
        if not holds:
            wrong.append(what)

    info = json.loads((directory / "meta/info.json").read_text())
    stats = json.loads((directory / "meta/stats.json").read_text())
    stamp = json.loads((directory / "meta/foreframe.json").read_text())
    episodes = pq.read_table(directory / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    tasks = pq.read_table(directory / "meta/tasks.parquet").to_pylist()
    height, width, _ = info["features"]["observation.image"]["shape"]
    images = [key for key, feature in info["features"].items() if feature["dtype"] == "image"]
    vectors = [key for key in ("observation.state", "action") if key in info["features"]]

    expect(info["codebase_version"] == "v3.0", f"codebase_version is {info['codebase_version']}, not v3.0")
    expect(len(tasks) == info["total_tasks"], f"{len(tasks)} tasks, {info['total_tasks']} described")
    expect(len(episodes) == info["total_episodes"], f"{len(episodes)} episodes, {info['total_episodes']} described")

    index, ids, total_sum, action_sum, hashes = 0, set(), 0, 0.0, ""
    files = sorted(directory.glob("data/*/*.parquet"))
    expect(len(files) == len(stamp["shards"]), f"{len(files)} data files, {len(stamp['shards'])} recorded")
    by_file = {}
    for episode in episodes:
        path = info["data_path"].format(chunk_index=episode["data/chunk_index"], file_index=episode["data/file_index"])
        by_file.setdefault(path, []).append(episode)
    for path, shard in zip(files, stamp["shards"]):
        name = path.relative_to(directory).as_posix()
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        hashes += digest
        expect(name == shard["path"], f"{name} found where {shard['path']} is recorded")
        expect(digest == shard["sha256"], f"{name}: sha256 differs from the recorded one")
        table = pq.read_table(path)
        expect(set(table.column_names) == set(info["features"]), f"{name}: columns differ from the described features")
        rows = table.to_pylist()
        expected = [(e, frame) for e in by_file.get(name, []) for frame in range(e["length"])]
        expect(len(rows) == len(expected), f"{name}: {len(rows)} rows, {len(expected)} in the episodes table")
        for row, (episode, frame) in zip(rows, expected):
            where = f"{name}, index {index}"
            place = (row["index"], row["episode_index"], row["frame_index"], row["task_index"])
            expect(place == (index, episode["episode_index"], frame, 0), f"{where}: counters are {place}")
            expect(episode["dataset_from_index"] + frame == index, f"{where}: episodes table says otherwise")
            expect(math.isclose(row["timestamp"], frame / info["fps"], abs_tol=1e-3), f"{where}: {row['timestamp']} s")
            for key in images:
                image = Image.open(io.BytesIO(row[key]["bytes"]))
                expect((image.size, image.mode) == ((width, height), "L"), f"{where}: {key} {image.size} {image.mode}")
                if key == "observation.mask":
                    ids.update(image.tobytes())
                else:
                    total_sum += sum(image.tobytes())
            for key in vectors:
                value = row[key] if isinstance(row[key], list) else [row[key]]
                expect(len(value) == info["features"][key]["shape"][0], f"{where}: {key} has {len(value)} numbers")
                expect(all(map(math.isfinite, value)), f"{where}: {key} is {value}")
            if "action" in vectors:
                action_sum += row["action"][0] if isinstance(row["action"], list) else row["action"]
            index += 1

    expect(index == info["total_frames"], f"{index} frames, {info['total_frames']} described")
    content_hash = hashlib.sha256(hashes.encode()).hexdigest()
    expect(content_hash == stamp["content_hash"], "content hash differs from the recorded one")
    mean = total_sum / (255 * width * height * max(index, 1))
    recorded = stats["observation.image"]["mean"][0][0][0]
    expect(math.isclose(mean, recorded, rel_tol=1e-9), f"mean intensity is {mean}, stats.json says {recorded}")
    if "action" in vectors:
        mean_action, recorded = action_sum / max(index, 1), stats["action"]["mean"][0]
        expect(math.isclose(mean_action, recorded, rel_tol=1e-6, abs_tol=1e-9), f"mean action is {mean_action}")
    for episode in episodes:
        trial = json.loads(episode["trial"]) if episode["trial"] else {"trial": episode["episode_index"]}
        expect(trial["trial"] == episode["episode_index"], f"episode {episode['episode_index']}: holds another trial")
    summary = (
        f"{stamp['name']}: {len(episodes)} episodes, {index} frames of {width}×{height} px at {info['fps']} Hz in "
        f"{len(files)} files; mean intensity {mean:.4f}; mask ids {sorted(ids)}; content {content_hash[:12]}"
    )
    return wrong, summary


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__, file=sys.stderr)
        return 2
    wrong, summary = check(Path(sys.argv[1]))
    print(summary)
    for line in wrong[:20]:
        print(f"mismatch: {line}", file=sys.stderr)
    if len(wrong) > 20:
        print(f"… and {len(wrong) - 20} more", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

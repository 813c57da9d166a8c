#!/usr/bin/env python3
"""Edits exported data sets with LeRobot's own tools: merges two, deletes episodes, splits.

Usage: lerobot_tools.py PROGRAM DIRECTORY

Needs the package lerobot, which takes 8 GB with what it needs, so `.ci/run` does not install it. Ends with an error where a tool does.
"""

import subprocess
import sys
from pathlib import Path

from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, split_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset

program, directory = sys.argv[1], Path(sys.argv[2])
for name, trials, seed in (("a", 8, 5), ("b", 6, 6)):
    made = directory / name
    subprocess.run([program, "collect", "--scenario", "moving-observer", "--trials", str(trials), "--seed", str(seed), "--out", made], check=True)
    for kind, options in (("images", []), ("videos", ["--videos"])):
        subprocess.run([program, "export", "--dataset", made, "--to", "lerobot", "--out", directory / f"{name}-{kind}", *options], check=True)
for kind in ("images", "videos"):
    sets = [LeRobotDataset(f"foreframe/{name}", root=directory / f"{name}-{kind}") for name in ("a", "b")]
    lengths = [len(one) for one in sets]
    merged = merge_datasets(sets, output_repo_id="foreframe/merged", output_dir=directory / f"merged-{kind}")
    assert (merged.num_episodes, len(merged)) == (14, sum(lengths))
    shorter = delete_episodes(sets[0], [1, 3], output_dir=directory / f"shorter-{kind}", repo_id="foreframe/shorter")
    assert (shorter.num_episodes, len(shorter)) == (6, lengths[0] * 6 // 8)
    parts = split_dataset(sets[0], {"train": [0, 1, 2], "val": [3, 4]}, output_dir=directory / f"parts-{kind}")
    assert [parts[name].num_episodes for name in ("train", "val")] == [3, 2]
    assert tuple(merged[-1]["observation.image"].shape) == (3, 64, 64)
    print(f"{kind}: merged, deleted and split")

"""The event files of a run, read by TensorBoard's own reader.

    read_events.py RUN_DIR
"""

import io
import sys

from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

events = EventAccumulator(sys.argv[1], size_guidance={"scalars": 0, "images": 0})
events.Reload()
tags = events.Tags()
expected = {f"{stage}/{name}" for stage in ("pretrain", "sequence") for name in ("loss", "validation loss", "learning rate", "steps per second")}
assert set(tags["scalars"]) == expected, tags["scalars"]
assert tags["images"] == ["sequence/prediction"], tags["images"]
for tag in sorted(expected):
    points = events.Scalars(tag)
    steps = [point.step for point in points]
    # A training that was stopped and resumed has each step once.
    assert steps == sorted(set(steps)) and steps, (tag, steps)
    assert all(point.value > 0 and point.wall_time > 1.6e9 for point in points), tag
    print(f"{tag}: {len(points)} points to step {steps[-1]}, last {points[-1].value:.4g}")
validated = [point.step for point in events.Scalars("sequence/validation loss")]
pictures = events.Images("sequence/prediction")
assert [picture.step for picture in pictures] == validated, validated
for picture in pictures:
    size = Image.open(io.BytesIO(picture.encoded_image_string)).size
    assert size == (picture.width, picture.height), size
print(f"{len(pictures)} pictures of {size[0]}×{size[1]} px")

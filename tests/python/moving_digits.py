"""Draws what a sprite network is tried with: twelve digits of 28×28 px, and ten frames in which two of them move.

Usage: moving_digits.py DIGITS FRAMES (two new directories). Needs pillow.
"""

import sys
from pathlib import Path

from PIL import Image, ImageChops, ImageDraw

DIGITS, FRAMES = (Path(argument) for argument in sys.argv[1:])
COUNT = 10


def digit(index):
    """A shape of its own for each index, drawn four times as large so that its borders are gray."""
    image = Image.new("L", (112, 112))
    draw = ImageDraw.Draw(image)
    draw.arc((24, 16, 88, 60 + 4 * index), 30 * index, 30 * index + 260, 255, 12)
    draw.line((30 + 4 * index, 40, 80 - 3 * index, 96), 255, 12)
    return image.resize((28, 28), Image.Resampling.BOX)


DIGITS.mkdir(parents=True)
for index in range(12):
    digit(index).save(DIGITS / f"{index}.png")
FRAMES.mkdir(parents=True)
for step in range(COUNT):
    frame = Image.new("L", (64, 64))
    for index, (left, top), (right, down) in ((1, (2, 4), (3, 2)), (7, (34, 20), (-2, 1))):
        layer = Image.new("L", frame.size)
        layer.paste(digit(index), (left + right * step, top + down * step))
        frame = ImageChops.lighter(frame, layer)
    frame.save(FRAMES / f"frame-{step:03}.png")

"""Frames as NumPy arrays, and as the images of a message: raw gray bytes or PNG."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Gray: TypeAlias = NDArray[np.uint8]
#: A frame: an array ``[height, width]`` or ``[height, width, 1 or 3]`` of dtype uint8, or the bytes of a PNG or JPEG file.
FrameLike: TypeAlias = "Gray | bytes"

_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def encode_all(frames: Sequence[FrameLike] | Gray, size: tuple[int, int]) -> tuple[str, list[bytes]]:
    """The format and the images of a message. ``size``: the model's height and width. Raw if all frames have that size."""
    return _encoded([_checked(f"frames[{index}]", frame) for index, frame in enumerate(frames)], size)


def encode(frame: FrameLike, size: tuple[int, int]) -> tuple[str, bytes]:
    """As :func:`encode_all`, of one frame."""
    name, images = _encoded([_checked("frame", frame)], size)
    return name, images[0]


def _encoded(checked: Sequence[Gray | bytes], size: tuple[int, int]) -> tuple[str, list[bytes]]:
    if all(isinstance(frame, np.ndarray) and frame.shape == size for frame in checked):
        return "raw", [bytes(frame.tobytes()) for frame in checked if isinstance(frame, np.ndarray)]
    return "png", [frame if isinstance(frame, bytes) else encode_png(frame) for frame in checked]


def decode_all(images: Sequence[bytes], name: str, size: tuple[int, int]) -> Gray:
    """The images of an answer as an array ``[frames, height, width]``."""
    if name == "raw":
        pixels = np.frombuffer(b"".join(images), np.uint8)
        return pixels.reshape(len(images), *size).copy()
    decoded = [decode_png(image) for image in images]
    return np.stack(decoded) if decoded else np.zeros((0, *size), np.uint8)


def _checked(field: str, frame: FrameLike) -> Gray | bytes:
    if isinstance(frame, (bytes, bytearray, memoryview)):
        return bytes(frame)
    array: NDArray[Any] = np.asarray(frame)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.dtype != np.uint8 or not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)):
        raise TypeError(
            f"{field} is {array.dtype}{list(array.shape)}; a frame is uint8[height, width], uint8[height, width, 3], "
            "or the bytes of a PNG or JPEG file"
        )
    return np.ascontiguousarray(array)


def encode_png(frame: Gray) -> bytes:
    """A PNG of a gray ``[height, width]`` or colour ``[height, width, 3]`` image."""
    height, width = frame.shape[:2]
    rows = frame.reshape(height, -1)
    filtered = np.concatenate([np.zeros((height, 1), np.uint8), rows], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, 0 if frame.ndim == 2 else 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes(), 1)), (b"IEND", b"")]
    return _SIGNATURE + b"".join(_chunk(name, content) for name, content in chunks)


def _chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def decode_png(data: bytes) -> Gray:
    """The pixels ``[height, width]`` of a PNG as the server writes it: 8-bit gray, not interlaced. Raises ValueError if not."""
    if not data.startswith(_SIGNATURE):
        raise ValueError("not a PNG")
    width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", data[16:29])
    if (depth, colour, interlaced) != (8, 0, 0):
        raise ValueError("only 8-bit gray PNGs without interlacing can be read")
    packed, at = b"", len(_SIGNATURE)
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        if data[at + 4 : at + 8] == b"IDAT":
            packed += data[at + 8 : at + 8 + length]
        at += 12 + length
    rows = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(height, width + 1)
    pixels = np.zeros((height, width), np.uint8)
    above = np.zeros(width, np.uint8)
    for y, row in enumerate(rows):
        above = pixels[y] = _unfiltered(int(row[0]), row[1:], above)
    return pixels


def _unfiltered(kind: int, row: Gray, above: Gray) -> Gray:
    if kind == 0:
        return row
    if kind == 1:
        return np.cumsum(row, dtype=np.uint8)
    if kind == 2:
        return row + above
    out = bytearray(len(row))
    left = upper_left = 0
    for x, (value, up) in enumerate(zip(row.tolist(), above.tolist())):
        guess = (left + up) // 2 if kind == 3 else _paeth(left, up, upper_left)
        left = out[x] = (value + guess) & 255
        upper_left = up
    return np.frombuffer(bytes(out), np.uint8)


def _paeth(left: int, up: int, upper_left: int) -> int:
    estimate = left + up - upper_left
    to_left, to_up, to_upper_left = abs(estimate - left), abs(estimate - up), abs(estimate - upper_left)
    if to_left <= to_up and to_left <= to_upper_left:
        return left
    return up if to_up <= to_upper_left else upper_left

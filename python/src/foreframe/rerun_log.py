"""What a model predicts for a robot, for Rerun's viewer; needs the extra ``foreframe[rerun]``."""

from __future__ import annotations

import numpy as np
import rerun

from .images import Gray
from .records import Answer

#: The entities that :class:`RerunLog` logs, below its prefix.
CAMERA, PREDICTED, ERROR, EXPECTED_ERROR, NOVELTY = "camera", "predicted", "error", "expected_error", "novelty"


class RerunLog:
    """Logs the frames of a session and what was predicted for each of them, on the timeline ``robot_time``.

    Each prediction is logged at the time that it is of, so that ``camera`` and ``predicted`` are in step: one horizon after its
    answer. ``error`` is the mean squared error between both and ``expected_error`` the one that the model expected, intensities 0
    to 1. ``novelty`` is that of the answer to the frame.
    """

    def __init__(self, recording: rerun.RecordingStream, frame_period_s: float, prefix: str = "foreframe") -> None:
        self._recording = recording
        self._period_s = frame_period_s
        self._prefix = prefix
        self._count = 0
        #: The last predicted frame and its expected error, by the number of the frame that it is of.
        self._due: dict[int, tuple[Gray, float | None]] = {}

    def step(self, frame: Gray, answer: Answer) -> None:
        """Logs the next frame ``[height, width]`` with the session's answer to it."""
        at = self._count
        self._count += 1
        self._recording.set_time("robot_time", duration=at * self._period_s)
        self._log(CAMERA, rerun.Image(frame))
        if at in self._due:
            predicted, expected = self._due.pop(at)
            self._log(PREDICTED, rerun.Image(predicted))
            # A frame that the server resized cannot be compared with the prediction.
            if predicted.shape == np.shape(frame):
                difference = (predicted.astype(np.float64) - frame) / 255
                self._log(ERROR, rerun.Scalars(float(np.mean(difference**2))))
            if expected is not None:
                self._log(EXPECTED_ERROR, rerun.Scalars(expected))
        prediction = answer.prediction
        if prediction is None:
            # A new context: what was predicted before belongs to other frames.
            self._due.clear()
            return
        if prediction.novelty is not None:
            self._log(NOVELTY, rerun.Scalars(prediction.novelty))
        horizon = len(prediction.frames)
        expected_mse = prediction.expected_mse
        self._due[at + horizon] = (prediction.frames[-1], float(expected_mse[-1]) if len(expected_mse) else None)

    def _log(self, name: str, value: rerun.AsComponents) -> None:
        self._recording.log(f"{self._prefix}/{name}", value)

"""What Rerun's own reader finds in a recording of a session."""

from pathlib import Path

import numpy as np
import pytest

import foreframe
from conftest import Drive

rerun = pytest.importorskip("rerun", reason="the extra foreframe[rerun] is not installed")

HORIZON, CONTEXT, PERIOD_S = 5, 5, 0.2
#: The column with the values of an entity.
VALUES = {"camera": "Image:buffer", "predicted": "Image:buffer"}


def read(path: Path) -> dict[str, dict[float, np.ndarray]]:
    """By entity and time, the values in a recording."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[float, np.ndarray]] = {}
    for chunk in RrdReader(str(path)).stream():
        *_, prefix, name = str(chunk.entity_path).split("/")
        if prefix != "foreframe":
            continue
        batch = chunk.to_record_batch()
        times_ns = batch.column("robot_time").cast("int64").to_pylist()
        values = batch.column(VALUES.get(name, "Scalars:scalars")).to_pylist()
        # Each row is a list of components: one image or one number.
        rows = found.setdefault(name, {})
        rows.update((round(time_ns / 1e9, 3), np.ravel(value)) for time_ns, value in zip(times_ns, values))
    return {name: dict(sorted(rows.items())) for name, rows in found.items()}


def test_frames_predictions_and_errors_are_in_the_recording(client: foreframe.Client, drive: Drive, tmp_path: Path) -> None:
    from foreframe.rerun_log import RerunLog

    path = tmp_path / "drive.rrd"
    recording = rerun.RecordingStream("foreframe")
    recording.save(path)
    log, answers = RerunLog(recording, PERIOD_S), []
    with client.session("moving-flow") as session:
        for frame, action, state in zip(drive.frames, drive.actions, drive.states):
            answers.append(session.step(frame, action=action, state=state))
            log.step(frame, answers[-1])
    recording.flush()
    recording.disconnect()
    columns = read(path)
    times = [round(index * PERIOD_S, 3) for index in range(len(drive.frames))]
    assert list(columns["camera"]) == times
    first = CONTEXT - 1 + HORIZON
    assert list(columns["predicted"]) == times[first:]
    assert list(columns["novelty"]) == times[CONTEXT - 1 :]
    for index in range(first, len(drive.frames)):
        prediction = answers[index - HORIZON].prediction
        assert prediction is not None
        assert np.array_equal(columns["camera"][times[index]], drive.frames[index].reshape(-1))
        assert np.array_equal(columns["predicted"][times[index]], prediction.frames[-1].reshape(-1))
        error = np.mean(((prediction.frames[-1].astype(float) - drive.frames[index]) / 255) ** 2)
        assert np.isclose(columns["error"][times[index]][0], error)
        assert np.isclose(columns["expected_error"][times[index]][0], prediction.expected_mse[-1])

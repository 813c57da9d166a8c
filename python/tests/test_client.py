"""Predictions, rollouts, models, data sets and jobs of a real server."""

import asyncio
import subprocess
import threading

import numpy as np
import pytest

import foreframe
from conftest import MODELS, PROGRAM, Drive
from foreframe.images import decode_png, encode_png

MODEL = "moving-flow"


def test_a_model_has_the_bounds_of_its_channels(client: foreframe.Client) -> None:
    spec = client.model(MODEL).spec
    assert [(channel.name, channel.unit) for channel in spec.actions] == [("linear", "m/s"), ("angular", "rad/s")]
    assert (spec.actions[0].low, spec.actions[0].high) == (0.0, 0.5)
    assert all(channel.low < channel.mean < channel.high for channel in spec.actions + spec.states)
    assert {model.name for model in client.models()} >= {MODEL, "static", "paper"}


def test_a_channel_without_known_range_is_bounded_by_three_deviations() -> None:
    (channel,) = foreframe.records.channels([{"name": "speed", "unit": "m/s", "mean": 1.0, "std": 0.5}], None)
    assert (channel.low, channel.high) == (-0.5, 2.5)


def test_a_prediction_is_an_array_and_says_how_far_to_trust_it(client: foreframe.Client, drive: Drive) -> None:
    predicted = client.predict(
        MODEL, drive.frames[:5], actions=drive.actions[:5], state=drive.states[4], plan=drive.actions[4:9]
    )
    assert predicted.frames.shape == (5, 64, 64) and predicted.frames.dtype == np.uint8
    assert predicted.expected_mse.shape == (5,) and predicted.mse_band_90.shape == (5, 2)
    assert predicted.novelty is not None and 0 <= predicted.novelty <= 1
    error = np.mean((predicted.frames[0] / 255.0 - drive.frames[5] / 255.0) ** 2)
    still = np.mean((drive.frames[4] / 255.0 - drive.frames[5] / 255.0) ** 2)
    assert error < still, "better than to repeat the last frame"


def test_files_and_frames_of_another_size_are_encoded(client: foreframe.Client, drive: Drive) -> None:
    arrays = client.predict(MODEL, drive.frames[:5], actions=drive.actions[:5], state=drive.states[4])
    files = [encode_png(frame) for frame in drive.frames[:5]]
    from_files = client.predict(MODEL, files, actions=drive.actions[:5], state=drive.states[4])
    assert np.array_equal(arrays.frames, from_files.frames)
    large = np.repeat(np.repeat(drive.frames[:5], 2, axis=1), 2, axis=2)
    colour = np.repeat(large[..., None], 3, axis=3)
    resized = client.predict(MODEL, colour, actions=drive.actions[:5], state=drive.states[4], resize="stretch")
    assert np.abs(resized.frames.astype(int) - arrays.frames).mean() < 3
    with pytest.raises(foreframe.ApiError, match="128×128 px"):
        client.predict(MODEL, large, actions=drive.actions[:5], state=drive.states[4])
    with pytest.raises(TypeError, match="frames\\[0\\] is float64"):
        client.predict(MODEL, large / 255.0)


def test_a_model_that_estimates_depth_reads_the_state_at_each_frame(client: foreframe.Client, drive: Drive) -> None:
    plan = drive.actions[4:9]
    predicted = client.predict("rooms", drive.frames[:5], states=drive.states[:5], plan=plan)
    found = client.rollouts("rooms", drive.frames[:5], [plan], states=drive.states[:5])
    with client.session("rooms") as session:
        for n in range(5):
            answer = session.step(drive.frames[n], action=drive.actions[n], state=drive.states[n], plan=plan)
    assert answer.prediction is not None
    for frames in (predicted.frames, found.frames[0]):
        assert np.abs(frames.astype(int) - answer.prediction.frames).max() <= 1


def test_another_camera_gives_another_prediction(client: foreframe.Client, drive: Drive) -> None:
    wide = foreframe.Camera(horizontal_fov_rad=1.6, tilt_down_rad=0.3, height_m=0.2)
    options = {"states": drive.states[:5], "plan": drive.actions[4:9]}
    own, other = (client.predict("rooms", drive.frames[:5], camera=camera, **options) for camera in (None, wide))
    assert not np.array_equal(own.frames, other.frames)
    with client.session("rooms", camera=wide) as session:
        for n in range(5):
            answer = session.step(drive.frames[n], action=drive.actions[n], state=drive.states[n], plan=options["plan"])
    assert answer.prediction is not None
    assert np.abs(other.frames.astype(int) - answer.prediction.frames).max() <= 1
    with pytest.raises(foreframe.ApiError, match="field of view"):
        client.predict("rooms", drive.frames[:5], camera=foreframe.Camera(9.0, 0.0), **options)


def test_a_png_is_read_as_it_was_written(drive: Drive) -> None:
    assert np.array_equal(decode_png(encode_png(drive.frames[0])), drive.frames[0])


def test_rollouts_have_one_row_for_each_plan(client: foreframe.Client, drive: Drive) -> None:
    plans = np.stack([np.tile(np.array([0.3, turn]), (5, 1)) for turn in (-0.8, 0.0, 0.8)])
    found = client.rollouts(MODEL, drive.frames[:5], plans, state=drive.states[4])
    assert found.frames.shape == (3, 5, 64, 64) and found.expected_mse.shape == (3, 5)
    alone = client.predict(MODEL, drive.frames[:5], state=drive.states[4], plan=plans[2])
    assert np.abs(found.frames[2].astype(int) - alone.frames).max() <= 1
    dark = found.frames[:, -1].mean(axis=(1, 2))
    assert found.best(lambda frames: float(frames[-1].mean())) == int(np.argmin(dark))


def test_a_plan_turns_to_its_goal(client: foreframe.Client, drive: Drive) -> None:
    goal = foreframe.Goal(position_m=(0.4, 0.3))
    found = client.plan("rooms", drive.frames[:5], goal, states=drive.states[:5], seed=3, samples=64, budget_ms=5000)
    assert found.actions.shape == (5, 2) and found.way.shape == (5, 3) and found.samples > 64
    assert found.clearance_checked and (found.safe or found.kind == "stop")
    assert found.frames is not None and found.frames.shape == (5, 64, 64)
    others = [plan for plan in (found, *found.runners_up) if plan.kind == "drawn"]
    assert others and all(plan.way[-1, 0] > -0.1 for plan in others)
    by_image = client.plan(
        MODEL,
        drive.frames[:5],
        foreframe.Goal(image=drive.frames[9]),
        state=drive.states[4],
        present=drive.actions[4:9],
        solver="mppi",
        samples=8,
        iterations=1,
        budget_ms=10_000,
    )
    assert "goal_image" in by_image.costs and by_image.predicted == 10
    with pytest.raises(foreframe.ApiError, match="goal is empty"):
        client.plan(MODEL, drive.frames[:5], foreframe.Goal(), state=drive.states[4])


def test_a_plan_shows_what_stands_in_the_way(server: foreframe.Server, client: foreframe.Client, drive: Drive) -> None:
    goal, search = foreframe.Goal(position_m=(0.4, 0.3)), {"seed": 3, "samples": 32, "budget_ms": 5000}
    context = {"states": drive.states[:5], "with_obstacles": True}
    shown = client.plan("rooms", drive.frames[:5], goal, **context, **search).obstacles
    assert shown is not None and shown.fixed_m.dtype == np.float32 and shown.fixed_m.shape[1] == 2 and len(shown.fixed_m) > 10
    assert np.all(shown.fixed_m[:, 0] > -0.1), "the camera looks ahead"
    assert len(shown.movers_m) == 6 and all(cells.ndim == 2 and cells.shape[1] == 2 for cells in shown.movers_m)
    assert client.plan("rooms", drive.frames[:5], goal, states=drive.states[:5], **search).obstacles is None
    with client.session("rooms") as session:
        for n in range(5):
            session.step(drive.frames[n], action=drive.actions[n], state=drive.states[n])
        of_session = session.plan(goal, with_obstacles=True, **search).obstacles
    assert of_session is not None and np.array_equal(of_session.fixed_m, shown.fixed_m)

    async def ask() -> foreframe.Plan:
        async with foreframe.AsyncClient(server.url) as twin:
            return await twin.plan("rooms", drive.frames[:5], goal, **context, **search)

    of_async = asyncio.run(ask()).obstacles
    assert of_async is not None and np.array_equal(of_async.fixed_m, shown.fixed_m)
    unchecked = client.plan(MODEL, drive.frames[:5], goal, state=drive.states[4], with_obstacles=True, **search)
    assert unchecked.obstacles is None and not unchecked.clearance_checked


def test_errors_have_the_words_of_the_server(client: foreframe.Client, drive: Drive) -> None:
    with pytest.raises(foreframe.ApiError, match="no model") as missing:
        client.model("nothing")
    assert missing.value.status == 404 and missing.value.kind == "urn:foreframe:problem:not-found"
    with pytest.raises(foreframe.ApiError, match="state is missing") as unfit:
        client.predict(MODEL, drive.frames[:5], actions=drive.actions[:5])
    assert unfit.value.status == 422 and unfit.value.request_id
    with foreframe.Client("http://127.0.0.1:1") as nobody, pytest.raises(foreframe.ConnectionFailed, match="foreframe serve"):
        nobody.models()


def test_a_server_with_keys_wants_one(tmp_path) -> None:
    made = subprocess.run(
        [PROGRAM, "keys", "create", "robot", "--data-dir", tmp_path / "data"], capture_output=True, text=True, check=True
    )
    key = made.stdout.strip().splitlines()[-1]
    with foreframe.serve(program=PROGRAM, data_dir=tmp_path / "data", models_dir=MODELS) as server:
        with server.client() as stranger:
            with pytest.raises(foreframe.ApiError, match="key") as refused:
                stranger.models()
            assert refused.value.status == 401
            with pytest.raises(foreframe.ApiError, match="key"):
                stranger.session("moving-flow").step(np.zeros((64, 64), np.uint8))
        with server.client(key=key) as known, known.session("static-flow") as session:
            assert session.step(np.zeros((64, 64), np.uint8)).have == 1


def test_a_key_that_no_header_can_hold_is_refused_without_telling_it() -> None:
    for key in ("ffk_secret\n", "ffk_secret…"):
        with pytest.raises(ValueError, match="API key") as refused:
            foreframe.Client(key=key)
        assert "secret" not in str(refused.value)


def test_a_job_is_followed_to_its_end(client: foreframe.Client) -> None:
    seen: list[foreframe.Job] = []
    lines: list[foreframe.LogLine] = []
    spec = {"kind": "collect", "name": "few", "scenario": "static-observer", "trials": 2, "seed": 1}
    job = client.submit(spec, idempotency_key="few-1")
    assert client.submit(spec, idempotency_key="few-1").id == job.id
    ended = client.wait(job, on_progress=seen.append, on_log=lines.append, timeout_s=60)
    assert ended.state == "succeeded" and seen[-1] == ended and lines
    assert client.dataset("few").episodes == 2 and [entry.name for entry in client.datasets()] == ["few"]
    assert [found.id for found in client.jobs(kind="collect", state="succeeded")] == [job.id]
    with pytest.raises(foreframe.ApiError, match="few"):
        client.submit(spec)
    client.delete_dataset("few")
    assert client.datasets() == []


def test_a_cancelled_job_is_an_error(client: foreframe.Client) -> None:
    job = client.submit({"kind": "collect", "name": "many", "scenario": "static-observer", "trials": 10000})
    cancel = threading.Timer(0.5, lambda: client.cancel(job.id))
    cancel.start()
    with pytest.raises(foreframe.JobFailed, match="cancelled") as failed:
        client.wait(job, timeout_s=60)
    cancel.join()
    assert failed.value.job.id == job.id


def test_the_async_client_does_the_same(server: foreframe.Server, client: foreframe.Client, drive: Drive) -> None:
    async def ask() -> tuple[foreframe.Prediction, foreframe.Rollouts, list[foreframe.Model], foreframe.Job]:
        async with foreframe.AsyncClient(server.url) as twin:
            inputs = {"actions": drive.actions[:5], "state": drive.states[4]}
            predicted, found, models = await asyncio.gather(
                twin.predict(MODEL, drive.frames[:5], **inputs),
                twin.rollouts(MODEL, drive.frames[:5], [drive.actions[4:9]], state=drive.states[4]),
                twin.models(),
            )
            job = await twin.submit({"kind": "collect", "name": "one", "scenario": "static-observer", "trials": 1})
            return predicted, found, models, await twin.wait(job, timeout_s=60)

    predicted, found, models, job = asyncio.run(ask())
    alone = client.predict(MODEL, drive.frames[:5], actions=drive.actions[:5], state=drive.states[4])
    assert np.abs(predicted.frames.astype(int) - alone.frames).max() <= 1
    assert found.frames.shape == (1, 5, 64, 64) and len(models) == len(client.models())
    assert job.state == "succeeded"
    client.delete_dataset("one")

"""Predictions, rollouts, models, data sets and jobs of a real server."""

import asyncio
import subprocess
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

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


def test_an_unsafe_plan_says_why_in_words(client: foreframe.Client, drive: Drive) -> None:
    huge = {"radius_m": 2.0, "solver": None, "seed": 1, "samples": 16, "budget_ms": 5000}
    found = client.plan("rooms", drive.frames[:5], foreframe.Goal(position_m=(0.4, 0.0)), states=drive.states[:5], **huge)
    assert (found.safe, found.reason) == (False, "no-free-way") and "would touch" in (found.detail or "")


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


def test_numbers_of_numpy_are_sent(client: foreframe.Client, drive: Drive) -> None:
    goal = foreframe.Goal(position_m=np.array([0.4, 0.3], np.float32), heading_rad=np.float32(0.1))
    camera = foreframe.Camera(np.float32(1.2), np.float32(0.2))
    limits = [{"low": np.float32(0), "high": 0.2}, {"low": -0.5, "high": np.float64(0.5)}]
    found = client.plan(
        "rooms", drive.frames[:5], goal, states=drive.states[:5], camera=camera, limits=limits, seed=np.int64(3), samples=8
    )
    assert found.actions[:, 0].max() <= 0.2
    predicted = client.predict(MODEL, drive.frames[:5], actions=drive.actions[:5], state=drive.states[4], steps=np.int64(2))
    assert len(predicted.frames) == 2
    with client.session(MODEL) as session:
        session.plan_every(1, foreframe.Goal(heading_rad=np.float32(0.1)), seed=np.int64(3))
        stamp = np.int64(7)
        answer = session.step(
            drive.frames[0], action=drive.actions[0], state=drive.states[0], steps=np.int64(2), timestamp_us=stamp
        )
        assert answer.timestamp_us == 7
    with client.environment("moving-observer", seed=np.int64(3), world={"frame_period_s": np.float32(0.25)}) as environment:
        assert environment.world["frame_period_s"] == 0.25


def test_a_number_that_cannot_be_sent_is_named(client: foreframe.Client, drive: Drive) -> None:
    window = {"actions": drive.actions[:5], "state": drive.states[4]}
    with pytest.raises(ValueError, match=r"state\[1\] is 1e\+300"):
        client.predict(MODEL, drive.frames[:5], **window | {"state": [0.0, 1e300, 0.0, 0.0, 0.0, 0.0]})
    with pytest.raises(ValueError, match="steps is 1180591620717411303424"):
        client.predict(MODEL, drive.frames[:5], **window, steps=2**70)
    with pytest.raises(ValueError, match="search.solver.seed is"):
        client.plan(MODEL, drive.frames[:5], foreframe.Goal(heading_rad=0.1), state=drive.states[4], seed=2**64)
    with pytest.raises(ValueError, match="settings.rate is nan"):
        client.submit({"kind": "train", "settings": {"rate": np.float32("nan")}})
    with client.environment("moving-observer") as environment, pytest.raises(ValueError, match=r"action\[1\] is nan"):
        environment.step([0.0, np.nan])


def test_errors_have_the_words_of_the_server(client: foreframe.Client, drive: Drive) -> None:
    with pytest.raises(foreframe.ApiError, match="no model") as missing:
        client.model("nothing")
    assert missing.value.status == 404 and missing.value.kind == "urn:foreframe:problem:not-found"
    with pytest.raises(foreframe.ApiError, match="state is missing") as unfit:
        client.predict(MODEL, drive.frames[:5], actions=drive.actions[:5])
    assert unfit.value.status == 422 and unfit.value.request_id
    with foreframe.Client("http://127.0.0.1:1") as nobody, pytest.raises(foreframe.ConnectionFailed, match="foreframe serve"):
        nobody.models()


class Between:
    """Something that answers instead of the server: with the first of ``answers``, of which the last stays."""

    def __init__(self) -> None:
        self.answers: list[tuple[int, dict[str, str], bytes]] = []

        class Handler(BaseHTTPRequestHandler):
            def do_GET(handler) -> None:
                status, headers, body = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
                handler.send_response(status)
                for name, value in headers.items():
                    handler.send_header(name, value)
                handler.end_headers()
                handler.wfile.write(body)

            do_POST = do_GET

            def log_message(handler, *_: Any) -> None:
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_port}"
        threading.Thread(target=self.http.serve_forever, daemon=True).start()


@pytest.fixture
def between() -> Iterator[Between]:
    between = Between()
    yield between
    between.http.shutdown()
    between.http.server_close()


PAGE = (200, {"Content-Type": "text/html"}, b"<html>Login</html>")


def test_what_is_no_answer_of_the_server_is_an_error_of_this_package(between: Between) -> None:
    redirect, other = (301, {"Location": "https://robot/"}, b""), (200, {}, b'{"other": 1}')
    words = [(PAGE, "<html>Login"), (redirect, "a redirect to https://robot/"), (other, '{"other"'), ((200, {}, b""), "it is empty")]
    with foreframe.Client(between.url) as client:
        for answer, found in words:
            between.answers = [answer]
            with pytest.raises(foreframe.ApiError, match=f"^not an answer of Foreframe: {found}") as refused:
                client.models()
            assert refused.value.status == answer[0]
        between.answers = [PAGE]
        with pytest.raises(foreframe.ApiError, match="not an answer of Foreframe"):
            client.wait("job-1")
        with pytest.raises(foreframe.ApiError, match="not an answer of Foreframe"):
            client.session(MODEL, reconnect_s=0).step(np.zeros((64, 64), np.uint8))
    with pytest.raises(ValueError, match="'http://localhost:port' is not the address of a server"):
        foreframe.Client("http://localhost:port")


def test_waiting_survives_a_load_balancer_that_lost_its_server(between: Between, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("foreframe.client.EVENTS_PAUSE_S", 0.01)
    progress = '"progress": {"done": 1, "total": 1, "message": ""}'
    job = f'{{"id": "job-1", "spec": {{"kind": "collect"}}, "state": "succeeded", "losses": {{}}, {progress}}}'
    events = (200, {"Content-Type": "text/event-stream"}, f"event: job\ndata: {job}\n\n".encode())
    between.answers = [(502, {}, b"<html>Bad Gateway</html>"), (503, {}, b""), events]
    with foreframe.Client(between.url) as client:
        assert client.wait("job-1", timeout_s=20).state == "succeeded"
    between.answers = [(502, {}, b""), events]

    async def wait() -> foreframe.Job:
        async with foreframe.AsyncClient(between.url) as twin:
            return await twin.wait("job-1", timeout_s=20)

    assert asyncio.run(wait()).state == "succeeded"


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
    for key in ("ffk_secret\n", "ffk_secret…", "ffk_secret ", ""):
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

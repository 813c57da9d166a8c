"""Sessions of a real server, whose connections break and which restarts."""

import asyncio
import socket
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import websockets.sync.client

import foreframe
from conftest import MODELS, PROGRAM, Drive

MODEL = "moving-flow"


def answers(session: foreframe.Session, drive: Drive, numbers: range) -> list[foreframe.Answer]:
    return [session.step(drive.frames[n], action=drive.actions[n], state=drive.states[n]) for n in numbers]


def same(found: list[foreframe.Answer], expected: list[foreframe.Answer]) -> None:
    assert [answer.seq for answer in found] == [answer.seq for answer in expected]
    for one, other in zip(found, expected):
        assert (one.prediction is None) == (other.prediction is None)
        if one.prediction and other.prediction:
            assert np.array_equal(one.prediction.frames, other.prediction.frames)


@pytest.fixture(scope="module")
def unbroken(client: foreframe.Client, drive: Drive) -> list[foreframe.Answer]:
    with client.session(MODEL) as session:
        return answers(session, drive, range(12))


def test_the_context_fills_and_then_each_frame_is_answered(unbroken: list[foreframe.Answer], drive: Drive) -> None:
    assert [answer.prediction is None for answer in unbroken] == [True] * 4 + [False] * 8
    assert (unbroken[1].have, unbroken[1].need) == (2, 5)
    last = unbroken[-1].prediction
    assert last is not None and last.frames.shape == (5, 64, 64) and last.model == MODEL and last.expected_mse.shape == (5,)


class Proxy:
    """Passes bytes between a client and the server, until it cuts all connections."""

    def __init__(self, url: str) -> None:
        self._target = ("127.0.0.1", int(url.rsplit(":", 1)[1]))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open: list[socket.socket] = []
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            far = socket.create_connection(self._target)
            self._open += [near, far]
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._pass, args=(source, sink), daemon=True).start()

    def _pass(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                sink.sendall(data)
        except OSError:
            pass
        self._end(sink)

    def _end(self, connection: socket.socket) -> None:
        try:
            connection.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass

    def cut(self) -> None:
        while self._open:
            connection = self._open.pop()
            self._end(connection)
            connection.close()

    def close(self) -> None:
        self._listener.close()
        self.cut()


@pytest.fixture
def proxy(server: foreframe.Server) -> Iterator[Proxy]:
    proxy = Proxy(server.url)
    yield proxy
    proxy.close()


def test_a_broken_connection_changes_no_prediction(proxy: Proxy, drive: Drive, unbroken: list[foreframe.Answer]) -> None:
    with foreframe.Client(proxy.url) as client, client.session(MODEL) as session:
        found = answers(session, drive, range(3))
        proxy.cut()
        found += answers(session, drive, range(3, 7))
        proxy.cut()
        found += answers(session, drive, range(7, 12))
    same(found, unbroken)
    assert not any(answer.replayed for answer in found), "the server kept the session"


def test_a_lost_session_is_begun_again_with_the_last_frames(
    client: foreframe.Client, drive: Drive, unbroken: list[foreframe.Answer]
) -> None:
    with client.session(MODEL) as session:
        found = answers(session, drive, range(8))
        client.run(foreframe.calls.delete_session(*session._flow.identity))
        with pytest.raises(foreframe.StreamClosed, match="deleted"):
            answers(session, drive, range(8, 9))
    with client.session(MODEL) as session:
        found = answers(session, drive, range(8))
        forget(client, session)
        found += answers(session, drive, range(8, 12))
    same(found, unbroken)
    assert [answer.replayed for answer in found] == [False] * 8 + [True] + [False] * 3


def forget(client: foreframe.Client, session: foreframe.Session) -> None:
    """The server loses the session while its socket is closed."""
    assert session._socket is not None
    session._socket.close()
    client.run(foreframe.calls.delete_session(*session._flow.identity))


def test_an_expired_session_is_begun_again(drive: Drive, unbroken: list[foreframe.Answer]) -> None:
    settings = {"stream_idle_ms": 200, "session_grace_ms": 50}
    with foreframe.serve(program=PROGRAM, models_dir=MODELS, settings=settings) as server, server.client() as client:
        with client.session(MODEL) as session:
            found = answers(session, drive, range(8))
            until_expired(client)
            found += answers(session, drive, range(8, 10))
            until_expired(client)
            session.rollouts([drive.actions[4:9]])
            found += answers(session, drive, range(10, 12))
    same(found, unbroken)
    assert found[8].replayed and found[10].replayed


def until_expired(client: foreframe.Client) -> None:
    """Waits until the server has no session; to list them is not to use them."""
    deadline = time.monotonic() + 60
    while client._http.get("/v1/sessions").json()["sessions"]:
        assert time.monotonic() < deadline, "the session does not expire"
        time.sleep(0.02)


class Interrupted(BaseException):
    """As KeyboardInterrupt, which pytest would take for its own."""


def interrupt(session: foreframe.Session, error: BaseException, is_read: bool) -> None:
    """The next answer is interrupted: before it is read, or after that."""
    connection = session._socket
    assert connection is not None
    read = connection.recv

    def broken(timeout: float) -> None:
        if is_read:
            read(timeout=timeout)
        raise error

    connection.recv = broken  # type: ignore[method-assign,assignment]


@pytest.mark.parametrize("is_read", [False, True])
def test_an_interrupted_frame_can_be_sent_again(
    client: foreframe.Client, drive: Drive, unbroken: list[foreframe.Answer], is_read: bool
) -> None:
    with client.session(MODEL) as session:
        found = answers(session, drive, range(8))
        interrupt(session, Interrupted(), is_read)
        # The traceback, which keeps what was interrupted alive, is still there at the next step.
        with pytest.raises(Interrupted) as _kept:
            answers(session, drive, range(8, 9))
        again = session.step(drive.frames[8], action=drive.actions[8], state=drive.states[8], timestamp_us=8)
        found += [again, *answers(session, drive, range(9, 12))]
    same(found, unbroken)
    assert again.timestamp_us == 8


@pytest.mark.parametrize("error", [Interrupted(), OSError("cut")])
def test_a_frame_whose_answer_got_lost_counts(
    client: foreframe.Client, drive: Drive, unbroken: list[foreframe.Answer], error: BaseException
) -> None:
    with client.session(MODEL, reconnect_s=0) as session:
        found = answers(session, drive, range(8))
        interrupt(session, error, is_read=True)
        with pytest.raises((Interrupted, foreframe.ConnectionFailed)):
            answers(session, drive, range(8, 9))
        session.rollouts([drive.actions[4:9]])
        found += answers(session, drive, range(9, 10))
        # The frame is also among those that are sent again.
        forget(client, session)
        session.rollouts([drive.actions[4:9]])
        found += answers(session, drive, range(10, 12))
    same(found, unbroken[:8] + unbroken[9:])
    assert found[9].replayed


def test_a_late_attempt_of_its_own_does_not_end_a_session(
    client: foreframe.Client, drive: Drive, unbroken: list[foreframe.Answer], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise Interrupted

    with client.session(MODEL) as session:
        found = answers(session, drive, range(8))
        interrupt(session, Interrupted(), is_read=True)
        with pytest.raises(Interrupted):
            answers(session, drive, range(8, 9))
        with monkeypatch.context() as patched, pytest.raises(Interrupted):
            patched.setattr(websockets.sync.client, "connect", interrupted)
            answers(session, drive, range(8, 9))
        found += answers(session, drive, range(8, 10))
        late = client.url.replace("http", "ws", 1) + "/v1/sessions/{}/stream?token={}".format(*session._flow.identity)
        with websockets.sync.client.connect(late) as connection:
            connection.recv()
        found += answers(session, drive, range(10, 12))
    same(found, unbroken)


def test_a_session_survives_a_restart_of_the_server(tmp_path, drive: Drive, unbroken: list[foreframe.Answer]) -> None:
    free = socket.create_server(("127.0.0.1", 0))
    port = free.getsockname()[1]
    free.close()
    options = {"program": PROGRAM, "models_dir": MODELS, "data_dir": tmp_path / "data", "port": port}
    server = foreframe.serve(**options)
    with server.client() as client, client.session(MODEL) as session:
        found = answers(session, drive, range(8))
        server.close()
        restart = threading.Thread(target=lambda: restarted.append(foreframe.serve(**options)))
        restarted: list[foreframe.Server] = []
        restart.start()
        found += answers(session, drive, range(8, 12))
        restart.join()
    restarted[0].close()
    same(found, unbroken)
    assert found[8].replayed


def test_a_server_that_stays_away_is_an_error(drive: Drive) -> None:
    server = foreframe.serve(program=PROGRAM, models_dir=MODELS)
    with server.client() as client, client.session(MODEL, reconnect_s=0.5) as session:
        answers(session, drive, range(1))
        server.close()
        with pytest.raises(foreframe.ConnectionFailed, match="in vain"):
            answers(session, drive, range(1, 2))


def test_a_refused_frame_changes_nothing(client: foreframe.Client, drive: Drive, unbroken: list[foreframe.Answer]) -> None:
    with client.session(MODEL) as session:
        found = answers(session, drive, range(6))
        with pytest.raises(foreframe.StreamError, match="state is missing") as refused:
            session.step(drive.frames[6], action=drive.actions[6])
        assert refused.value.code == "invalid" and session.next_seq == 6
        found += answers(session, drive, range(6, 12))
    same(found, unbroken)
    with pytest.raises(foreframe.ApiError, match="no model"):
        client.session("nothing").step(drive.frames[0])


def test_a_closed_session_says_so(client: foreframe.Client, drive: Drive) -> None:
    session = client.session(MODEL)
    answers(session, drive, range(1))
    session.close()
    with pytest.raises(foreframe.StreamClosed, match="^the session is closed$"):
        answers(session, drive, range(1, 2))


def test_a_session_rolls_plans_out_also_after_it_was_lost(client: foreframe.Client, drive: Drive) -> None:
    plans = [np.tile([0.3, turn], (5, 1)) for turn in (-0.5, 0.5)]
    with client.session(MODEL) as session:
        answers(session, drive, range(8))
        before = session.rollouts(plans)
        planned = session.plan(foreframe.Goal(heading_rad=0.5), seed=1, budget_ms=5000)
        forget(client, session)
        after = session.rollouts(plans)
        forget(client, session)
        again = session.plan(foreframe.Goal(heading_rad=0.5), seed=1, budget_ms=5000)
    assert np.array_equal(planned.actions, again.actions) and planned.way[-1, 2] > 0
    assert before.frames.shape == (2, 5, 64, 64) and np.array_equal(before.frames, after.frames)


def test_plans_come_with_the_predictions(proxy: Proxy, drive: Drive) -> None:
    goal, search = foreframe.Goal(heading_rad=0.5), {"seed": 1, "samples": 64, "budget_ms": 5000}
    with foreframe.Client(proxy.url) as client, client.session(MODEL) as session:
        with pytest.raises(foreframe.StreamError, match="goal is empty"):
            session.plan_every(1, foreframe.Goal())
        with pytest.raises(ValueError, match="goal"):
            session.plan_every(1)
        session.plan_every(1, goal, **search)
        answers(session, drive, range(5))
        asked = session.plan(goal, **search)
        found = next_plan(session, drive, 0)
        assert found.seq == 4 and np.array_equal(found.plan.actions, asked.actions), "the same as by a request"
        # Another stream of the session is told of the plans too.
        proxy.cut()
        assert next_plan(session, drive, session.next_seq).plan.samples == 258
        session.plan_every(0)
        last = session.next_seq
        answers(session, drive, range(4))
        session.plan(goal, **search)
        late = [answer.plan for answer in answers(session, drive, range(4)) if answer.plan]
        assert all(plan.seq < last for plan in late)


def next_plan(session: foreframe.Session, drive: Drive, from_seq: int) -> foreframe.FramePlan:
    """Sends frames until a plan from that frame or a later one comes."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        (answer,) = answers(session, drive, range(session.next_seq % 12, session.next_seq % 12 + 1))
        if answer.plan and answer.plan.seq >= from_seq:
            return answer.plan
    raise AssertionError("no plan came")


def test_a_cancelled_step_leaves_no_answer_behind(
    proxy: Proxy, drive: Drive, unbroken: list[foreframe.Answer], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def stream() -> list[foreframe.Answer]:
        found: list[foreframe.Answer] = []
        async with foreframe.AsyncClient(proxy.url) as client, client.session(MODEL) as session:

            async def step(n: int) -> foreframe.Answer:
                return await session.step(drive.frames[n], action=drive.actions[n], state=drive.states[n])

            for n in range(12):
                if n == 8:
                    waits, forever = asyncio.Event(), asyncio.Event()

                    async def never() -> None:
                        waits.set()
                        await forever.wait()

                    assert session._socket is not None
                    monkeypatch.setattr(session._socket, "recv", never)
                    cancelled = asyncio.create_task(step(n))
                    await waits.wait()
                    cancelled.cancel()
                    await asyncio.wait([cancelled])
                    monkeypatch.undo()
                found.append(await step(n))
        return found

    same(asyncio.run(stream()), unbroken)


def test_the_async_session_does_the_same(proxy: Proxy, drive: Drive, unbroken: list[foreframe.Answer]) -> None:
    async def stream() -> list[foreframe.Answer]:
        found = []
        async with foreframe.AsyncClient(proxy.url) as client, client.session(MODEL) as session:
            for n in range(12):
                if n == 6:
                    proxy.cut()
                found.append(await session.step(drive.frames[n], action=drive.actions[n], state=drive.states[n]))
            await session.rollouts([drive.actions[4:9]])
            plan = await session.plan(foreframe.Goal(heading_rad=0.2), with_obstacles=True)
            assert plan.actions.shape == (5, 2) and plan.obstacles is None
            await session.plan_every(1, foreframe.Goal(heading_rad=0.2), samples=16)
            await session.plan_every(0)
        return found

    same(asyncio.run(stream()), unbroken)

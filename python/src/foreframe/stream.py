"""The stream of a session without a socket: what happens in which order. Sessions perform the operations."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar
from urllib.parse import quote

import msgpack

from . import calls
from .calls import Call, Plans, Vector, Vectors, given, numbers
from .errors import ApiError, ConnectionFailed, StreamClosed, StreamError, Unavailable
from .images import FrameLike, encode
from .records import Answer, Camera, FramePlan, Goal, Plan, Prediction, Rollouts, Spec

T = TypeVar("T")

SUBPROTOCOL = "foreframe.v1.msgpack"
#: The pauses between two attempts to connect, in seconds; the first attempt comes at once.
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0
#: The server closes a stream for good only for these reasons.
FINAL_REASONS = frozenset({"replaced", "deleted", "revoked", "too_long"})
#: The HTTP statuses of a session that the server does not have: unknown, expired.
LOST_STATUSES = (404, 410)
#: How long the server may still accept an attempt to connect that the client has given up, in seconds.
ATTEMPT_S = 30.0


@dataclass(frozen=True)
class Open:
    """Opens the socket."""

    path: str


@dataclass(frozen=True)
class Shut:
    """Closes the socket, if one is open."""


@dataclass(frozen=True)
class Send:
    """Sends a binary message."""

    message: bytes


@dataclass(frozen=True)
class Receive:
    """Receives a binary message."""


@dataclass(frozen=True)
class Pause:
    """Waits."""

    seconds: float


#: What a session performs. A call gives its answer, `Receive` the message.
Operation: TypeAlias = "Open | Shut | Send | Receive | Pause | Call[Any]"
Flow: TypeAlias = "Generator[Operation, Any, T]"


class Broken(Exception):
    """The socket broke, or could not be opened now."""

    def __init__(self, why: str, retry_after_s: float = 0.0) -> None:
        super().__init__(why)
        self.retry_after_s = retry_after_s


class SessionFlow:
    """A session that survives its sockets, and its server.

    The server keeps a session for a while after its socket closed. If it lost the session (it restarted, or the client was
    away for too long), a new one is opened and the last frames of the context are sent again, so that the next prediction
    is the same. Frames are numbered by ``seq``, which counts on; the server's own numbers begin at 0 in each new session.

    If a step ends without an answer (an exception of a signal handler, a cancelled coroutine, ConnectionFailed), the stream
    is opened again, since the answer may still arrive on the old socket. Only then it is known whether the server has the frame.
    """

    def __init__(self, model: str, resize: str | None, camera: Camera | None, reconnect_s: float) -> None:
        self.spec: Spec | None = None
        self.version = 0
        #: Which frame is the next.
        self.next_seq = 0
        self._model = model
        self._resize = resize
        self._camera = camera
        self._reconnect_s = reconnect_s
        self._id = ""
        self._token = ""
        self._is_open = False
        #: Until when "replaced" may come from an attempt of this session itself.
        self._attempt_until = 0.0
        #: Why the session has ended for good; empty while it has not.
        self._end = ""
        #: The number of the frame that the server counts as 0.
        self._first_seq = 0
        #: The frame that the server expected next when the stream was opened.
        self._server_seq = 0
        #: The last frame that was sent.
        self._sent: dict[str, Any] = {}
        self._replayed = False
        #: What the server was told of plans; sent again to a new stream.
        self._plans: dict[str, Any] | None = None
        #: The newest plan that came since the last answer.
        self._newest_plan: Mapping[str, Any] | None = None
        #: The last frames that were answered.
        self._context: deque[dict[str, Any]] = deque()

    @property
    def identity(self) -> tuple[str, str]:
        """The session's id and token on the server; empty before it is open."""
        return self._id, self._token

    def open(self) -> Flow[None]:
        """Connects, if it is not connected."""
        deadline, pause = time.monotonic() + self._reconnect_s, 0.0
        while not self._is_open:
            try:
                yield from self._connect()
            except Broken as error:
                pause = yield from self._wait(error, deadline, pause)

    def step(
        self,
        frame: FrameLike,
        action: Vector | None,
        state: Vector | None,
        plan: Vectors | None,
        steps: int | None,
        timestamp_us: int | None,
    ) -> Flow[Answer]:
        """Sends a frame, gives its Answer."""
        yield from self.open()
        assert self.spec is not None
        image_format, image = encode(frame, self.spec.size)
        message: dict[str, Any] = {
            "type": "frame",
            "timestamp_us": time.time_ns() // 1000 if timestamp_us is None else timestamp_us,
            "image": image,
            "format": image_format,
            **given(action=numbers(action), state=numbers(state), plan=numbers(plan), steps=steps),
        }
        answer = yield from self._answered(message)
        return self._read(answer)

    def rollouts(self, plans: Plans, state: Vector | None, steps: int | None) -> Flow[Rollouts]:
        """The Rollouts from the last frame."""
        return self._asked(lambda spec: calls.session_rollouts(*self.identity, spec, plans, state=state, steps=steps))

    def plan(
        self,
        goal: Goal,
        state: Vector | None,
        present: Vectors | None,
        action: Vector | None,
        with_obstacles: bool,
        search: Mapping[str, Any],
    ) -> Flow[Plan]:
        """The Plan from the last frame."""

        def call(spec: Spec) -> Call[Plan]:
            return calls.session_plan(
                *self.identity,
                spec,
                goal,
                state=state,
                present=present,
                action=action,
                with_obstacles=with_obstacles,
                search=search,
            )

        return self._asked(call)

    def plan_every(
        self, frames: int, goal: Goal | None, with_obstacles: bool, search: Mapping[str, Any]
    ) -> Flow[None]:
        """Asks for a plan with every ``frames``-th prediction; 0: for none."""
        if frames < 0 or (frames > 0 and goal is None):
            raise ValueError(f"plan_every is {frames}, and the goal {goal}; give 1 or more with a goal, or 0")
        if frames == 0:
            # A new stream is not told of them any more.
            self._plans = None
        yield from self.open()
        assert self.spec is not None
        plans: dict[str, Any] = {"plan_every": frames}
        if goal is not None:
            plans["plan_request"] = calls.session_plan_body(self.spec, goal, with_obstacles, search)
        before, self._plans = self._plans, plans
        try:
            try:
                yield from self._closing_if_interrupted(self._configure_plans())
            except Broken:
                # A new stream is told of them when it is opened.
                self._is_open = False
                yield from self.open()
        except StreamError:
            self._plans = before
            raise

    def close(self) -> Flow[None]:
        """Ends the session on the server, if it can be reached."""
        self._end, self._is_open = "closed", False
        yield Shut()
        if self._id:
            try:
                yield calls.delete_session(*self.identity)
            except (ApiError, ConnectionFailed):
                # It is gone already, or ends by itself.
                pass

    def _asked(self, call: Callable[[Spec], Call[T]]) -> Flow[T]:
        """The answer to a request about the session, which may have been lost on the server."""
        yield from self.open()
        assert self.spec is not None
        try:
            found: T = yield call(self.spec)
            return found
        except ApiError as error:
            if error.status not in LOST_STATUSES:
                raise
        # The server lost the session, and the socket has not broken yet.
        self._is_open = False
        yield from self.open()
        found = yield call(self.spec)
        return found

    def _answered(self, message: dict[str, Any]) -> Flow[Mapping[str, Any]]:
        deadline, pause = time.monotonic() + self._reconnect_s, 0.0
        while True:
            try:
                if not self._is_open:
                    yield from self._connect()
                return (yield from self._closing_if_interrupted(self._exchange(message)))
            except Broken as error:
                self._is_open = self._is_open and error.retry_after_s > 0
                pause = yield from self._wait(error, deadline, pause)

    def _closing_if_interrupted(self, exchange: Flow[T]) -> Flow[T]:
        """An exchange. If it is interrupted, the stream is opened again, so that nothing else receives its answer."""
        try:
            return (yield from exchange)
        except (Broken, StreamError):
            raise
        except BaseException:
            self._is_open = False
            raise

    def _exchange(self, message: dict[str, Any]) -> Flow[Mapping[str, Any]]:
        """Sends a frame; gives the answer to it. If the server knows the frame already, it answers again."""
        if self._server_seq > self.next_seq and not _is_repeated(self._sent, message):
            # The server has the frame before, whose answer got lost.
            self._count(self._sent)
        self._sent = message
        yield from self._send(message, self.next_seq)
        answer = yield from self._answer(self.next_seq)
        self._count(message)
        return answer

    def _count(self, message: dict[str, Any]) -> None:
        """Counts a frame that is in the context of the server."""
        assert self.spec is not None
        self.next_seq += 1
        self._context.append(message)
        while len(self._context) > self.spec.context:
            self._context.popleft()

    def _send(self, message: dict[str, Any], seq: int) -> Flow[None]:
        try:
            yield Send(msgpack.packb({**message, "seq": seq - self._first_seq}))
        except Broken:
            # Why the server closed the socket stands in its last message; then this raises.
            while True:
                yield from self._receive()

    def _answer(self, seq: int) -> Flow[Mapping[str, Any]]:
        """The answer to a frame; answers to other frames are skipped."""
        while True:
            answer = yield from self._receive()
            if answer["type"] in ("prediction", "buffering", "overtaken") and answer["seq"] == seq - self._first_seq:
                return answer
            if answer["type"] == "error":
                if answer["code"] == "overloaded":
                    raise Broken(answer["detail"], retry_after_s=1.0)
                raise StreamError(answer["code"], answer["detail"])

    def _receive(self) -> Flow[Mapping[str, Any]]:
        answer: dict[str, Any] = msgpack.unpackb((yield Receive()))
        if answer["type"] == "plan":
            self._newest_plan = answer
        if answer["type"] == "closing":
            self._is_open = False
            yield Shut()
            is_own = answer["reason"] == "replaced" and time.monotonic() < self._attempt_until
            if answer["reason"] in FINAL_REASONS and not is_own:
                self._end = answer["reason"]
                raise StreamClosed(self._end)
            raise Broken(f"the server closed the stream: {answer['reason']}")
        return answer

    def _connect(self) -> Flow[None]:
        if self._end:
            raise StreamClosed(self._end)
        yield Shut()
        if self._id:
            try:
                ready = yield from self._open_socket()
                self._server_seq = ready["next_seq"] + self._first_seq
                # One more if the server had the frame whose answer got lost.
                if self._server_seq in (self.next_seq, self.next_seq + 1):
                    self._is_open = True
                    return
                yield Shut()
            except ApiError as error:
                if error.status not in LOST_STATUSES:
                    raise
        yield from self._begin()

    def _begin(self) -> Flow[None]:
        """Opens a new session, and sends the context again."""
        try:
            created = yield calls.create_session(self._model, self._resize, self._camera)
        except Unavailable as error:
            raise Broken(error.detail, error.retry_after_s) from error
        except ConnectionFailed as error:
            raise Broken(str(error)) from error
        self._id, self._token = created["id"], created["token"]
        # Attempts at the session before do not touch this one.
        self._attempt_until = 0.0
        # Its frame has another number now.
        self._newest_plan = None
        try:
            yield from self._open_socket()
        except ApiError as error:
            if error.status not in LOST_STATUSES:
                raise
            raise Broken("the server that made the session is gone") from error
        self._first_seq, self._server_seq = self.next_seq - len(self._context), self.next_seq
        self._replayed = bool(self._context)
        # All at once: each would wait for the answer to the one before.
        for index, message in enumerate(self._context):
            # Only the last of a full context is predicted from, and nobody reads that.
            yield from self._send(_one_step(message), self._first_seq + index)
        for index in range(len(self._context)):
            yield from self._answer(self._first_seq + index)
        self._is_open = True

    def _open_socket(self) -> Flow[Mapping[str, Any]]:
        try:
            yield Open(f"/v1/sessions/{self._id}/stream?token={quote(self._token)}")
            ready = yield from self._receive()
        except Unavailable as error:
            raise Broken(error.detail, error.retry_after_s) from error
        except BaseException:
            # The server may accept it all the same, and later than the next attempt.
            self._attempt_until = time.monotonic() + ATTEMPT_S
            raise
        self.spec, self.version = Spec.of(ready["spec"]), ready["version"]
        if self._plans is not None:
            try:
                yield from self._configure_plans()
            except StreamError:
                # Told once: a model that refuses the goal still predicts.
                self._plans = None
                raise
        return ready

    def _configure_plans(self) -> Flow[None]:
        yield Send(msgpack.packb({"type": "configure", **(self._plans or {})}))
        while True:
            answer = yield from self._receive()
            if answer["type"] == "configured":
                return
            if answer["type"] == "error":
                raise StreamError(answer["code"], answer["detail"])

    def _wait(self, error: Broken, deadline: float, pause: float) -> Flow[float]:
        seconds = max(pause, error.retry_after_s)
        if time.monotonic() + seconds > deadline:
            raise ConnectionFailed(f"the stream broke, and {self._reconnect_s:g} s of attempts were in vain: {error}")
        yield Pause(seconds)
        return min(max(2 * pause, FIRST_PAUSE_S), LONGEST_PAUSE_S)

    def _read(self, answer: Mapping[str, Any]) -> Answer:
        assert self.spec is not None
        prediction = None
        if answer["type"] == "prediction":
            known = {**answer, "model": self._model, "version": self.version}
            prediction = Prediction.of(known, self.spec.size)
        need = self.spec.context
        replayed, self._replayed = self._replayed, False
        newest, self._newest_plan = self._newest_plan, None
        plan = None
        if newest is not None:
            found = Plan.of(newest["answer"], self.spec.size)
            plan = FramePlan(newest["seq"] + self._first_seq, found, newest["skipped"])
        return Answer(
            seq=answer["seq"] + self._first_seq,
            # The server answers a repeated frame with the time of the first attempt.
            timestamp_us=self._sent["timestamp_us"],
            prediction=prediction,
            have=answer.get("have", need),
            need=need,
            replayed=replayed,
            plan=plan,
        )


def _is_repeated(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether both are the same frame, perhaps sent at different times."""
    return {**one, "timestamp_us": 0} == {**other, "timestamp_us": 0}


def _one_step(message: dict[str, Any]) -> dict[str, Any]:
    shortened = {**message, "steps": 1}
    if "plan" in message:
        shortened["plan"] = message["plan"][:1]
    return shortened

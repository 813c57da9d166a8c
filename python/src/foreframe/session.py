"""Sessions: frames in, predictions out, over a WebSocket that may break."""

from __future__ import annotations

import asyncio
import time
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

import websockets.asyncio.client
import websockets.sync.client
from websockets.exceptions import InvalidStatus, WebSocketException
from websockets.typing import Subprotocol

from .calls import Call, Plans, Vector, Vectors, authorization, plain, uses_proxy
from .errors import ApiError, ForeframeError, api_error
from .flow import follow, follow_async
from .images import FrameLike
from .records import Answer, Camera, Goal, Plan, Rollouts, Spec
from .stream import SUBPROTOCOL, Broken, Flow, Open, Operation, Pause, Receive, Send, SessionFlow, Shut

if TYPE_CHECKING:
    from .client import AsyncClient, Client

T = TypeVar("T")

#: How long to wait for a handshake or an answer, in seconds.
ANSWER_S = 30.0


def _socket_options(client: Client | AsyncClient) -> dict[str, Any]:
    return {
        "subprotocols": [Subprotocol(SUBPROTOCOL)],
        "additional_headers": authorization(client.key),
        "max_size": None,
        "open_timeout": ANSWER_S,
        "close_timeout": 1.0,
        "compression": None,
        "proxy": True if uses_proxy(client.url) else None,
    }


def _socket_url(client: Client | AsyncClient, path: str) -> str:
    return client.url.replace("http", "ws", 1) + path


def _refused(error: InvalidStatus) -> ApiError:
    response = error.response
    return api_error(response.status_code, response.headers, bytes(response.body or b""))


class Session:
    """Sends frames of one robot to a model; each is answered with the predicted frames.

    If the connection breaks, the next ``step`` connects again and continues: for up to ``reconnect_s`` seconds, then it
    raises ConnectionFailed. If the server lost the session meanwhile, the last frames are sent again first. Use it in one
    thread at a time, as a context manager: ``with client.session("moving-flow") as session: …``
    """

    def __init__(
        self,
        client: Client,
        model: str,
        *,
        resize: str | None = None,
        camera: Camera | None = None,
        reconnect_s: float = 30.0,
    ) -> None:
        self._client = client
        self._flow = SessionFlow(model, resize, camera, reconnect_s)
        self._socket: websockets.sync.client.ClientConnection | None = None

    @property
    def spec(self) -> Spec:
        """What the model takes. Bounds of channels: see ``Client.spec``."""
        if self._flow.spec is None:
            self._run(self._flow.open())
        assert self._flow.spec is not None
        return self._flow.spec

    @property
    def next_seq(self) -> int:
        """The number of the next frame."""
        return self._flow.next_seq

    def step(
        self,
        frame: FrameLike,
        *,
        action: Vector | None = None,
        state: Vector | None = None,
        plan: Vectors | None = None,
        steps: int | None = None,
        timestamp_us: int | None = None,
    ) -> Answer:
        """Sends the next frame with the action from it to the next frame, and the state at it; waits for the answer.

        ``plan``: the future actions. Default: ``action``, repeated. Raises StreamError if the server refuses the frame: then
        nothing has changed, and a corrected frame may follow.

        If it is interrupted or raises ConnectionFailed, the same frame may be sent again: it counts once. If another frame
        follows, the interrupted one counts if the server has it, which ``seq`` of the next answer shows.
        """
        return self._run(self._flow.step(frame, action, state, plan, steps, plain(timestamp_us)))

    def rollouts(self, plans: Plans, *, state: Vector | None = None, steps: int | None = None) -> Rollouts:
        """Predicts the frames of each of ``plans`` ``[plans, steps, action]`` from the last frame."""
        return self._run(self._flow.rollouts(plans, state, steps))

    def plan(
        self,
        goal: Goal,
        *,
        state: Vector | None = None,
        present: Vectors | None = None,
        action: Vector | None = None,
        with_obstacles: bool = False,
        **search: Any,
    ) -> Plan:
        """Searches for the plan that reaches ``goal`` best, from the last frame. See :meth:`Client.plan`.

        ``present`` is by default the plan of the last frame.
        """
        return self._run(self._flow.plan(goal, state, present, action, with_obstacles, search))

    def plan_every(
        self, frames: int, goal: Goal | None = None, *, with_obstacles: bool = False, **search: Any
    ) -> None:
        """Asks for a plan with every ``frames``-th prediction, from the next one on; 0: for none.

        The server searches beside the predictions, which do not wait; ``step`` gives the newest plan as ``answer.plan``, often of
        the frame before. ``goal`` is relative to the robot at the frame of each plan: call this again as the robot moves.
        ``search``: see :meth:`Client.plan`. Raises StreamError if a goal or a setting does not fit the model.
        """
        self._run(self._flow.plan_every(frames, goal, with_obstacles, search))

    def close(self) -> None:
        """Ends the session."""
        self._run(self._flow.close())

    def __enter__(self) -> Session:
        self._run(self._flow.open())
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _run(self, flow: Flow[T]) -> T:
        return follow(flow, self._perform)

    def _perform(self, operation: Operation) -> Any:
        match operation:
            case Call():
                return self._client.run(operation)
            case Pause(seconds):
                time.sleep(seconds)
            case Shut():
                socket, self._socket = self._socket, None
                if socket is not None:
                    socket.close()
            case Open(path):
                try:
                    url = _socket_url(self._client, path)
                    self._socket = websockets.sync.client.connect(url, **_socket_options(self._client)).__enter__()
                except InvalidStatus as error:
                    raise _refused(error) from error
                except (OSError, WebSocketException) as error:
                    raise Broken(str(error) or type(error).__name__) from error
            case Send() | Receive():
                return self._exchange(operation)

    def _exchange(self, operation: Send | Receive) -> bytes | None:
        if self._socket is None:
            raise Broken("no socket is open")
        try:
            if isinstance(operation, Send):
                self._socket.send(operation.message)
                return None
            message = self._socket.recv(timeout=ANSWER_S)
        except (OSError, WebSocketException) as error:
            raise Broken(str(error) or type(error).__name__) from error
        return message if isinstance(message, bytes) else message.encode()


class AsyncSession:
    """As :class:`Session`, with coroutines."""

    def __init__(
        self,
        client: AsyncClient,
        model: str,
        *,
        resize: str | None = None,
        camera: Camera | None = None,
        reconnect_s: float = 30.0,
    ) -> None:
        self._client = client
        self._flow = SessionFlow(model, resize, camera, reconnect_s)
        self._socket: websockets.asyncio.client.ClientConnection | None = None

    @property
    def spec(self) -> Spec:
        """What the model takes; after ``async with`` or the first step."""
        if self._flow.spec is None:
            raise ForeframeError("the session is not open yet; use it in `async with`")
        return self._flow.spec

    @property
    def next_seq(self) -> int:
        """The number of the next frame."""
        return self._flow.next_seq

    async def step(
        self,
        frame: FrameLike,
        *,
        action: Vector | None = None,
        state: Vector | None = None,
        plan: Vectors | None = None,
        steps: int | None = None,
        timestamp_us: int | None = None,
    ) -> Answer:
        """As :meth:`Session.step`."""
        return await self._run(self._flow.step(frame, action, state, plan, steps, plain(timestamp_us)))

    async def rollouts(self, plans: Plans, *, state: Vector | None = None, steps: int | None = None) -> Rollouts:
        """As :meth:`Session.rollouts`."""
        return await self._run(self._flow.rollouts(plans, state, steps))

    async def plan(
        self,
        goal: Goal,
        *,
        state: Vector | None = None,
        present: Vectors | None = None,
        action: Vector | None = None,
        with_obstacles: bool = False,
        **search: Any,
    ) -> Plan:
        """As :meth:`Session.plan`."""
        return await self._run(self._flow.plan(goal, state, present, action, with_obstacles, search))

    async def plan_every(
        self, frames: int, goal: Goal | None = None, *, with_obstacles: bool = False, **search: Any
    ) -> None:
        """As :meth:`Session.plan_every`."""
        await self._run(self._flow.plan_every(frames, goal, with_obstacles, search))

    async def close(self) -> None:
        """Ends the session."""
        await self._run(self._flow.close())

    async def __aenter__(self) -> AsyncSession:
        await self._run(self._flow.open())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        await self.close()

    async def _run(self, flow: Flow[T]) -> T:
        return await follow_async(flow, self._perform)

    async def _perform(self, operation: Operation) -> Any:
        match operation:
            case Call():
                return await self._client.run(operation)
            case Pause(seconds):
                await asyncio.sleep(seconds)
            case Shut():
                socket, self._socket = self._socket, None
                if socket is not None:
                    await socket.close()
            case Open(path):
                try:
                    url = _socket_url(self._client, path)
                    self._socket = await websockets.asyncio.client.connect(url, **_socket_options(self._client))
                except InvalidStatus as error:
                    raise _refused(error) from error
                except (OSError, WebSocketException) as error:
                    raise Broken(str(error) or type(error).__name__) from error
            case Send() | Receive():
                return await self._exchange(operation)

    async def _exchange(self, operation: Send | Receive) -> bytes | None:
        if self._socket is None:
            raise Broken("no socket is open")
        try:
            if isinstance(operation, Send):
                await self._socket.send(operation.message)
                return None
            message = await asyncio.wait_for(self._socket.recv(), ANSWER_S)
        except (OSError, WebSocketException, asyncio.TimeoutError) as error:
            raise Broken(str(error) or type(error).__name__) from error
        return message if isinstance(message, bytes) else message.encode()

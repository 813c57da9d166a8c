"""The client: one method for each call of the server. `AsyncClient` has them as coroutines."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from functools import partial
from types import TracebackType
from typing import Any, TypeAlias, TypeVar

import httpx
import numpy as np
from numpy.typing import NDArray

from . import calls
from .calls import Call, Plans, Vector, Vectors, authorization, uses_proxy
from .environment import Environment
from .errors import ConnectionFailed, JobFailed, Unavailable, api_error
from .events import EventReader
from .flow import follow, follow_async
from .images import FrameLike
from .records import Camera, Dataset, Goal, Job, LogLine, Model, Plan, Predicted, Prediction, Rollouts, Spec
from .session import AsyncSession, Session

T = TypeVar("T")
P = TypeVar("P", bound="Predicted | Plan")
#: Several calls, of which one may need the answer to another.
Flow: TypeAlias = "Generator[Call[Any], Any, T]"

DEFAULT_URL = "http://127.0.0.1:8642"
#: How long to wait before the events of a job are read again after a break, in seconds.
EVENTS_PAUSE_S = 1.0


def _unreachable(url: str, error: Exception) -> ConnectionFailed:
    return ConnectionFailed(f"no server answers at {url} ({error}); start one with: foreframe serve")


def _options(url: str, key: str | None, timeout_s: float) -> dict[str, Any]:
    """The options of the HTTP client. Raises ValueError for an address or a key that cannot be one."""
    try:
        base_url = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise ValueError(f"{url!r} is not the address of a server, such as {DEFAULT_URL}: {error}") from error
    return {"base_url": base_url, "headers": authorization(key), "timeout": timeout_s, "trust_env": uses_proxy(url)}


def _result(call: Call[T], response: httpx.Response) -> T:
    if not response.is_success:
        raise api_error(response.status_code, response.headers, response.content)
    try:
        return call.result(response.content)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise api_error(response.status_code, response.headers, response.content) from error


def _has_events(response: httpx.Response) -> bool:
    return response.is_success and response.headers.get("content-type", "").startswith("text/event-stream")


def _request(call: Call[Any]) -> dict[str, Any]:
    return {
        "method": call.method,
        "url": call.path,
        "params": dict(call.params),
        "content": call.content(),
        "headers": call.all_headers(),
    }


class _Specs:
    """The specs of models, so that a prediction needs one request."""

    def __init__(self) -> None:
        self._known: dict[str, Model] = {}

    def find(self, name: str) -> Flow[Spec]:
        model = self._known.get(name)
        if model is None:
            model = self._known[name] = yield calls.model(name)
        return model.spec

    def predicted(self, name: str, call_with: Callable[[Spec], Call[P]]) -> Flow[P]:
        """The answer to a call that needs the model's spec."""
        call = call_with((yield from self.find(name)))
        try:
            found: P = yield call
        except Exception:
            # Another version may have become active, with other frames.
            self.forget(name)
            raise
        model = self._known.get(name)
        if model is not None and model.active_version != found.version:
            self.forget(name)
        return found

    def forget(self, name: str) -> None:
        self._known.pop(name, None)


def _all(page: Callable[[str | None], Call[tuple[list[T], str | None]]]) -> Flow[list[T]]:
    found, after = yield page(None)
    while after is not None:
        more, after = yield page(after)
        found += more
    return list(found)


class Client:
    """A server. May be used by several threads at once.

    ``key``: an API key, if the server asks for one. ``timeout_s``: for one answer.
    """

    def __init__(self, url: str = DEFAULT_URL, *, key: str | None = None, timeout_s: float = 30.0) -> None:
        self.url = url.rstrip("/")
        self.key = key
        self._http = httpx.Client(**_options(self.url, key, timeout_s))
        self._specs = _Specs()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connections."""
        self._http.close()

    def run(self, call: Call[T]) -> T:
        """Makes a call. Raises ApiError or ConnectionFailed."""
        try:
            response = self._http.request(**_request(call))
        except httpx.TransportError as error:
            raise _unreachable(self.url, error) from error
        return _result(call, response)

    def _follow(self, flow: Flow[T]) -> T:
        return follow(flow, self.run)

    def spec(self, model: str) -> Spec:
        """What a model takes and gives; asked for once."""
        return self._follow(self._specs.find(model))

    def predict(
        self,
        model: str,
        frames: Sequence[FrameLike] | NDArray[np.uint8],
        *,
        actions: Vectors | None = None,
        state: Vector | None = None,
        states: Vectors | None = None,
        plan: Vectors | None = None,
        steps: int | None = None,
        resize: str | None = None,
        camera: Camera | None = None,
    ) -> Prediction:
        """Predicts the frames after ``frames``, the model's context, oldest first.

        ``plan``: the future actions; without it, the last of ``actions`` is repeated. ``state``: at the last frame.
        ``states``: at each of ``frames``, instead of ``state``; a model that estimates depth reads all of them. ``resize``:
        ``crop``, ``letterbox`` or ``stretch``, for frames of another size. ``camera``: where it is not the model's own, for a
        model that estimates depth.
        """
        call = partial(
            calls.predict,
            model,
            frames=frames,
            actions=actions,
            state=state,
            states=states,
            plan=plan,
            steps=steps,
            resize=resize,
            camera=camera,
        )
        return self._follow(self._specs.predicted(model, call))

    def rollouts(
        self,
        model: str,
        frames: Sequence[FrameLike] | NDArray[np.uint8],
        plans: Plans,
        *,
        state: Vector | None = None,
        states: Vectors | None = None,
        steps: int | None = None,
        resize: str | None = None,
        camera: Camera | None = None,
    ) -> Rollouts:
        """Predicts the frames of each of ``plans`` ``[plans, steps, action]`` from one context."""
        call = partial(
            calls.rollouts,
            model,
            frames=frames,
            plans=plans,
            state=state,
            states=states,
            steps=steps,
            resize=resize,
            camera=camera,
        )
        return self._follow(self._specs.predicted(model, call))

    def plan(
        self,
        model: str,
        frames: Sequence[FrameLike] | NDArray[np.uint8],
        goal: Goal,
        *,
        state: Vector | None = None,
        states: Vectors | None = None,
        present: Vectors | None = None,
        action: Vector | None = None,
        resize: str | None = None,
        camera: Camera | None = None,
        with_obstacles: bool = False,
        **search: Any,
    ) -> Plan:
        """Searches for the plan that reaches ``goal`` best, from a context.

        ``present``: the plan that the robot follows now, always one of the plans tried. ``action``: the action before the plan.
        ``with_obstacles``: whether the answer has what stands in the way, and where movers will be.
        ``search``: what is not the default, by keyword: ``solver`` (``random-shooting``, ``cem`` or ``mppi``), ``samples``,
        ``iterations``, ``seed``, ``budget_ms``, ``costs`` (weights by name), ``limits`` (for each action channel ``low``, ``high`` and
        maybe ``max_change``), ``steps``, ``finalists``, ``radius_m``, ``margin_m``, ``robot_height_m``. If no plan is safe, the plan is
        to stop, and ``safe`` is False.
        """
        call = partial(
            calls.plan,
            model,
            frames=frames,
            goal=goal,
            state=state,
            states=states,
            present=present,
            action=action,
            resize=resize,
            camera=camera,
            with_obstacles=with_obstacles,
            search=search,
        )
        return self._follow(self._specs.predicted(model, call))

    def session(
        self, model: str, *, resize: str | None = None, camera: Camera | None = None, reconnect_s: float = 30.0
    ) -> Session:
        """A session: send frame after frame, get a prediction after each. See :class:`Session`."""
        return Session(self, model, resize=resize, camera=camera, reconnect_s=reconnect_s)

    def models(self) -> list[Model]:
        """All models."""
        return self._follow(_all(calls.models))

    def model(self, name: str) -> Model:
        """One model."""
        return self.run(calls.model(name))

    def activate(self, model: str, version: int) -> Model:
        """Makes a version the active one."""
        self._specs.forget(model)
        return self.run(calls.activate(model, version))

    def datasets(self) -> list[Dataset]:
        """All data sets."""
        return self._follow(_all(calls.datasets))

    def dataset(self, name: str) -> Dataset:
        """One data set."""
        return self.run(calls.dataset(name))

    def delete_dataset(self, name: str) -> None:
        """Deletes a data set."""
        self.run(calls.delete_dataset(name))

    def jobs(
        self,
        *,
        kind: str | None = None,
        state: str | None = None,
        part_of: str | None = None,
        limit: int | None = None,
    ) -> list[Job]:
        """The newest jobs that are no parts, or the parts of one job."""
        return self.run(calls.jobs(kind, state, part_of, limit))

    def job(self, job_id: str) -> Job:
        """A job and its progress."""
        return self.run(calls.job(job_id))

    def submit(self, spec: Mapping[str, Any], *, idempotency_key: str | None = None) -> Job:
        """Queues a job: ``{"kind": "train", "name": …, "preset": …, "dataset": …}``; /docs on the server lists all fields."""
        return self.run(calls.submit(spec, idempotency_key))

    def cancel(self, job_id: str) -> Job:
        """Cancels a job."""
        return self.run(calls.change_job(job_id, "cancel"))

    def resume(self, job_id: str) -> Job:
        """Resumes a failed or cancelled job."""
        return self.run(calls.change_job(job_id, "resume"))

    def logs(self, job_id: str, *, after: int = 0) -> list[LogLine]:
        """Up to 1000 lines of a job's log."""
        return self.run(calls.logs(job_id, after))

    def wait(
        self,
        job: Job | str,
        *,
        on_progress: Callable[[Job], None] | None = None,
        on_log: Callable[[LogLine], None] | None = None,
        timeout_s: float | None = None,
    ) -> Job:
        """Waits until a job has succeeded. ``on_progress`` gets the job whenever it changes, ``on_log`` each line of its log.

        Raises JobFailed if it failed or was cancelled, TimeoutError.
        """
        job_id = job if isinstance(job, str) else job.id
        watched = _Watched(job_id, on_progress, on_log, timeout_s)
        while True:
            try:
                with self._http.stream("GET", watched.path, headers=watched.headers(), timeout=watched.timeout()) as response:
                    if not _has_events(response):
                        raise api_error(response.status_code, response.headers, response.read())
                    for line in response.iter_lines():
                        watched.line(line)
            except httpx.TransportError as error:
                if watched.is_late() or not _is_break(error):
                    raise _unreachable(self.url, error) from error
            except Unavailable:
                if watched.is_late():
                    raise
            if watched.over is not None:
                return watched.over
            watched.check_time()
            time.sleep(EVENTS_PAUSE_S)

    def environment(self, scenario: str, *, seed: int = 0, world: Mapping[str, Any] | None = None) -> Environment:
        """A simulated robot on the server: ``static-observer``, ``moving-observer``, ``crowded`` or
        ``crossing``."""
        return Environment(self, scenario, seed, world)


def _is_break(error: Exception) -> bool:
    """Whether a stream of events broke, and the server may continue it."""
    return isinstance(error, (httpx.RemoteProtocolError, httpx.ReadError, httpx.ReadTimeout, httpx.ConnectError))


class _Watched:
    """A job whose events are read."""

    def __init__(
        self,
        job_id: str,
        on_progress: Callable[[Job], None] | None,
        on_log: Callable[[LogLine], None] | None,
        timeout_s: float | None,
    ) -> None:
        self.path = calls.path("jobs", job_id, "events")
        self.over: Job | None = None
        self._job_id = job_id
        self._on_progress = on_progress
        self._on_log = on_log
        self._deadline = None if timeout_s is None else time.monotonic() + timeout_s
        self._events = EventReader()
        self._last_event = time.monotonic()

    def headers(self) -> dict[str, str]:
        last = self._events.last_id
        return {} if last is None else {"Last-Event-ID": last}

    def timeout(self) -> float:
        # The server sends a comment every 15 s.
        return 60.0 if self._deadline is None else min(60.0, max(0.1, self._deadline - time.monotonic()))

    def line(self, line: str) -> None:
        self._last_event = time.monotonic()
        self.check_time()
        event = self._events.line(line)
        if event is None:
            return
        name, body = event
        if name == "log" and self._on_log:
            self._on_log(LogLine.of(body))
        if name == "job":
            job = Job.of(body)
            if self._on_progress:
                self._on_progress(job)
            if job.state in ("failed", "cancelled"):
                raise JobFailed(job)
            self.over = job if job.is_over else None

    def check_time(self) -> None:
        if self._deadline is not None and time.monotonic() >= self._deadline:
            raise TimeoutError(f"{self._job_id} has not ended in time")

    def is_late(self) -> bool:
        """Whether the server has been away for too long."""
        return time.monotonic() - self._last_event > 60.0


class AsyncClient:
    """As :class:`Client`, with coroutines, but without ``environment``."""

    def __init__(self, url: str = DEFAULT_URL, *, key: str | None = None, timeout_s: float = 30.0) -> None:
        self.url = url.rstrip("/")
        self.key = key
        self._http = httpx.AsyncClient(**_options(self.url, key, timeout_s))
        self._specs = _Specs()

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes the connections."""
        await self._http.aclose()

    async def run(self, call: Call[T]) -> T:
        """Makes a call. Raises ApiError or ConnectionFailed."""
        try:
            response = await self._http.request(**_request(call))
        except httpx.TransportError as error:
            raise _unreachable(self.url, error) from error
        return _result(call, response)

    async def _follow(self, flow: Flow[T]) -> T:
        return await follow_async(flow, self.run)

    async def spec(self, model: str) -> Spec:
        """What a model takes and gives; asked for once."""
        return await self._follow(self._specs.find(model))

    async def predict(
        self,
        model: str,
        frames: Sequence[FrameLike] | NDArray[np.uint8],
        *,
        actions: Vectors | None = None,
        state: Vector | None = None,
        states: Vectors | None = None,
        plan: Vectors | None = None,
        steps: int | None = None,
        resize: str | None = None,
        camera: Camera | None = None,
    ) -> Prediction:
        """As :meth:`Client.predict`."""
        call = partial(
            calls.predict,
            model,
            frames=frames,
            actions=actions,
            state=state,
            states=states,
            plan=plan,
            steps=steps,
            resize=resize,
            camera=camera,
        )
        return await self._follow(self._specs.predicted(model, call))

    async def rollouts(
        self,
        model: str,
        frames: Sequence[FrameLike] | NDArray[np.uint8],
        plans: Plans,
        *,
        state: Vector | None = None,
        states: Vectors | None = None,
        steps: int | None = None,
        resize: str | None = None,
        camera: Camera | None = None,
    ) -> Rollouts:
        """As :meth:`Client.rollouts`."""
        call = partial(
            calls.rollouts,
            model,
            frames=frames,
            plans=plans,
            state=state,
            states=states,
            steps=steps,
            resize=resize,
            camera=camera,
        )
        return await self._follow(self._specs.predicted(model, call))

    async def plan(
        self,
        model: str,
        frames: Sequence[FrameLike] | NDArray[np.uint8],
        goal: Goal,
        *,
        state: Vector | None = None,
        states: Vectors | None = None,
        present: Vectors | None = None,
        action: Vector | None = None,
        resize: str | None = None,
        camera: Camera | None = None,
        with_obstacles: bool = False,
        **search: Any,
    ) -> Plan:
        """As :meth:`Client.plan`."""
        call = partial(
            calls.plan,
            model,
            frames=frames,
            goal=goal,
            state=state,
            states=states,
            present=present,
            action=action,
            resize=resize,
            camera=camera,
            with_obstacles=with_obstacles,
            search=search,
        )
        return await self._follow(self._specs.predicted(model, call))

    def session(
        self, model: str, *, resize: str | None = None, camera: Camera | None = None, reconnect_s: float = 30.0
    ) -> AsyncSession:
        """As :meth:`Client.session`."""
        return AsyncSession(self, model, resize=resize, camera=camera, reconnect_s=reconnect_s)

    async def models(self) -> list[Model]:
        """All models."""
        return await self._follow(_all(calls.models))

    async def model(self, name: str) -> Model:
        """One model."""
        return await self.run(calls.model(name))

    async def activate(self, model: str, version: int) -> Model:
        """Makes a version the active one."""
        self._specs.forget(model)
        return await self.run(calls.activate(model, version))

    async def datasets(self) -> list[Dataset]:
        """All data sets."""
        return await self._follow(_all(calls.datasets))

    async def dataset(self, name: str) -> Dataset:
        """One data set."""
        return await self.run(calls.dataset(name))

    async def delete_dataset(self, name: str) -> None:
        """Deletes a data set."""
        await self.run(calls.delete_dataset(name))

    async def jobs(
        self,
        *,
        kind: str | None = None,
        state: str | None = None,
        part_of: str | None = None,
        limit: int | None = None,
    ) -> list[Job]:
        """The newest jobs that are no parts, or the parts of one job."""
        return await self.run(calls.jobs(kind, state, part_of, limit))

    async def job(self, job_id: str) -> Job:
        """A job and its progress."""
        return await self.run(calls.job(job_id))

    async def submit(self, spec: Mapping[str, Any], *, idempotency_key: str | None = None) -> Job:
        """As :meth:`Client.submit`."""
        return await self.run(calls.submit(spec, idempotency_key))

    async def cancel(self, job_id: str) -> Job:
        """Cancels a job."""
        return await self.run(calls.change_job(job_id, "cancel"))

    async def resume(self, job_id: str) -> Job:
        """Resumes a failed or cancelled job."""
        return await self.run(calls.change_job(job_id, "resume"))

    async def logs(self, job_id: str, *, after: int = 0) -> list[LogLine]:
        """Up to 1000 lines of a job's log."""
        return await self.run(calls.logs(job_id, after))

    async def wait(
        self,
        job: Job | str,
        *,
        on_progress: Callable[[Job], None] | None = None,
        on_log: Callable[[LogLine], None] | None = None,
        timeout_s: float | None = None,
    ) -> Job:
        """As :meth:`Client.wait`."""
        job_id = job if isinstance(job, str) else job.id
        watched = _Watched(job_id, on_progress, on_log, timeout_s)
        while True:
            try:
                stream = self._http.stream("GET", watched.path, headers=watched.headers(), timeout=watched.timeout())
                async with stream as response:
                    if not _has_events(response):
                        raise api_error(response.status_code, response.headers, await response.aread())
                    async for line in response.aiter_lines():
                        watched.line(line)
            except httpx.TransportError as error:
                if watched.is_late() or not _is_break(error):
                    raise _unreachable(self.url, error) from error
            except Unavailable:
                if watched.is_late():
                    raise
            if watched.over is not None:
                return watched.over
            watched.check_time()
            await asyncio.sleep(EVENTS_PAUSE_S)

"""The HTTP calls of the server, without a connection: what to send, and how to read the answer."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, TypeAlias, TypeVar
from urllib.parse import quote, urlsplit

import msgpack
import numpy as np
from numpy.typing import NDArray

from .images import FrameLike, encode_all
from .records import Camera, Dataset, Goal, Job, LogLine, Model, Plan, Prediction, Rollouts, Spec

T = TypeVar("T")

#: A vector, or a list of vectors, of numbers.
Vector: TypeAlias = "Sequence[float] | NDArray[Any]"
Vectors: TypeAlias = "Sequence[Vector] | NDArray[Any]"
Plans: TypeAlias = "Sequence[Vectors] | NDArray[Any]"


@dataclass(frozen=True)
class Call(Generic[T]):
    """A request, and how its answer is read."""

    method: str
    path: str
    read: Callable[[Any], T]
    body: Mapping[str, Any] | None = None
    params: Mapping[str, Any] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    #: Whether both bodies are MessagePack, because they hold images.
    is_binary: bool = False

    def content(self) -> bytes | None:
        if self.body is None:
            return None
        try:
            return self._packed(self.body)
        except (OverflowError, ValueError) as error:
            raise ValueError(self._unsendable(self.body, "")) from error

    def _packed(self, value: Any) -> bytes:
        if self.is_binary:
            packed: bytes = msgpack.packb(value, use_single_float=True)
            return packed
        return json.dumps(value, allow_nan=False).encode()

    def _unsendable(self, value: Any, name: str) -> str:
        """What cannot be sent: the innermost part of a value, with its name."""
        parts: dict[str, Any] = {}
        if isinstance(value, Mapping):
            parts = {f"{name}.{key}" if name else key: part for key, part in value.items()}
        elif isinstance(value, (list, tuple)):
            parts = {f"{name}[{index}]": part for index, part in enumerate(value)}
        for place, part in parts.items():
            try:
                self._packed(part)
            except (OverflowError, ValueError):
                return self._unsendable(part, place)
        return f"{name} is {value!r}, which cannot be sent; give a finite number below 3.4e38, or an integer of at most 64 bits"

    def all_headers(self) -> dict[str, str]:
        media_type = "application/msgpack" if self.is_binary else "application/json"
        typed = {} if self.body is None else {"Content-Type": media_type}
        return {**typed, "Accept": media_type, **self.headers}

    def result(self, content: bytes) -> T:
        if self.is_binary:
            return self.read(msgpack.unpackb(content))
        return self.read(json.loads(content) if content else None)


def path(*parts: str | int) -> str:
    return "/".join(("/v1", *(quote(str(part), safe="") for part in parts)))


def authorization(key: str | None) -> dict[str, str]:
    """The header of an API key. Raises ValueError, which does not tell the key, for a key that no header can hold."""
    if key is None:
        return {}
    if not key:
        raise ValueError("the API key is empty; give None to a server without keys")
    if " " in key or not (key.isascii() and key.isprintable()):
        raise ValueError("the API key has a space, a line break or another character that no key has")
    return {"Authorization": f"Bearer {key}"}


def uses_proxy(url: str) -> bool:
    """Whether the proxies of the environment count for a server: not for one on this machine."""
    parts = urlsplit(url)
    return not (parts.scheme == "http" and parts.hostname in ("127.0.0.1", "::1", "localhost"))


def numbers(values: Any) -> Any:
    """Numbers as nested lists, whatever kind of array they are in."""
    return None if values is None else np.asarray(values, np.float64).tolist()


def plain(value: Any) -> Any:
    """A value whose parts of NumPy's types are numbers and lists."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: plain(part) for name, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, (list, tuple)) else value


def given(**fields: Any) -> dict[str, Any]:
    """The fields that are not None. Lists are plain already: they may be long."""
    known = {name: value for name, value in fields.items() if value is not None}
    return {name: value if isinstance(value, list) else plain(value) for name, value in known.items()}


def models(after: str | None) -> Call[tuple[list[Model], str | None]]:
    return Call("GET", path("models"), _page("models", Model.of), params=given(after=after))


def model(name: str) -> Call[Model]:
    return Call("GET", path("models", name), Model.of)


def activate(name: str, version: int) -> Call[Model]:
    return Call("POST", path("models", name, "versions", version, "activate"), Model.of)


def predict(
    name: str,
    spec: Spec,
    frames: Sequence[FrameLike] | NDArray[np.uint8],
    *,
    actions: Vectors | None,
    state: Vector | None,
    states: Vectors | None,
    plan: Vectors | None,
    steps: int | None,
    resize: str | None,
    camera: Camera | None,
) -> Call[Prediction]:
    image_format, images = encode_all(frames, spec.size)
    body = given(
        frames=images,
        format=image_format,
        actions=numbers(actions),
        state=numbers(state),
        states=numbers(states),
        plan=numbers(plan),
        steps=steps,
        resize=resize,
        camera=camera and camera.body(),
    )
    read = partial(Prediction.of, size=spec.size)
    return Call("POST", path("models", name, "predict"), read, body, is_binary=True)


def rollouts(
    name: str,
    spec: Spec,
    frames: Sequence[FrameLike] | NDArray[np.uint8],
    plans: Plans,
    *,
    state: Vector | None,
    states: Vectors | None,
    steps: int | None,
    resize: str | None,
    camera: Camera | None,
) -> Call[Rollouts]:
    image_format, images = encode_all(frames, spec.size)
    body = given(
        frames=images,
        format=image_format,
        plans=[numbers(plan) for plan in plans],
        state=numbers(state),
        states=numbers(states),
        steps=steps,
        resize=resize,
        camera=camera and camera.body(),
    )
    read = partial(Rollouts.of, size=spec.size)
    return Call("POST", path("models", name, "rollouts"), read, body, is_binary=True)


def session_rollouts(
    session: str, token: str, spec: Spec, plans: Plans, *, state: Vector | None, steps: int | None
) -> Call[Rollouts]:
    body = given(format="raw", plans=[numbers(plan) for plan in plans], state=numbers(state), steps=steps)
    read, headers = partial(Rollouts.of, size=spec.size), {"x-session-token": token}
    return Call("POST", path("sessions", session, "rollouts"), read, body, headers=headers, is_binary=True)


def plan(
    name: str,
    spec: Spec,
    frames: Sequence[FrameLike] | NDArray[np.uint8],
    goal: Goal,
    *,
    state: Vector | None,
    states: Vectors | None,
    present: Vectors | None,
    action: Vector | None,
    resize: str | None,
    camera: Camera | None,
    with_obstacles: bool,
    search: Mapping[str, Any],
) -> Call[Plan]:
    image_format, images = encode_all(frames, spec.size)
    body = given(
        frames=images,
        format=image_format,
        goal=goal.body(spec.size, image_format),
        state=numbers(state),
        states=numbers(states),
        present=numbers(present),
        action=numbers(action),
        resize=resize,
        camera=camera and camera.body(),
        search=_search(search),
        with_frames=True,
        with_obstacles=with_obstacles,
    )
    return Call("POST", path("models", name, "plan"), partial(Plan.of, size=spec.size), body, is_binary=True)


def session_plan(
    session: str,
    token: str,
    spec: Spec,
    goal: Goal,
    *,
    state: Vector | None,
    present: Vectors | None,
    action: Vector | None,
    with_obstacles: bool,
    search: Mapping[str, Any],
) -> Call[Plan]:
    body = {
        **session_plan_body(spec, goal, with_obstacles, search),
        **given(state=numbers(state), present=numbers(present), action=numbers(action)),
    }
    read, headers = partial(Plan.of, size=spec.size), {"x-session-token": token}
    return Call("POST", path("sessions", session, "plan"), read, body, headers=headers, is_binary=True)


def session_plan_body(spec: Spec, goal: Goal, with_obstacles: bool, search: Mapping[str, Any]) -> dict[str, Any]:
    """What the plans of a session are asked for with."""
    return given(
        format="raw",
        goal=goal.body(spec.size, "raw"),
        search=_search(search),
        with_frames=True,
        with_obstacles=with_obstacles,
    )


def _search(search: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The settings of a search that are given, those of the solver in an object of their own."""
    solver = {name: search[name] for name in _SOLVER if search.get(name) is not None}
    if search.get("solver") is not None:
        solver["kind"] = search["solver"]
    others = {name: value for name, value in search.items() if name not in (*_SOLVER, "solver") and value is not None}
    return given(**others, solver=solver or None) or None


_SOLVER = ("samples", "iterations", "seed", "noise_color", "temperature")


def create_session(model_name: str, resize: str | None, camera: Camera | None) -> Call[Mapping[str, Any]]:
    body = given(model=model_name, format="raw", resize=resize, camera=camera and camera.body())
    return Call("POST", path("sessions"), dict, body)


def delete_session(session: str, token: str) -> Call[None]:
    return Call("DELETE", path("sessions", session), _nothing, headers={"x-session-token": token})


def datasets(after: str | None) -> Call[tuple[list[Dataset], str | None]]:
    return Call("GET", path("datasets"), _page("datasets", Dataset.of), params=given(after=after))


def dataset(name: str) -> Call[Dataset]:
    return Call("GET", path("datasets", name), Dataset.of)


def delete_dataset(name: str) -> Call[None]:
    return Call("DELETE", path("datasets", name), _nothing)


def jobs(kind: str | None, state: str | None, part_of: str | None, limit: int | None) -> Call[list[Job]]:
    read = _page("jobs", Job.of)
    params = given(kind=kind, state=state, part_of=part_of, limit=limit)
    return Call("GET", path("jobs"), lambda body: read(body)[0], params=params)


def job(job_id: str) -> Call[Job]:
    return Call("GET", path("jobs", job_id), Job.of)


def submit(spec: Mapping[str, Any], idempotency_key: str | None) -> Call[Job]:
    headers = {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}
    return Call("POST", path("jobs"), Job.of, given(**plain(spec)), headers=headers)


def change_job(job_id: str, change: str) -> Call[Job]:
    return Call("POST", path("jobs", job_id, change), Job.of)


def logs(job_id: str, after: int) -> Call[list[LogLine]]:
    def read(body: Mapping[str, Any]) -> list[LogLine]:
        return [LogLine.of(line) for line in body["lines"]]

    return Call("GET", path("jobs", job_id, "logs"), read, params={"after": after})


def create_environment(scenario: str, seed: int, world: Mapping[str, Any] | None) -> Call[Mapping[str, Any]]:
    return Call("POST", path("environments"), dict, given(scenario=scenario, seed=seed, world=world))


def reset_environment(environment: str, seed: int | None) -> Call[Mapping[str, Any]]:
    return Call("POST", path("environments", environment, "reset"), dict, given(seed=seed))


def step_environment(environment: str, action: Vector) -> Call[Mapping[str, Any]]:
    return Call("POST", path("environments", environment, "step"), dict, {"action": numbers(action)})


def delete_environment(environment: str) -> Call[None]:
    return Call("DELETE", path("environments", environment), _nothing)


def _page(name: str, of: Callable[[Mapping[str, Any]], T]) -> Callable[[Any], tuple[list[T], str | None]]:
    def read(body: Mapping[str, Any]) -> tuple[list[T], str | None]:
        return [of(entry) for entry in body[name]], body.get("next")

    return read


def _nothing(_: Any) -> None:
    return None

"""What the server answers, as typed records."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .images import FrameLike, Gray, decode_all, encode

P = TypeVar("P", bound="Predicted")

Floats = NDArray[np.float32]
#: Standard deviations from the mean that bound a channel whose range the server does not tell.
ASSUMED_DEVIATIONS = 3.0


@dataclass(frozen=True)
class Channel:
    """A component of an action or a state."""

    name: str
    unit: str
    #: Lowest and highest value in training; mean ± 3 standard deviations if the model is not calibrated.
    low: float
    high: float
    mean: float = 0.0
    std: float = 1.0


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with square pixels that looks ahead of the robot, tilted down."""

    #: Angle between the left and the right edge of the image, in radians.
    horizontal_fov_rad: float
    tilt_down_rad: float
    #: Height above the floor, in metres, if it is known.
    height_m: float | None = None

    def body(self) -> dict[str, float]:
        """As the server reads it."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True)
class Spec:
    """What a model takes and gives."""

    width: int
    height: int
    #: Seconds between two frames.
    period_s: float
    #: Frames that a prediction needs.
    context: int
    #: Frames that it was trained to predict.
    horizon: int
    #: ``none``, ``action``, ``state`` or ``state-action``.
    conditioning: str
    actions: tuple[Channel, ...]
    states: tuple[Channel, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of a frame."""
        return self.height, self.width

    @property
    def takes_actions(self) -> bool:
        return "action" in self.conditioning

    @property
    def takes_state(self) -> bool:
        return "state" in self.conditioning

    @classmethod
    def of(cls, spec: Mapping[str, Any], bounds: Mapping[str, Any] | None = None) -> Spec:
        bounds = bounds or {}
        return cls(
            width=spec["frame_width_px"],
            height=spec["frame_height_px"],
            period_s=spec["frame_period_s"],
            context=spec["context"],
            horizon=spec["horizon"],
            conditioning=spec["conditioning"],
            actions=channels(spec["actions"], bounds.get("action_bounds")),
            states=channels(spec["states"], bounds.get("state_bounds")),
        )


def channels(described: Sequence[Mapping[str, Any]], bounds: Sequence[Mapping[str, float]] | None) -> tuple[Channel, ...]:
    def channel(index: int, known: Mapping[str, Any]) -> Channel:
        mean, std = known.get("mean", 0.0), known.get("std", 1.0)
        assumed = {"low": mean - ASSUMED_DEVIATIONS * std, "high": mean + ASSUMED_DEVIATIONS * std}
        range_ = bounds[index] if bounds else assumed
        return Channel(known["name"], known["unit"], range_["low"], range_["high"], mean, std)

    return tuple(channel(index, known) for index, known in enumerate(described))


@dataclass(frozen=True)
class Model:
    """A model of the server."""

    name: str
    versions: tuple[int, ...]
    active_version: int
    spec: Spec
    metrics: Mapping[str, Any]
    lineage: Mapping[str, Any]

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> Model:
        return cls(
            name=body["name"],
            versions=tuple(body["versions"]),
            active_version=body["active_version"],
            spec=Spec.of(body["spec"], body),
            metrics=body["metrics"],
            lineage=body["lineage"],
        )


@dataclass(frozen=True)
class Predicted:
    """Predicted frames, and how far they can be trusted."""

    model: str
    version: int
    #: ``[…, steps, height, width]``: t+1, t+2, ….
    frames: Gray
    #: ``[…, steps]``: mean squared error to expect of each frame, intensities 0 to 1; empty if the model is not calibrated.
    expected_mse: Floats
    #: ``[…, steps, 2]``: the 90 % band of these errors.
    mse_band_90: Floats
    #: How unlike the training data the context is, 0 to 1; None if the model is not calibrated.
    novelty: float | None
    #: ``[steps]``: whether a frame is beyond what the model was trained for.
    beyond_training: NDArray[np.bool_]
    #: Actions and states out of the range of the training.
    warnings: tuple[str, ...]
    #: Milliseconds in the server's queue and in the model.
    queue_ms: float
    compute_ms: float

    @classmethod
    def _with(cls: type[P], frames: Gray, body: Mapping[str, Any]) -> P:
        steps, timing = frames.shape[-3], body["timing"]
        return cls(
            model=body["model"],
            version=body["version"],
            frames=frames,
            expected_mse=np.asarray(body.get("expected_mse", []), np.float32),
            mse_band_90=np.asarray(body.get("mse_band_90", []), np.float32),
            novelty=body.get("novelty"),
            beyond_training=np.asarray(body.get("beyond_training") or [False] * steps, bool),
            warnings=tuple(body.get("warnings", ())),
            queue_ms=timing["queue_us"] / 1000,
            compute_ms=timing["compute_us"] / 1000,
        )


class Prediction(Predicted):
    """The predicted frames ``[steps, height, width]`` after a context."""

    @classmethod
    def of(cls, body: Mapping[str, Any], size: tuple[int, int]) -> Prediction:
        return cls._with(decode_all(body["frames"], body["format"], size), body)


class Rollouts(Predicted):
    """The predicted frames ``[plans, steps, height, width]`` of each plan."""

    @classmethod
    def of(cls, body: Mapping[str, Any], size: tuple[int, int]) -> Rollouts:
        images = [image for rollout in body["rollouts"] for image in rollout]
        steps = len(body["rollouts"][0]) if body["rollouts"] else 0
        return cls._with(decode_all(images, body["format"], size).reshape(-1, steps, *size), body)

    def best(self, cost: Callable[[Gray], float]) -> int:
        """The number of the plan with the least cost; ``cost`` takes the frames ``[steps, height, width]`` of a plan."""
        return int(np.argmin([cost(frames) for frames in self.frames]))


@dataclass(frozen=True)
class Goal:
    """What a plan is to reach, as seen from the robot at the last frame. At least one part is given."""

    #: Where the robot should get: metres ahead and to the left.
    position_m: tuple[float, float] | None = None
    #: Where it should look in the end: radians, counter-clockwise from where it looks now.
    heading_rad: float | None = None
    #: What its camera should show in the end: ``[height, width]`` of the model's size, or an image file if the frames are files.
    image: FrameLike | None = None

    def body(self, size: tuple[int, int], image_format: str) -> dict[str, Any]:
        parts: dict[str, Any] = {"position_m": self.position_m, "heading_rad": self.heading_rad}
        if self.image is not None:
            found, parts["image"] = encode(self.image, size)
            if found != image_format:
                raise TypeError(f"goal.image is {found}, and the frames are {image_format}: give both as arrays, or both as files")
        return {name: value for name, value in parts.items() if value is not None}


@dataclass(frozen=True)
class Obstacles:
    """What the robot would touch: places in metres ahead and to the left of it now, in cells of 5 cm."""

    #: ``[cells, 2]``: what stands.
    fixed_m: Floats
    #: Each ``[cells, 2]``: movers now, then after each predicted step; empty if the model does not find movers.
    movers_m: tuple[Floats, ...]

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> Obstacles:
        def cells(places: Sequence[Sequence[float]]) -> Floats:
            return np.asarray(places, np.float32).reshape(-1, 2)

        return cls(fixed_m=cells(body["fixed_m"]), movers_m=tuple(cells(places) for places in body["movers_m"]))


@dataclass(frozen=True)
class PlannedActions:
    """A plan with what is expected under it."""

    #: ``stop``, ``present`` or ``drawn``.
    kind: str
    #: ``[steps, actions]``: the first acts from the last frame on.
    actions: Floats
    #: The weighted sum of ``costs``, which holds their values by name, not weighted.
    cost: float
    costs: Mapping[str, float]
    #: ``[steps, 3]``: metres ahead and to the left of where the robot is, and radians; empty if the actions are no speeds.
    way: Floats
    #: The least distance to what the last frame shows, in metres; None if that is not known, or nothing is seen.
    clearance_m: float | None
    #: ``[steps, height, width]``: the predicted frames; None if there was no time to predict them.
    frames: Gray | None = field(repr=False)
    #: ``[steps]``: mean squared error to expect of each frame; empty if it is not known.
    expected_mse: Floats

    @classmethod
    def read(cls, body: Mapping[str, Any], image_format: str, size: tuple[int, int]) -> PlannedActions:
        images = body.get("frames")
        return cls(
            kind=body["kind"],
            actions=np.asarray(body["actions"], np.float32),
            cost=body["cost"],
            costs=body["costs"],
            way=np.asarray(body.get("way", []), np.float32),
            clearance_m=body.get("clearance_m"),
            frames=decode_all(images, image_format, size) if images else None,
            expected_mse=np.asarray(body.get("expected_mse", []), np.float32),
        )


@dataclass(frozen=True)
class Plan(PlannedActions):
    """The best plan, or stopping if no plan is safe."""

    model: str
    version: int
    #: The next best plans, which differ, best first.
    runners_up: tuple[PlannedActions, ...] = field(repr=False)
    #: Whether the plan is safe, as far as it was checked; otherwise ``reason`` says why not, and ``detail`` says it in words.
    safe: bool
    reason: str | None
    detail: str | None
    #: Whether the way was checked against what the model's depth network sees in the last frame, and against where movers will
    #: be, if it finds them.
    clearance_checked: bool
    #: What stands in the way; None unless it was asked for (``with_obstacles``) and checked.
    obstacles: Obstacles | None = field(repr=False)
    novelty: float | None
    #: Plans that were judged, and those whose frames were predicted.
    samples: int
    predicted: int
    #: How long the search took.
    time_ms: float

    @classmethod
    def of(cls, body: Mapping[str, Any], size: tuple[int, int]) -> Plan:
        image_format = body["format"]
        best = PlannedActions.read(body["plan"], image_format, size)
        return cls(
            **vars(best),
            model=body["model"],
            version=body["version"],
            runners_up=tuple(PlannedActions.read(other, image_format, size) for other in body["runners_up"]),
            safe=body["safe"],
            reason=body.get("reason"),
            detail=body.get("detail"),
            clearance_checked=body["clearance_checked"],
            obstacles=Obstacles.of(body["obstacles"]) if "obstacles" in body else None,
            novelty=body.get("novelty"),
            samples=body["samples"],
            predicted=body["predicted"],
            time_ms=body["time_ms"],
        )


@dataclass(frozen=True)
class FramePlan:
    """A plan that the server searched for beside the predictions of a session (``Session.plan_every``)."""

    #: The number of the frame from which it was searched for.
    seq: int
    plan: Plan
    #: Plans that were due since the last one, but skipped, because the search before had not ended or the server was busy.
    skipped: int


@dataclass(frozen=True)
class Answer:
    """The answer to a frame of a session."""

    #: The number of the frame, from 0. It counts on when the connection breaks.
    seq: int
    #: The frame's time, echoed.
    timestamp_us: int
    #: None while the context is not full.
    prediction: Prediction | None
    #: Frames in the context, and frames that it takes.
    have: int
    need: int
    #: Whether the server had lost the session, so that the last frames were sent again before this one.
    replayed: bool = False
    #: The newest plan that came since the answer before; None if none came, or ``plan_every`` was not called.
    plan: FramePlan | None = None


@dataclass(frozen=True)
class Dataset:
    """A data set of the server."""

    name: str
    title: str
    episodes: int
    frames: int
    width: int
    height: int
    period_s: float
    action_names: tuple[str, ...]
    state_names: tuple[str, ...]
    content_hash: str
    scenario: str | None
    has_masks: bool

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> Dataset:
        return cls(
            name=body["name"],
            title=body["title"],
            episodes=body["episodes"],
            frames=body["frames"],
            width=body["frame_width_px"],
            height=body["frame_height_px"],
            period_s=body["frame_period_s"],
            action_names=tuple(channel["name"] for channel in body["actions"]),
            state_names=tuple(channel["name"] for channel in body["states"]),
            content_hash=body["content_hash"],
            scenario=body.get("scenario"),
            has_masks=body["has_masks"],
        )


@dataclass(frozen=True)
class Job:
    """A job: a collection, an import, a training, an adaptation or an evaluation."""

    id: str
    #: ``collect``, ``import``, ``train``, ``adapt`` or ``evaluate``.
    kind: str
    #: ``queued``, ``running``, ``succeeded``, ``failed`` or ``cancelled``.
    state: str
    done: int
    total: int
    message: str
    #: Seconds until it ends, if known.
    remaining_s: float | None
    train_loss: float | None
    validation_loss: float | None
    error: str | None
    result: Mapping[str, Any] = field(default_factory=dict)
    spec: Mapping[str, Any] = field(default_factory=dict)
    #: Of a job in parts, how many there are: ``total``, ``done``, ``running`` and ``failed``.
    parts: Mapping[str, int] = field(default_factory=dict)
    #: The job of which this one is a part.
    part_of: str | None = None

    @property
    def is_over(self) -> bool:
        return self.state in ("succeeded", "failed", "cancelled")

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> Job:
        progress, losses = body["progress"], body["losses"]
        return cls(
            id=body["id"],
            kind=body["spec"]["kind"],
            state=body["state"],
            done=progress["done"],
            total=progress["total"],
            message=progress["message"],
            remaining_s=progress.get("remaining_s"),
            train_loss=losses.get("train"),
            validation_loss=losses.get("validation"),
            error=body.get("error"),
            result=body.get("result") or {},
            spec=body["spec"],
            parts=body.get("parts") or {},
            part_of=body.get("part_of"),
        )


@dataclass(frozen=True)
class LogLine:
    """A line of a job's log."""

    seq: int
    unix_s: float
    line: str

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> LogLine:
        return cls(body["seq"], body["unix_s"], body["line"])

"""Client of Foreframe, which predicts the next camera frames of a robot. Frames are NumPy arrays."""

from .client import AsyncClient, Client
from .environment import Environment, Observation, Step
from .errors import (
    ApiError,
    ConnectionFailed,
    ForeframeError,
    JobFailed,
    ServerNotStarted,
    StreamClosed,
    StreamError,
    Unavailable,
)
from .records import (
    Answer,
    Camera,
    Channel,
    Dataset,
    FramePlan,
    Goal,
    Job,
    LogLine,
    Model,
    Obstacles,
    Plan,
    PlannedActions,
    Prediction,
    Rollouts,
    Spec,
)
from .server import Server, serve
from .session import AsyncSession, Session

__all__ = [
    "Answer",
    "ApiError",
    "AsyncClient",
    "AsyncSession",
    "Camera",
    "Channel",
    "Client",
    "ConnectionFailed",
    "Dataset",
    "Environment",
    "ForeframeError",
    "FramePlan",
    "Goal",
    "Job",
    "JobFailed",
    "LogLine",
    "Model",
    "Observation",
    "Obstacles",
    "Plan",
    "PlannedActions",
    "Prediction",
    "Rollouts",
    "Server",
    "ServerNotStarted",
    "Session",
    "Spec",
    "Step",
    "StreamClosed",
    "StreamError",
    "Unavailable",
    "serve",
]

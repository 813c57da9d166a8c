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
from .records import Answer, Camera, Channel, Dataset, Job, LogLine, Model, Prediction, Rollouts, Spec
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
    "Job",
    "JobFailed",
    "LogLine",
    "Model",
    "Observation",
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

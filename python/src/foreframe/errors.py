"""Errors. Those of the server carry the server's words."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .records import Job


class ForeframeError(Exception):
    """Any error of this package."""


class ConnectionFailed(ForeframeError):
    """No server answers, or the connection broke and could not be opened again."""


class ServerNotStarted(ForeframeError):
    """The program was not found, or ended before it was ready."""


class ApiError(ForeframeError):
    """The server refused a request. The text says what was wrong, and what would be right."""

    def __init__(self, status: int, detail: str, kind: str = "", request_id: str = "") -> None:
        super().__init__(detail)
        self.status = status
        self.detail = detail
        #: The kind of problem, for example ``urn:foreframe:problem:not-found``.
        self.kind = kind
        #: The request's id in the server's log.
        self.request_id = request_id


class Unavailable(ApiError):
    """The server is busy or stops (503), a limit of the API key is reached (429), or a load balancer lost its server (502, 504)."""

    #: When to try again, in seconds.
    retry_after_s: float = 1.0


class StreamError(ForeframeError):
    """The server refused a frame of a session, which keeps its state: another frame may follow."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        #: ``malformed``, ``invalid``, ``gap``, ``overloaded`` or ``internal``.
        self.code = code
        self.detail = detail


class StreamClosed(ForeframeError):
    """A session has ended for good."""

    def __init__(self, reason: str) -> None:
        super().__init__("the session is closed" if reason == "closed" else f"the server closed the session: {reason}")
        #: ``replaced``, ``deleted``, ``revoked`` or ``too_long``; ``closed``: by its own ``close``.
        self.reason = reason


class JobFailed(ForeframeError):
    """A job failed or was cancelled."""

    def __init__(self, job: Job) -> None:
        super().__init__(f"{job.id} {job.state}: {job.error}" if job.error else f"{job.id} {job.state}")
        self.job = job


def api_error(status: int, headers: Mapping[str, str], body: bytes) -> ApiError:
    """The error of a response; its body is problem details (RFC 9457), unless something between us answered."""
    if status < 400:
        # For example the redirect or the login page of a proxy.
        location = headers.get("location")
        found = f"a redirect to {location}" if location else body.decode(errors="replace").strip()[:200] or "it is empty"
        return ApiError(status, f"not an answer of Foreframe: {found}")
    try:
        problem = json.loads(body)
        words = (str(problem["detail"]), str(problem["type"]), str(problem["instance"]))
    except (ValueError, KeyError, TypeError):
        words = (body.decode(errors="replace").strip()[:500] or f"HTTP status {status}", "", "")
    if status not in (429, 502, 503, 504):
        return ApiError(status, *words)
    error = Unavailable(status, *words)
    retry_after = headers.get("retry-after", "")
    # Another server answers the next request at once.
    otherwise = 0.0 if status in (502, 504) else 1.0
    error.retry_after_s = float(retry_after) if retry_after.isdigit() else otherwise
    return error

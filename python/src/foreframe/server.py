"""Starts the program `foreframe` as a server of this process."""

from __future__ import annotations

import atexit
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from os import PathLike, environ
from pathlib import Path
from types import TracebackType

import httpx

from .calls import uses_proxy
from .client import Client
from .errors import ServerNotStarted

#: What the program prints when it listens.
_LISTENS = re.compile(r"Foreframe listens on (http://\S+?)/? ")


class Server:
    """A server that this process started. It ends with ``close``, or with this process, whatever ends that."""

    def __init__(self, process: subprocess.Popen[bytes], directory: tempfile.TemporaryDirectory[str]) -> None:
        self._process = process
        self._directory = directory
        #: What it had printed when it was closed.
        self._last_log: str | None = None
        #: Where it listens.
        self.url = ""

    @property
    def log(self) -> str:
        """What it printed."""
        if self._last_log is not None:
            return self._last_log
        return (Path(self._directory.name) / "log").read_text(errors="replace")

    def client(self, *, key: str | None = None) -> Client:
        """A client of this server."""
        return Client(self.url, key=key)

    def close(self) -> None:
        """Stops the server, and deletes its data directory if it was a temporary one."""
        atexit.unregister(self.close)
        if self._process.stdin:
            self._process.stdin.close()
        # Children that this process forked, for example of gymnasium's AsyncVectorEnv, keep the pipe open.
        self._process.terminate()
        try:
            self._process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            # The guard has a process group of its own, with the server.
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._last_log = self.log
        self._directory.cleanup()

    def __enter__(self) -> Server:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def serve(
    *,
    program: str | PathLike[str] = "foreframe",
    data_dir: str | PathLike[str] | None = None,
    models_dir: str | PathLike[str] | None = None,
    settings: Mapping[str, object] | None = None,
    env: Mapping[str, str] | None = None,
    port: int = 0,
    timeout_s: float = 60.0,
) -> Server:
    """Starts a server on a free port of this machine, and waits until it is ready.

    ``program``: a name on PATH, or a path. ``data_dir``: without one, a temporary directory that is deleted at the end.
    ``models_dir``: without one, the model inside the program. ``settings``: any of ``foreframe config``. Raises
    ServerNotStarted with the last lines of the program.
    """
    found = shutil.which(program)
    if found is None:
        raise ServerNotStarted(f"the program {program} is not on PATH; install it with `cargo install --path .` in a clone of Foreframe")
    directory = tempfile.TemporaryDirectory(prefix="foreframe-")
    root = Path(directory.name)
    data = root / "data" if data_dir is None else Path(data_dir).absolute()
    command = [str(Path(found).absolute()), "serve", "--bind", f"127.0.0.1:{port}", "--data-dir", str(data)]
    # Without a directory of models, the program serves the model that it contains.
    command += [] if models_dir is None else ["--models-dir", str(Path(models_dir).absolute())]
    for name, value in {"admin_bind": "off", **(settings or {})}.items():
        command += ["--set", f"{name}={_toml(value)}"]
    server = Server(_start(command, root, env), directory)
    atexit.register(server.close)
    try:
        _wait_until_ready(server, time.monotonic() + timeout_s)
    except BaseException:
        server.close()
        raise
    return server


def _start(command: Sequence[str], directory: Path, env: Mapping[str, str] | None) -> subprocess.Popen[bytes]:
    # The guard holds a pipe to this process: if this process is killed, the pipe closes, and the guard ends the server.
    guard = [sys.executable, str(Path(__file__).with_name("_guard.py")), *command]
    with (directory / "log").open("wb") as output:
        return subprocess.Popen(
            guard,
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**environ, **(env or {})},
            # No settings file of the present directory changes it, and Ctrl-C reaches this process alone.
            cwd=directory,
            start_new_session=True,
        )


def _wait_until_ready(server: Server, deadline: float) -> None:
    while time.monotonic() < deadline:
        is_over = server._process.poll() is not None
        match = _LISTENS.search(server.log)
        if match and not server.url:
            server.url = match.group(1)
        if is_over:
            raise ServerNotStarted(f"the server ended at its start: {_last_lines(server.log)}")
        if server.url and _is_ready(server.url):
            return
        time.sleep(0.02)
    raise ServerNotStarted(f"the server was not ready in time: {_last_lines(server.log)}")


def _is_ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz", timeout=5, trust_env=uses_proxy(url)).status_code == 200
    except httpx.TransportError:
        return False


def _last_lines(log: str) -> str:
    return "\n".join(log.strip().splitlines()[-5:]) or "it printed nothing"


def _toml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)

"""`foreframe.serve` starts a server and ends it."""

import os
import signal
import subprocess
import sys
import time

import httpx
import pytest

import foreframe
from conftest import PROGRAM


def test_a_server_without_models_directory_has_the_model_of_the_program() -> None:
    with foreframe.serve(program=PROGRAM) as server, server.client() as client:
        assert [model.name for model in client.models()] == ["moving-flow"]
        url = server.url
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"{url}/livez")


def test_a_server_ends_with_the_process_that_started_it() -> None:
    code = f"import foreframe, time; print(foreframe.serve(program={PROGRAM!r}).url, flush=True); time.sleep(60)"
    started = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert started.stdout is not None
    url = started.stdout.readline().strip()
    assert httpx.get(f"{url}/livez").status_code == 200
    os.kill(started.pid, signal.SIGKILL)
    started.wait()
    started.stdout.close()
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        try:
            httpx.get(f"{url}/livez", timeout=1)
        except httpx.TransportError:
            return
        time.sleep(0.05)
    pytest.fail("the server outlived its process")


def test_a_server_that_cannot_start_says_why() -> None:
    with pytest.raises(foreframe.ServerNotStarted, match="not on PATH"):
        foreframe.serve(program="no-such-program")
    with pytest.raises(foreframe.ServerNotStarted, match="max_streams"):
        foreframe.serve(program=PROGRAM, settings={"max_streams": "many"})

"""`foreframe.serve` starts a server and ends it."""

import multiprocessing
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
    started, url, _ = start_elsewhere("0")
    assert_ends_with(started, url)


def test_a_server_ends_with_its_process_also_if_a_forked_child_lives() -> None:
    started, url, child = start_elsewhere("os.fork() or time.sleep(60)")
    assert_ends_with(started, url)
    os.kill(child, signal.SIGKILL)


def start_elsewhere(child: str) -> tuple["subprocess.Popen[str]", str, int]:
    """Starts a server in another process; gives its address, and what the expression ``child`` gave there."""
    code = f"import foreframe, os, time; server = foreframe.serve(program={PROGRAM!r}); child = {child}"
    code += "; print(server.url, child, flush=True); time.sleep(60)"
    started = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert started.stdout is not None
    url, number = started.stdout.readline().split()
    return started, url, int(number)


def assert_ends_with(started: "subprocess.Popen[str]", url: str) -> None:
    assert started.stdout is not None
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


def test_a_server_is_closed_at_once_while_a_forked_child_lives() -> None:
    child = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
    with foreframe.serve(program=PROGRAM) as server:
        child.start()
        began = time.monotonic()
    assert time.monotonic() - began < 15
    child.kill()
    child.join()
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"{server.url}/livez")
    assert "Foreframe listens" in server.log, "also after the end"


def test_a_server_on_this_machine_is_not_behind_the_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.delenv("no_proxy", raising=False)
    for name in ("HTTP_PROXY", "http_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:1")
    with foreframe.serve(program=PROGRAM) as server, server.client() as client:
        assert len(client.models()) == 1
        with client.session("moving-flow", reconnect_s=0) as session:
            assert session.spec.context == 5

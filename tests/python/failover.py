"""Streams that survive their servers: many streams behind a load balancer, while one of two servers is killed again and again.

    failover.py PROGRAM DIR [--streams 100] [--kills 20] [--rolls 2] [--hz 5] [--model moving]

Starts deploy/local/run, drives the streams with the Python package, kills servers (`kill -9`) and restarts them gently (SIGTERM).
Each prediction must be that of one unbroken stream (within one gray level), and no frame may be lost. Prints how long frames took.
Before that, all requests to a session or an environment must reach the server that has it.
"""

import argparse
import asyncio
import json
import os
import signal
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np
from PIL import Image

import foreframe

ROOT = Path(__file__).parents[2]
PORT = 18700


@dataclass
class Drive:
    """What all robots send."""

    frames: np.ndarray
    actions: np.ndarray
    states: np.ndarray

    @classmethod
    def example(cls) -> "Drive":
        folder = ROOT / "examples" / "frames"
        recorded = json.loads((folder / "actions.json").read_text())
        images = [np.asarray(Image.open(path).convert("L")) for path in sorted(folder.glob("frame-*.png"))]
        count = min(len(images), len(recorded["actions"]), len(recorded["states"]))
        return cls(np.stack(images[:count]), np.array(recorded["actions"][:count]), np.array(recorded["states"][:count]))

    def at(self, seq: int) -> dict:
        place = seq % len(self.frames)
        return {"frame": self.frames[place], "action": self.actions[place], "state": self.states[place]}


@dataclass
class Outcome:
    """What a stream met."""

    answered: int = 0
    replays: int = 0
    seconds: list = field(default_factory=list)


async def unbroken(client: foreframe.AsyncClient, model: str, drive: Drive, count: int) -> list:
    async with client.session(model) as session:
        return [await session.step(**drive.at(seq)) for seq in range(count)]


async def follow(client, model: str, drive: Drive, expected: list, period_s: float, offset_s: float, is_over: asyncio.Event) -> Outcome:
    """Sends frames at a steady rate until it is over, and compares each answer."""
    outcome = Outcome()
    cycle = len(drive.frames)
    async with client.session(model, reconnect_s=60.0) as session:
        await asyncio.sleep(offset_s)
        due, seq = time.monotonic(), 0
        while not is_over.is_set():
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            started = time.monotonic()
            answer = await session.step(**drive.at(seq))
            outcome.seconds.append(time.monotonic() - started)
            assert answer.seq == seq, f"frame {seq} was answered as {answer.seq}"
            # After the first cycle, the frames repeat.
            like = expected[seq if seq < 2 * cycle else cycle + seq % cycle]
            assert (answer.prediction is None) == (like.prediction is None), f"frame {seq}: a prediction is missing"
            if answer.prediction is not None:
                apart = np.abs(answer.prediction.frames.astype(int) - like.prediction.frames).max()
                # Windows that are computed together round differently.
                assert apart <= 1, f"frame {seq}: {apart} gray levels from the prediction of an unbroken stream (replayed: {answer.replayed})"
            outcome.answered += 1
            outcome.replays += answer.replayed
            due, seq = max(due + period_s, time.monotonic() - period_s), seq + 1
    return outcome


async def until_ready(port: int) -> None:
    for _ in range(600):
        try:
            async with foreframe.AsyncClient(f"http://127.0.0.1:{port}") as client:
                await client.models()
                return
        except foreframe.ForeframeError:
            await asyncio.sleep(0.1)
    raise SystemExit(f"nothing answers at port {port}")


async def fail(directory: Path, kills: int, rolls: int, seconds: float) -> None:
    """Ends servers in turn: kills, then gentle restarts. Each is back before the other one goes."""
    for number in range(kills + rolls):
        name, admin = ("a", PORT + 1) if number % 2 == 0 else ("b", PORT + 3)
        await until_ready(admin)
        # The load balancer has seen it, too.
        await asyncio.sleep(seconds)
        pid = int((directory / f"{name}.pid").read_text())
        os.kill(pid, signal.SIGKILL if number < kills else signal.SIGTERM)
        while (directory / f"{name}.pid").read_text().strip() == str(pid):
            await asyncio.sleep(0.05)
    await until_ready(PORT + 1)
    await until_ready(PORT + 3)
    await asyncio.sleep(seconds)


async def check_affinity(model: str, drive: Drive, count: int = 8) -> None:
    """Opens what lives on one server, and asks for each of them. Half of them would be missed by chance."""
    observation = {"images": {"front": drive.frames[0].tolist()}, "state": drive.states[0].tolist()}
    step = {"step_id": 0, "observation": observation, "action": {"joint_positions": drive.actions[0].tolist()}}
    async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{PORT}") as client:
        for opened, with_model, verb, path, body in [
            ("/v1/sessions", {"model": model}, "GET", "", None),
            ("/v1/environments", {"scenario": "static-observer"}, "POST", "/reset", {}),
            ("/v1/realtime/sessions", {"model": model}, "POST", "/step", step),
        ]:
            places = [(await client.post(opened, json=with_model)).headers["location"] for _ in range(count)]
            for place in places:
                answer = await client.request(verb, place + path, json=body)
                assert answer.status_code == 200, f"{place + path}: {answer.text}"


async def drive_all(arguments: argparse.Namespace) -> None:
    drive, directory = Drive.example(), Path(arguments.dir)
    await until_ready(PORT + 1)
    await until_ready(PORT + 3)
    await until_ready(PORT)
    await check_affinity(arguments.model, drive)
    async with foreframe.AsyncClient(f"http://127.0.0.1:{PORT}") as client:
        expected = await unbroken(client, arguments.model, drive, 2 * len(drive.frames))
        is_over, period_s = asyncio.Event(), 1.0 / arguments.hz
        streams = [
            asyncio.create_task(follow(client, arguments.model, drive, expected, period_s, period_s * n / arguments.streams, is_over))
            for n in range(arguments.streams)
        ]
        failing = asyncio.create_task(fail(directory, arguments.kills, arguments.rolls, arguments.pause))
        await asyncio.wait([failing, *streams], return_when=asyncio.FIRST_COMPLETED)
        is_over.set()
        await failing
        outcomes = await asyncio.gather(*streams)
    answered, replays = sum(o.answered for o in outcomes), sum(o.replays for o in outcomes)
    assert replays > 0, "no stream met a dead server: the test tests nothing"
    seconds = np.sort(np.concatenate([o.seconds for o in outcomes]))
    at = lambda share: 1000 * seconds[min(len(seconds) - 1, int(share * len(seconds)))]
    print(
        f"{arguments.streams} streams at {arguments.hz:g} Hz, {arguments.kills} kills, {arguments.rolls} gentle restarts: {answered} frames "
        f"answered, 0 lost, all as in an unbroken stream; {replays} times a stream went on elsewhere"
    )
    slow = seconds[-replays:]
    print(
        f"time of a frame: median {at(0.5):.0f} ms, 99 % {at(0.99):.0f} ms; of the {len(slow)} slowest, those that changed "
        f"servers: median {1000 * np.median(slow):.0f} ms, longest {1000 * slow[-1]:.0f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("dir")
    parser.add_argument("--streams", type=int, default=100)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--rolls", type=int, default=2)
    parser.add_argument("--hz", type=float, default=5.0)
    parser.add_argument("--pause", type=float, default=1.0, help="seconds between a server's return and the next failure")
    parser.add_argument("--model", default="moving")
    arguments = parser.parse_args()
    Path(arguments.dir).mkdir(parents=True, exist_ok=True)
    topology = subprocess.Popen([ROOT / "deploy" / "local" / "run", arguments.program, arguments.dir])
    try:
        asyncio.run(drive_all(arguments))
    finally:
        topology.terminate()
        topology.wait()


if __name__ == "__main__":
    main()

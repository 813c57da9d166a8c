"""The server of the tests: the program FOREFRAME names, or the one on PATH."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import foreframe

ROOT = Path(__file__).parents[2]
PROGRAM = os.environ.get("FOREFRAME", "foreframe")
MODELS = ROOT / "models"


@pytest.fixture(scope="session")
def server() -> Iterator[foreframe.Server]:
    with foreframe.serve(program=PROGRAM, models_dir=MODELS) as server:
        yield server


@pytest.fixture(scope="session")
def client(server: foreframe.Server) -> Iterator[foreframe.Client]:
    with server.client() as client:
        yield client


class Drive:
    """Frames, actions and states of a driven simulated robot."""

    def __init__(self, client: foreframe.Client, length: int, seed: int = 3) -> None:
        with client.environment("moving-observer", seed=seed) as environment:
            seen, actions = [environment.observation], []
            for _ in range(length - 1):
                actions.append(seen[-1].policy_action)
                seen.append(environment.step(actions[-1]).observation)
        actions.append(seen[-1].policy_action)
        self.frames = np.stack([observation.frame for observation in seen])
        self.states = np.stack([observation.state for observation in seen])
        self.actions = np.stack(actions)


@pytest.fixture(scope="session")
def drive(client: foreframe.Client) -> Drive:
    return Drive(client, 12)

"""Trains a small agent in the dream of a model, then lets it drive the simulator.

    pip install './python[gym]'
    python python/examples/train_in_dream.py

The task: keep the other robot in the middle of the view. The agent sees the picture only: how much of the other robot is in each of
four columns left of the middle, less the same column right of it, and its own last turn. It has 5 weights, which the cross-entropy
method fits. In the dream no simulator runs and no true reward exists: the reward is read from the predicted pictures. Takes about a
minute on one core.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

import foreframe
from foreframe.gym import DreamEnv, SimulatorEnv, SimulatorStarts, Start

MODEL = "moving-flow"
#: Columns on each side of the middle.
COLUMNS = 4
WEIGHTS = COLUMNS + 1
SPEED_M_S = 0.1
#: Of each generation, the best go on.
POPULATION, ELITE = 12, 4
EPISODES_OF_A_CANDIDATE = 3
DREAM_STEPS = 15
#: Short recordings of the simulator, from which the dreams begin.
START_COUNT = 24


def robot_by_column(frame: np.ndarray) -> np.ndarray:
    """How much of each column is the other robot: its base is darker, and its top brighter, than anything else."""
    pixels = frame.reshape(frame.shape[:2])[16:]
    return ((pixels < 45) | (pixels > 215)).mean(axis=0)


def view_score(frame: np.ndarray) -> float:
    """1 if the other robot is in the middle of the picture, 0 if it is out of view: as the simulator's reward, but seen."""
    share = robot_by_column(frame)
    if share.sum() * len(share) < 0.2:
        return 0.0
    middle = (len(share) - 1) / 2
    at = (share * np.arange(len(share))).sum() / share.sum()
    return float(1 - abs(at - middle) / middle)


class Agent:
    """Turns by a weighted sum of what it sees."""

    def __init__(self, weights: np.ndarray, most: float) -> None:
        self.weights = weights
        self.most = most
        self.turn = 0.0

    def act(self, frame: np.ndarray) -> np.ndarray:
        columns = robot_by_column(frame).reshape(2 * COLUMNS, -1).mean(axis=1)
        seen = np.concatenate([10 * (columns - columns[::-1])[:COLUMNS], [self.turn]])
        self.turn = float(np.tanh(self.weights @ seen))
        return np.array([SPEED_M_S, self.most * self.turn], np.float32)


def dream_reward(frame: np.ndarray, state: np.ndarray | None, action: np.ndarray) -> float:
    return view_score(frame)


def score(env: DreamEnv | SimulatorEnv, policy: Callable[[np.ndarray], np.ndarray], seed: int | None) -> float:
    """The mean reward of a step of an episode."""
    observation, _ = env.reset(seed=seed)
    rewards = []
    while True:
        observation, reward, terminated, truncated, _ = env.step(policy(observation["frame"]))
        rewards.append(reward)
        if terminated or truncated:
            return float(np.mean(rewards))


def recorded_starts(client: foreframe.Client, context: int, random: np.random.Generator) -> list[Start]:
    """All that the training knows of the simulator: a few short recordings."""
    simulator = SimulatorStarts(client, context)
    starts = [simulator(random) for _ in range(START_COUNT)]
    simulator.close()
    return starts


def train(env: DreamEnv, most: float, generations: int, random: np.random.Generator) -> np.ndarray:
    mean, deviation = np.zeros(WEIGHTS), np.ones(WEIGHTS)
    begun = time.monotonic()
    for generation in range(1, generations + 1):
        candidates = random.normal(mean, deviation, (POPULATION, WEIGHTS))
        # All candidates of a generation dream from the same starts.
        seeds = random.integers(1 << 30, size=EPISODES_OF_A_CANDIDATE).tolist()
        scores = [np.mean([score(env, Agent(weights, most).act, seed) for seed in seeds]) for weights in candidates]
        best = candidates[np.argsort(scores)[-ELITE:]]
        mean, deviation = best.mean(axis=0), best.std(axis=0) + 0.1
        steps = generation * POPULATION * EPISODES_OF_A_CANDIDATE * DREAM_STEPS
        print(f"{steps:5} dreamed steps, {time.monotonic() - begun:3.0f} s: reward {np.mean(scores):.3f}, best {np.max(scores):.3f}")
    return mean


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", help="where Foreframe listens (default: starts one)")
    parser.add_argument("--generations", type=int, default=10, help="how long to train (default: %(default)s)")
    parser.add_argument("--episodes", type=int, default=20, help="episodes of the test in the simulator (default: %(default)s)")
    args = parser.parse_args()
    server = None if args.server else foreframe.serve()
    with foreframe.Client(args.server or server.url) as client:
        spec = client.spec(MODEL)
        random = np.random.default_rng(1)
        starts = recorded_starts(client, spec.context, random)
        dream = DreamEnv(client, MODEL, lambda random: starts[random.integers(len(starts))], dream_reward, max_steps=DREAM_STEPS)
        most = spec.actions[1].high
        weights = train(dream, most, args.generations, random)
        dream.close()

        simulator = SimulatorEnv(client, actions=spec.actions)
        random = np.random.default_rng(2)
        still = np.array([SPEED_M_S, 0.0], np.float32)
        drivers = {
            "straight ahead": lambda frame: still,
            "random turns": lambda frame: np.array([SPEED_M_S, random.uniform(-most, most)], np.float32),
            "trained in the dream": Agent(weights, most).act,
        }
        print(f"In the simulator, {args.episodes} episodes that nobody trained on; reward of a step, 1 is the best:")
        for name, policy in drivers.items():
            found = [score(simulator, policy, 1_000_000 + episode) for episode in range(args.episodes)]
            error = np.std(found) / np.sqrt(len(found))
            print(f"  {name:21} {np.mean(found):.3f} ± {error:.3f}")
        simulator.close()
    if server is not None:
        server.close()


if __name__ == "__main__":
    main()

"""Shows how far from its goal a policy ends: ``python goal_distances.py RUN TASK [EPISODES]``.

It runs a run's latest policy without noise and prints a line of CSV.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

import dmprl
from dmprl.robotics_repair import repair

FIRST_SEED = 6000
THRESHOLD = 0.05
"""Distance [m] below which the goal of a task with one object is reached."""
HEADER = "task,env_steps,episodes,success_rate,median_distance_m"


def ends(run: dmprl.Run, task: str, episodes: int) -> Iterator[dict[str, NDArray[np.float64]]]:
    """Runs the episodes, and yields the last observation of each."""
    if task.startswith("gymnasium_robotics:"):
        repair()
    policy, env = run.policy("latest"), dmprl.make(task)
    for seed in range(FIRST_SEED, FIRST_SEED + episodes):
        observation, _ = env.reset(seed=seed)
        policy.reset()
        ended = False
        while not ended:
            row = np.concatenate([observation[key] for key in sorted(observation)])
            for action in policy.segment(row):
                observation, _, terminated, truncated, _ = env.step(action)
                ended = terminated or truncated
                if ended:
                    break
        yield observation


def distance(observation: dict[str, NDArray[np.float64]]) -> float:
    """Returns the distance of the achieved goal from the desired one."""
    return float(np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"]))


def measure(run: dmprl.Run, task: str, episodes: int) -> str:
    """Runs the episodes and returns the line."""
    distances = [distance(end) for end in ends(run, task, episodes)]
    numbers = f"{np.mean(np.array(distances) < THRESHOLD):.3f},{np.median(distances):.3f}"
    return f"{task},{run.policy('latest').file.env_steps},{episodes},{numbers}"


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    count = int(sys.argv[3]) if len(sys.argv) == 4 else 200
    print(HEADER)
    print(measure(dmprl.Run(sys.argv[1]), sys.argv[2], count))

"""Shows how far from its goal a policy ends: ``python goal_distances.py RUN TASK [EPISODES]``.

It runs a run's latest policy without noise and prints a line of CSV.
"""

from __future__ import annotations

import sys

import numpy as np

import dmprl
from dmprl.robotics_repair import repair

FIRST_SEED = 6000
HEADER = "task,env_steps,episodes,success_rate,median_distance_m"


def measure(run: dmprl.Run, task: str, episodes: int) -> str:
    """Runs the episodes and returns the line."""
    if task.startswith("gymnasium_robotics:"):
        repair()
    policy, env = run.policy("latest"), dmprl.make(task)
    distances, successes = [], []
    for seed in range(FIRST_SEED, FIRST_SEED + episodes):
        observation, _ = env.reset(seed=seed)
        policy.reset()
        ended = False
        while not ended:
            row = np.concatenate([observation[key] for key in sorted(observation)])
            for action in policy.segment(row):
                observation, _, terminated, truncated, info = env.step(action)
                ended = terminated or truncated
                if ended:
                    break
        missed = observation["achieved_goal"] - observation["desired_goal"]
        distances.append(np.linalg.norm(missed))
        successes.append(info["is_success"])
    numbers = f"{np.mean(successes):.3f},{np.median(distances):.3f}"
    return f"{task},{policy.file.env_steps},{episodes},{numbers}"


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    count = int(sys.argv[3]) if len(sys.argv) == 4 else 200
    print(HEADER)
    print(measure(dmprl.Run(sys.argv[1]), sys.argv[2], count))

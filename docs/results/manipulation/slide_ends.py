"""Where pucks are when an episode ends: ``python slide_ends.py RUN TASK [EPISODES]``.

It runs the newest evaluated policy without noise and prints a line of CSV: the share of the
episodes in which the goal is reached at the last step, and at some step; and the medians of the
distance at the end, the speed at the end, and the step at which the puck is struck.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import dmprl
from dmprl.robotics_repair import repair

FIRST_SEED = 7000
THRESHOLD = 0.05
STEP_S = 0.04
STRUCK = 0.004
"""Way in one step [m] from which on a puck is struck. In the first step it falls on the table."""


def episode(env, policy: dmprl.Policy, seed: int) -> tuple[float, float, float, int]:
    """Returns last and smallest distance of an episode, its last speed, and the stroke's step."""
    observation, _ = env.reset(seed=seed)
    policy.reset()
    places, ended = [observation["achieved_goal"].copy()], False
    while not ended:
        flat = np.concatenate([observation[key] for key in sorted(observation)])
        for action in np.array(policy.segment(flat)).reshape(policy.segment_steps, -1):
            observation, _, terminated, truncated, _ = env.step(action)
            places.append(observation["achieved_goal"].copy())
            ended = terminated or truncated
            if ended:
                break
    places = np.array(places)
    distances = np.linalg.norm(places - observation["desired_goal"], axis=1)
    ways = np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1)
    struck = np.flatnonzero(ways[1:] > STRUCK)
    stroke = int(struck[0]) + 2 if struck.size else len(ways)
    return distances[-1], distances[1:].min(), ways[-1] / STEP_S, stroke


def main() -> None:
    """Runs the episodes of the command line."""
    run, task = Path(sys.argv[1]), sys.argv[2]
    episodes = int(sys.argv[3]) if len(sys.argv) > 3 else 100
    repair()
    policy, env = dmprl.Run(run).policy("latest"), dmprl.make(task)
    rows = np.array([episode(env, policy, FIRST_SEED + index) for index in range(episodes)])
    last, smallest, speed, stroke = rows.T
    reached = [np.mean(distance <= THRESHOLD) for distance in (last, smallest)]
    medians = [np.median(values) for values in (last, speed, stroke)]
    print("success,passed,distance_m,speed_m_s,stroke_step")
    print(",".join(f"{value:.3g}" for value in (*reached, *medians)))


if __name__ == "__main__":
    main()

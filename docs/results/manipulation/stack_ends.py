"""Shows how episodes of ``panda-stack`` end: ``python stack_ends.py RUN [EPISODES]``.

It runs a run's latest policy without noise and prints a line of CSV. The task accepts cubes that
are beside each other, because its distance is that of both together. So the script also counts the
ends with the upper cube off the table, those with it above the other one, and those of them where
the fingers have released it.
"""

from __future__ import annotations

import sys

import numpy as np

import dmprl

FIRST_SEED = 6000
THRESHOLD = 0.1
"""Largest distance of both cubes together [m] at which the goal is reached."""
HALF_EDGE = 0.02
"""Half the length of a cube's edge [m]."""
RELEASED = 0.045
"""Width of the fingers [m] at which they hold no cube."""
HEADER = "env_steps,episodes,success_rate,share_raised,share_above,share_released"


def measure(run: dmprl.Run, episodes: int) -> str:
    """Runs the episodes and returns the line."""
    policy, env = run.policy("latest"), dmprl.make("panda-stack")
    ends = []
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
        lower, upper = observation["achieved_goal"].reshape(2, 3)
        missed = observation["achieved_goal"] - observation["desired_goal"]
        is_above = upper[2] > lower[2] + HALF_EDGE
        is_above &= np.abs(upper[:2] - lower[:2]).max() < 2 * HALF_EDGE
        width = observation["observation"][6]
        is_reached = np.linalg.norm(missed) < THRESHOLD
        is_raised = upper[2] > 2 * HALF_EDGE
        ends.append((is_reached, is_raised, is_above, is_above and width > RELEASED))
    shares = [f"{share:.3f}" for share in np.mean(ends, axis=0)]
    return ",".join([str(policy.file.env_steps), str(episodes), *shares])


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    count = int(sys.argv[2]) if len(sys.argv) == 3 else 200
    print(HEADER)
    print(measure(dmprl.Run(sys.argv[1]), count))

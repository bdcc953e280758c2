"""Shows how episodes of ``panda-stack`` end: ``python stack_ends.py RUN [EPISODES]``.

It runs a run's latest policy without noise and prints a line of CSV. The task accepts cubes that
are beside each other, because its distance is that of both together. So the script also counts the
ends with the upper cube off the table, those with it above the other one, and those of them where
the fingers have released it.
"""

from __future__ import annotations

import sys

import numpy as np
from goal_distances import distance, ends

import dmprl

THRESHOLD = 0.1
"""Largest distance of both cubes together [m] at which the goal is reached."""
HALF_EDGE = 0.02
"""Half the length of a cube's edge [m]."""
RELEASED = 0.045
"""Width of the fingers [m] at which they hold no cube."""
HEADER = "env_steps,episodes,success_rate,share_raised,share_above,share_released"


def measure(run: dmprl.Run, episodes: int) -> str:
    """Runs the episodes and returns the line."""
    counted = []
    for end in ends(run, "panda-stack", episodes):
        lower, upper = end["achieved_goal"].reshape(2, 3)
        is_above = upper[2] > lower[2] + HALF_EDGE
        is_above &= np.abs(upper[:2] - lower[:2]).max() < 2 * HALF_EDGE
        is_raised = upper[2] > 2 * HALF_EDGE
        is_released = is_above and end["observation"][6] > RELEASED
        counted.append((distance(end) < THRESHOLD, is_raised, is_above, is_released))
    shares = [f"{share:.3f}" for share in np.mean(counted, axis=0)]
    return ",".join([str(run.policy("latest").file.env_steps), str(episodes), *shares])


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    count = int(sys.argv[2]) if len(sys.argv) == 3 else 200
    print(HEADER)
    print(measure(dmprl.Run(sys.argv[1]), count))

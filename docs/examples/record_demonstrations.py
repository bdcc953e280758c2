"""Records demonstrations of a one-line controller that moves the Panda's gripper to its goal.

    .venv/bin/python docs/examples/record_demonstrations.py demos.npz
    cargo run --release -- train panda-reach --demos demos.npz

For another task change ``TASK`` and ``act``. A trained policy, a planner or a person can also act.
"""

import sys

import gymnasium
import numpy as np

import dmprl  # noqa: F401 - registers the task

TASK, EPISODES, SEED = "dmprl/PandaReach-v0", 20, 0


def act(observation):
    """Moves to the goal. Entries 14 to 16 are goal - gripper [m]; an action of 1 moves by 5 cm."""
    return np.clip(observation[14:17] / 0.05, -1.0, 1.0)


def record(env, act, episodes, seed):
    """Returns one row per step, episode after episode."""
    keys = "observations", "actions", "rewards", "next_observations", "terminated", "truncated"
    rows = {key: [] for key in keys}
    for episode in range(episodes):
        observation, _ = env.reset(seed=seed + episode)
        ended = False
        while not ended:
            action = act(observation)
            after, reward, terminated, truncated, _ = env.step(action.astype(np.float32))
            step = observation, action, reward, after, terminated, truncated
            for key, value in zip(keys, step, strict=True):
                rows[key].append(np.copy(value))
            observation, ended = after, terminated or truncated
    return {key: np.array(values) for key, values in rows.items()}


if __name__ == "__main__":
    steps = record(gymnasium.make(TASK), act, EPISODES, SEED)
    np.savez(sys.argv[1], **steps)  # not savez_compressed
    print(f"{len(steps['rewards'])} steps, return {steps['rewards'].sum() / EPISODES:.2f}")

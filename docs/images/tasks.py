"""Draws ``tasks.png``: ``.venv/bin/python docs/images/tasks.py``."""

from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image

import dmprl  # noqa: F401 - registers the tasks

SIZE = 300
TASKS = ("Reacher-v5", "Pusher-v5", "Thrower-v0", "PandaReach-v0")


def frame(task: str) -> np.ndarray:
    """A moment of an episode with random actions."""
    env = gymnasium.make(f"dmprl/{task}", render_mode="rgb_array", width=2 * SIZE, height=2 * SIZE)
    env.reset(seed=1)
    env.action_space.seed(1)
    for _ in range(12):
        env.step(env.action_space.sample())
    picture = env.render()
    env.close()
    return np.asarray(Image.fromarray(picture).resize((SIZE, SIZE), Image.Resampling.LANCZOS))


row = Image.fromarray(np.concatenate([frame(task) for task in TASKS], axis=1))
row.save(Path(__file__).with_suffix(".png"), optimize=True)

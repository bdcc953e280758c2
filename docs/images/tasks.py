"""Draws the tasks' pictures in this folder: ``.venv/bin/python docs/images/tasks.py``."""

from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image

import dmprl  # noqa: F401 - registers the tasks
from dmprl.tasks.scripted import CONTROLLERS, split

SIZE = 300
TASKS = ("Reacher-v5", "Pusher-v5", "Thrower-v0", "PandaReach-v0")
# Steps of the scripted controllers after which the picture is taken.
OBJECT_TASKS = {
    "PandaPush-v0": 18,
    "PandaSlide-v0": 20,
    "PandaPickAndPlace-v0": 15,
    "PandaStack-v0": 62,
}


def picture(env: gymnasium.Env) -> np.ndarray:
    """The current state, drawn at twice the size."""
    drawn = env.render()
    env.close()
    return np.asarray(Image.fromarray(drawn).resize((SIZE, SIZE), Image.Resampling.LANCZOS))


def made(task: str) -> gymnasium.Env:
    """A task's environment, at the start of an episode."""
    env = gymnasium.make(f"dmprl/{task}", render_mode="rgb_array", width=2 * SIZE, height=2 * SIZE)
    env.reset(seed=1)
    return env


def random_moment(task: str) -> np.ndarray:
    """A moment of an episode with random actions."""
    env = made(task)
    env.action_space.seed(1)
    for _ in range(12):
        env.step(env.action_space.sample())
    return picture(env)


def scripted_moment(task: str, steps: int) -> np.ndarray:
    """A moment of an episode of a scripted controller."""
    env, controller = made(task), CONTROLLERS[f"dmprl/{task}"]()
    observation, _ = env.reset(seed=5)
    for _ in range(steps):
        row = gymnasium.spaces.flatten(env.observation_space, observation)
        action = controller.act(split(env.unwrapped.task, row))
        observation = env.step(action.astype(np.float32))[0]
    return picture(env)


def save(name: str, pictures: list[np.ndarray]) -> None:
    """Writes pictures side by side."""
    strip = Image.fromarray(np.concatenate(pictures, axis=1))
    strip.save(Path(__file__).with_name(name), optimize=True)


if __name__ == "__main__":
    save("tasks.png", [random_moment(task) for task in TASKS])
    save("panda-objects.png", [scripted_moment(*moment) for moment in OBJECT_TASKS.items()])
    save("box-pushing.png", [picture(made("BoxPushingDense-v0"))])

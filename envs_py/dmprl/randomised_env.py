"""Draws the model of Gymnasium environments on MuJoCo anew for each episode."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco

from dmprl.env_options import Randomise, RandomiseError
from dmprl.randomise import ModelRandomiser
from dmprl.task_env import TaskEnv


class RandomisedEnv(gymnasium.Wrapper):
    """Draws the model of a Gymnasium environment on MuJoCo at each reset."""

    def __init__(self, env: gymnasium.Env, ranges: Randomise) -> None:
        super().__init__(env)
        name, inner = env.spec.id, env.unwrapped
        model, data = getattr(inner, "model", None), getattr(inner, "data", None)
        if not (isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData)):
            raise RandomiseError.of(ranges.of_model(), name, "it has no MuJoCo model")
        self._randomiser = ModelRandomiser(name, ranges, model)
        same_space = env.observation_space is inner.observation_space
        if self._randomiser.moves_objects and not (same_space and hasattr(inner, "_get_obs")):
            key = "object_size" if ranges.changes("object_size") else "start_pose"
            reason = "its observation cannot be computed again, because it has no `_get_obs`"
            raise RandomiseError.of(key, name, reason)

    def reset(  # noqa: D102 - inherited
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._randomiser.seed(seed)
        self._randomiser.draw()
        observation, info = self.env.reset(seed=seed, options=options)
        if self._randomiser.moves_objects:
            inner = self.unwrapped
            self._randomiser.place(inner.data.qpos)
            mujoco.mj_forward(inner.model, inner.data)
            observation = inner._get_obs()
        return observation, info


def randomised_env(env: gymnasium.Env, ranges: Randomise) -> gymnasium.Env:
    """Randomises a Gymnasium environment; one of dmprl's tasks like a worker's batch of it."""
    if isinstance(env.unwrapped, TaskEnv):
        env.unwrapped.randomise(ranges)
        return env
    return RandomisedEnv(env, ranges)

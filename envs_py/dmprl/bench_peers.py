"""Environment loops that ``dmprl bench rollout`` compares with a worker.

Each class has ``segment()``, which runs one segment in all E environments and returns the number of
environment steps, and ``about``, its description. The constructor raises :class:`AbsentError` if
the peer is unavailable. ``bench_physics`` defines upper bounds with the same interface.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmprl.env_options import EnvOptions
from dmprl.numpy_policy import Actor
from dmprl.tasks import PANDA_OBJECTS

PANDA_GYM_IDS = {
    "dmprl/PandaReach-v0": "PandaReachDense-v3",
    "dmprl/PandaReachJoints-v0": "PandaReachJointsDense-v3",
} | {
    f"dmprl/{name}{variant}-v0": f"{name}{variant}-v3"
    for name in PANDA_OBJECTS
    for variant in ("", "Dense", "Joints", "JointsDense")
}
"""panda-gym's ids of dmprl's Panda tasks."""


class AbsentError(Exception):
    """Raised if a peer is unavailable. The message gives the reason."""


class RandomActor:
    """Draws actions uniformly within their bounds."""

    def __init__(self, plan: dict, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._low, self._high = plan["spec"]["action_low"], plan["spec"]["action_high"]
        self._shape = (plan["env_count"], plan["decision_steps"], plan["spec"]["action_len"])

    def actions(self, observations: NDArray) -> NDArray[np.float64]:
        """Returns actions of the shape of the policy's, (E, K, A)."""
        return self._random.uniform(self._low, self._high, self._shape)

    def end_segments(self, ended: NDArray[np.bool_]) -> None:
        """Does nothing, because random actions have no state."""


def gymnasium_env(plan: dict) -> Any:
    """Creates the environment with Gymnasium, or raises :class:`AbsentError` with the reason."""
    task_id, options = plan["task"]["id"], EnvOptions.parse(plan["options"])
    module_name, _, name = task_id.rpartition(":")
    try:
        import gymnasium

        from dmprl.gymnasium_env import wrapped

        named = getattr(importlib.import_module(module_name), name, None) if module_name else None
        if "gymnasium_robotics" in sys.modules:
            from dmprl import robotics_repair

            robotics_repair.repair()
        if named is None:
            env = gymnasium.make(task_id, **options.kwargs)
            return flattened(wrapped(env, options.wrappers))
        if isinstance(named, type) and issubclass(named, gymnasium.Env):
            limit = plan["spec"]["episode_steps"] or getattr(named, "max_episode_steps", None)
            spec = gymnasium.envs.registration.EnvSpec(
                task_id, entry_point=named, max_episode_steps=limit
            )
            env = gymnasium.make(spec, **options.kwargs)
            return flattened(wrapped(env, options.wrappers))
    except Exception as error:  # for any error, the rest of the benchmark continues
        reason = f"{type(error).__name__}: {error}"
        raise AbsentError(f"Gymnasium cannot create {task_id}: {reason}") from None
    raise AbsentError(f"{task_id} is not a Gymnasium environment")


def refuse_options(plan: dict, peer: str) -> None:
    """Raises :class:`AbsentError` if the task has arguments or wrappers, which the peer lacks."""
    if plan["task"].get("kwargs") or plan["task"].get("wrappers"):
        raise AbsentError(f"{peer}'s environment has no task.kwargs or task.wrappers")


def flattened(env: Any) -> Any:
    """Adds Gymnasium's wrapper for tuples and nested spaces, which :func:`flat` cannot convert."""
    from gymnasium import spaces, wrappers

    space = env.observation_space
    entries = space.values() if isinstance(space, spaces.Dict) else [space]
    if all(isinstance(entry, spaces.Box) for entry in entries):
        return env
    return wrappers.FlattenObservation(env)


class GymnasiumLoop:
    """Runs Gymnasium environments one after the other, with the policy in NumPy."""

    def __init__(self, plan: dict, seed: int) -> None:
        self._envs = [gymnasium_env(plan) for _ in range(plan["env_count"])]
        self._actor = Actor(plan, seed)
        self._dtype = self._envs[0].action_space.dtype
        shape = (plan["env_count"], plan["decision_steps"])
        # Like a worker, this loop stores the data for a learner.
        self._observations = np.zeros((*shape, plan["spec"]["observation_len"]))
        self._rewards = np.zeros(shape)
        self._current = np.zeros((plan["env_count"], plan["spec"]["observation_len"]))
        for index, env in enumerate(self._envs):
            self._current[index] = flat(env.reset(seed=seed + index)[0])
        self.about = f"gymnasium {importlib.import_module('gymnasium').__version__}"
        self.about += f", numpy {np.__version__}"

    def segment(self) -> int:
        """Runs one segment; returns the number of environment steps."""
        steps = 0
        actions = self._actor.actions(self._current).astype(self._dtype)
        ended = np.zeros(len(self._envs), np.bool_)
        for index, env in enumerate(self._envs):
            observations, rewards = self._observations[index], self._rewards[index]
            for k, action in enumerate(actions[index]):
                observation, rewards[k], terminated, truncated, _ = env.step(action)
                observations[k] = observation = flat(observation)
                steps += 1
                if terminated or truncated:
                    observation = flat(env.reset()[0])
                    ended[index] = True
                    break
            self._current[index] = observation
        self._actor.end_segments(ended)
        return steps


def flat(observation) -> np.ndarray:
    """Concatenates a dictionary's entries in the order of its sorted keys, as the worker does."""
    if isinstance(observation, dict):
        return np.concatenate([np.ravel(observation[key]) for key in sorted(observation)])
    return observation


class EnvPoolLoop:
    """Runs EnvPool in its synchronous mode on one thread, with the policy in NumPy.

    EnvPool uses a step for each reset, which is not counted. If an episode ends within a segment,
    the rest of that segment runs in the next episode.
    """

    def __init__(self, plan: dict, seed: int) -> None:
        refuse_options(plan, "EnvPool")
        envpool = imported("envpool")
        task_id = envpool_id(plan["task"]["id"], envpool.list_all_envs())
        env_count = plan["env_count"]
        self._env = envpool.make(
            task_id, env_type="gymnasium", num_envs=env_count, num_threads=1, seed=seed
        )
        self.about = f"envpool {envpool.__version__} ({task_id}), numpy {np.__version__}"
        self._actor = Actor(plan, seed)
        self._current, _ = self._env.reset()
        expected = (env_count, plan["spec"]["observation_len"])
        if self._current.shape != expected:
            raise AbsentError(
                f"EnvPool's {task_id} has observations of shape {self._current.shape}, the worker "
                f"of {expected}"
            )
        self._dtype = self._env.action_space.dtype
        shape = (plan["decision_steps"], env_count)
        self._observations = np.zeros((*shape, expected[1]))
        self._rewards = np.zeros(shape)
        self._resets = np.zeros(env_count, np.bool_)

    def segment(self) -> int:
        """Runs one segment; returns the number of environment steps."""
        steps = 0
        actions = self._actor.actions(self._current).astype(self._dtype)
        ended = np.zeros(len(self._resets), np.bool_)
        for k in range(actions.shape[1]):
            observations, rewards, terminated, truncated, _ = self._env.step(
                np.ascontiguousarray(actions[:, k])
            )
            self._observations[k], self._rewards[k] = observations, rewards
            steps += len(self._resets) - int(np.count_nonzero(self._resets))
            self._resets = terminated | truncated
            ended |= self._resets
        self._current = observations
        self._actor.end_segments(ended)
        return steps


class PandaGymLoop:
    """Runs panda-gym's environments one after the other, with random actions and no policy.

    This is the usual setup with panda-gym: PyBullet instead of MuJoCo, and everything in Python.
    """

    def __init__(self, plan: dict, seed: int) -> None:
        task_id = PANDA_GYM_IDS.get(plan["task"]["id"])
        if task_id is None:
            raise AbsentError(f"panda-gym has no {plan['task']['id']}")
        refuse_options(plan, "panda-gym")
        panda_gym, gymnasium = imported("panda_gym", "panda-gym"), imported("gymnasium")
        self._envs = [gymnasium.make(task_id) for _ in range(plan["env_count"])]
        self._actor = RandomActor(plan, seed)
        self._dtype = self._envs[0].action_space.dtype
        for index, env in enumerate(self._envs):
            env.reset(seed=seed + index)
        self.about = f"panda-gym {panda_gym.__version__} ({task_id}), random actions"

    def segment(self) -> int:
        """Runs one segment; returns the number of environment steps."""
        steps = 0
        actions = self._actor.actions(np.empty(0)).astype(self._dtype)
        for env, env_actions in zip(self._envs, actions, strict=True):
            for action in env_actions:
                _, _, terminated, truncated, _ = env.step(action)
                steps += 1
                if terminated or truncated:
                    env.reset()
                    break
        return steps


def imported(module_name: str, package: str | None = None) -> ModuleType:
    """Imports a module, or raises :class:`AbsentError`."""
    try:
        return importlib.import_module(module_name)
    except ImportError as error:
        raise AbsentError(
            f"{sys.executable} cannot import {package or module_name} ({error}); install it there, "
            "or choose another interpreter with --peer-python"
        ) from None


def envpool_id(task_id: str, known: list[str]) -> str:
    """Finds EnvPool's id of a Gymnasium task: the same one, or EnvPool's newest version of it."""
    if task_id in known:
        return task_id
    name = task_id.rpartition("-v")[0]
    versions = [int(other.rpartition("-v")[2]) for other in known if other.startswith(f"{name}-v")]
    if not name or not versions:
        raise AbsentError(f"EnvPool has no {task_id}")
    return f"{name}-v{max(versions)}"

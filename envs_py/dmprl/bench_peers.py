"""Who makes environment steps in ``dmprl bench rollout`` besides the worker itself.

Each class has ``segment()``, which runs one segment in all E environments and returns the
environment steps in it, and ``about``, which says what it is. Making one raises
:class:`AbsentError` where it is not to be had.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmprl.numpy_policy import Noise, NumpyPolicy

CONTROLS_BYTES_MAX = 16 << 20
"""Of controls drawn beforehand; few enough to draw at once, many enough not to repeat soon."""


class AbsentError(Exception):
    """A comparison is not to be had here. The message says why."""


class BatchPeer:
    """``mujoco.batch.Batch`` with no policy and nothing recorded: physics alone.

    Random controls within their bounds, drawn beforehand; episodes begin at ``starts``, rows of
    ``Batch.state``, since without new episodes such controls would leave the states of the task.
    """

    def __init__(self, model, frame_skip: int, starts: NDArray, plan: dict, seed: int) -> None:
        from mujoco.batch import Batch

        self._steps: int = plan["decision_steps"]
        self._env_steps = plan["env_count"] * self._steps
        self._substeps = self._steps * frame_skip
        self._batch, self._starts = Batch(model, plan["env_count"], nthread=1), starts
        episode_steps = plan["spec"]["episode_steps"] or sys.maxsize
        self._segments_of_episode = max(1, episode_steps // self._steps)
        self._controls = controls(model, (plan["env_count"], self._steps), frame_skip, seed)
        self._segment = 0

    def segment(self) -> int:
        """Runs one segment; returns the environment steps in it."""
        if self._segment % self._segments_of_episode == 0:
            self._batch.state[:] = self._starts
        control = self._controls[self._segment % len(self._controls)]
        self._segment += 1
        self._batch.rollout(self._substeps, control, record=())
        return self._env_steps


class StockBatch(BatchPeer):
    """On the model file that Gymnasium ships, in a process as MuJoCo's import leaves it."""

    def __init__(self, plan: dict, seed: int) -> None:
        env = gymnasium_env(plan["task"]["id"]).unwrapped
        path = getattr(env, "fullpath", None)
        if path is None or not hasattr(env, "frame_skip"):
            raise AbsentError(f"{plan['task']['id']} has no model file of Gymnasium's")
        import mujoco
        from mujoco.batch import Batch

        model = mujoco.MjModel.from_xml_path(path)
        batch = Batch(model, plan["env_count"], nthread=1)
        for index in range(plan["env_count"]):
            env.reset(seed=seed + index)
            batch.qpos[index], batch.qvel[index] = env.data.qpos, env.data.qvel
        super().__init__(model, env.frame_skip, batch.state.copy(), plan, seed)
        self.about = f"mujoco.batch {mujoco.__version__}, {Path(path).name} as Gymnasium ships it"


class Ceiling(BatchPeer):
    """On the model of the worker's own back end, in a process that this has set up."""

    def __init__(self, plan: dict, seed: int) -> None:
        from dmprl.segment_env import SegmentBuffers, make

        task_id, env_count, steps = plan["task"]["id"], plan["env_count"], plan["decision_steps"]
        env = make(task_id, env_count, steps)
        # Not by its class: whatever steps a Batch has a bound of this kind.
        task, batch = getattr(env, "task", None), getattr(env, "batch", None)
        if task is None or not hasattr(batch, "rollout"):
            raise AbsentError(f"{task_id} does not run on mujoco.batch")
        spec = env.spec()
        out = SegmentBuffers(env_count, steps, spec["observation_len"], spec["action_len"])
        seeds = np.arange(seed, seed + env_count, dtype=np.uint64)
        env.reset(np.ones(env_count, np.uint8), seeds, out)
        super().__init__(task.model, task.frame_skip, batch.state.copy(), plan, seed)
        self.about = "mujoco.batch with the worker's model and settings"


def controls(model, shape: tuple[int, int], frame_skip: int, seed: int) -> NDArray[np.float64]:
    """Controls of some segments, (segments, E, K frame_skip, nu), uniform within their bounds."""
    bytes_of_segment = shape[0] * shape[1] * frame_skip * model.nu * 8
    segments = max(2, min(256, CONTROLS_BYTES_MAX // max(1, bytes_of_segment)))
    low, high = model.actuator_ctrlrange.T
    bounded = model.actuator_ctrllimited.astype(bool)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    drawn = np.random.default_rng(seed).uniform(low, high, (segments, *shape, model.nu))
    return np.repeat(drawn, frame_skip, axis=2)


def gymnasium_env(task_id: str) -> Any:
    """The environment as Gymnasium makes it, or :class:`AbsentError`."""
    import gymnasium

    try:
        return gymnasium.make(task_id)
    except gymnasium.error.UnregisteredEnv:
        raise AbsentError(f"{task_id} is no environment of Gymnasium") from None


class GymnasiumLoop:
    """Gymnasium environments, one after the other, under the policy in NumPy."""

    def __init__(self, plan: dict, seed: int) -> None:
        self._envs = [gymnasium_env(plan["task"]["id"]) for _ in range(plan["env_count"])]
        self._policy, self._noise = NumpyPolicy(plan), Noise(plan, seed)
        self._dtype = self._envs[0].action_space.dtype
        shape = (plan["env_count"], plan["decision_steps"])
        # What a learner would be sent is kept here too, as the worker keeps it.
        self._observations = np.zeros((*shape, plan["spec"]["observation_len"]))
        self._rewards = np.zeros(shape)
        self._current = np.zeros((plan["env_count"], plan["spec"]["observation_len"]))
        for index, env in enumerate(self._envs):
            self._current[index] = flat(env.reset(seed=seed + index)[0])
        self.about = f"gymnasium {importlib.import_module('gymnasium').__version__}"
        self.about += f", numpy {np.__version__}"

    def segment(self) -> int:
        """Runs one segment; returns the environment steps in it."""
        policy, steps = self._policy, 0
        actions = policy.scaled(policy.u(self._current, self._noise)).astype(self._dtype)
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
        policy.carry_on(ended)
        self._noise.episodes_ended(ended)
        return steps


def flat(observation) -> np.ndarray:
    """A dictionary's entries in the order of its sorted keys, as the worker sees them."""
    if isinstance(observation, dict):
        return np.concatenate([np.ravel(observation[key]) for key in sorted(observation)])
    return observation


class EnvPoolLoop:
    """EnvPool in its synchronous mode on one thread, under the policy in NumPy.

    EnvPool spends a step on each reset; that is no environment step and is not counted. An episode
    that ends inside a segment is followed by the rest of that segment in the next one.
    """

    def __init__(self, plan: dict, seed: int) -> None:
        envpool = import_envpool()
        task_id = envpool_id(plan["task"]["id"], envpool.list_all_envs())
        env_count = plan["env_count"]
        self._env = envpool.make(
            task_id, env_type="gymnasium", num_envs=env_count, num_threads=1, seed=seed
        )
        self.about = f"envpool {envpool.__version__} ({task_id}), numpy {np.__version__}"
        self._policy, self._noise = NumpyPolicy(plan), Noise(plan, seed)
        self._current, _ = self._env.reset()
        expected = (env_count, plan["spec"]["observation_len"])
        if self._current.shape != expected:
            raise AbsentError(
                f"EnvPool's {task_id} observes {self._current.shape}, the worker {expected}"
            )
        self._dtype = self._env.action_space.dtype
        shape = (plan["decision_steps"], env_count)
        self._observations = np.zeros((*shape, expected[1]))
        self._rewards = np.zeros(shape)
        self._resets = np.zeros(env_count, np.bool_)

    def segment(self) -> int:
        """Runs one segment; returns the environment steps in it."""
        policy, steps = self._policy, 0
        actions = policy.scaled(policy.u(self._current, self._noise)).astype(self._dtype)
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
        policy.carry_on(ended)
        self._noise.episodes_ended(ended)
        return steps


def import_envpool():
    """The module, or :class:`AbsentError`."""
    try:
        return importlib.import_module("envpool")
    except ImportError as error:
        raise AbsentError(
            f"{sys.executable} cannot import envpool ({error}); install it there, or name an "
            "interpreter that has it with --peer-python"
        ) from None


def envpool_id(task_id: str, known: list[str]) -> str:
    """EnvPool's id of a Gymnasium task: the same, or its newest version there."""
    if task_id in known:
        return task_id
    name = task_id.rpartition("-v")[0]
    versions = [int(other.rpartition("-v")[2]) for other in known if other.startswith(f"{name}-v")]
    if not name or not versions:
        raise AbsentError(f"EnvPool has no {task_id}")
    return f"{name}-v{max(versions)}"

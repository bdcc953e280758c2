"""Who makes environment steps in ``dmprl bench rollout`` besides the worker itself.

Each class has ``segment()``, which runs one segment in all E environments and returns the
environment steps in it, and ``about``, which says what it is. Making one raises
:class:`AbsentError` where it is not to be had.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmprl.numpy_policy import Actor

CONTROLS_BYTES_MAX = 64 << 20
"""Of the controls of an episode; where more would be needed, episodes are shorter."""
EPISODE_STEPS = 100
"""Of an episode where the task has no limit."""


class AbsentError(Exception):
    """A comparison is not to be had here. The message says why."""


class BatchPeer:
    """``mujoco.batch.Batch`` with no policy and nothing recorded: physics alone.

    The same episode in each environment over and over: ``starts`` are rows of ``Batch.state``,
    ``controls`` (steps, E, nu).
    """

    def __init__(self, model, frame_skip: int, starts: NDArray, controls: NDArray, k: int) -> None:
        from mujoco.batch import Batch

        env_count = controls.shape[1]
        self._env_steps, self._substeps = env_count * k, k * frame_skip
        self._batch, self._starts = Batch(model, env_count, nthread=1), starts
        segments = max(1, len(controls) // k)
        controls = controls[np.arange(segments * k) % len(controls)]
        # (segments, E, K frame_skip, nu), as a rollout takes them.
        controls = controls.reshape(segments, k, env_count, model.nu).swapaxes(1, 2)
        self._controls = np.repeat(controls, frame_skip, axis=2)
        self._segment = 0

    def segment(self) -> int:
        """Runs one segment; returns the environment steps in it."""
        if self._segment == 0:
            self._batch.state[:] = self._starts
        self._batch.rollout(self._substeps, self._controls[self._segment], record=())
        self._segment = (self._segment + 1) % len(self._controls)
        return self._env_steps


class Physics(BatchPeer):
    """On the model of the worker's own back end, in a process that this has set up.

    Nothing a worker could do costs less: its time beyond this is its own.
    """

    def __init__(self, plan: dict, seed: int) -> None:
        from dmprl.segment_env import SegmentBuffers, make

        task_id, env_count = plan["task"]["id"], plan["env_count"]
        try:
            env = make(task_id, env_count, 1)
        except Exception as error:
            raise AbsentError(f"{task_id} cannot be made: {error}") from None
        # Not by its class: whatever steps a Batch has a bound of this kind.
        task, batch = getattr(env, "task", None), getattr(env, "batch", None)
        if task is None or not hasattr(batch, "rollout"):
            raise AbsentError(f"{task_id} does not run on mujoco.batch")
        spec = env.spec()
        out = SegmentBuffers(env_count, 1, spec["observation_len"], spec["action_len"])
        seeds = np.arange(seed, seed + env_count, dtype=np.uint64)
        env.reset(np.ones(env_count, np.uint8), seeds, out)
        starts = batch.state.copy()

        def step(actions: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
            env.step_segment(actions[:, None], out)
            return out.next_observations, batch.ctrl

        steps = episode_steps(plan, task.frame_skip, task.model.nu)
        controls = episode_controls(plan, seed, out.next_observations, step, steps)
        super().__init__(task.model, task.frame_skip, starts, controls, plan["decision_steps"])
        self.about = "mujoco.batch with the worker's model and settings"


class Ceiling(BatchPeer):
    """In a process as MuJoCo's import leaves it, on Gymnasium's model file where there is one."""

    def __init__(self, plan: dict, seed: int) -> None:
        path = gymnasium_model_path(plan["task"]["id"])
        if path is not None:
            self._init_with_gymnasium(plan, seed, path)
            return
        import mujoco

        from dmprl.mujoco_batch import mujoco_hook

        clock = mujoco_hook("mjcb_time").value
        physics = Physics(plan, seed)  # takes the clock out
        mujoco_hook("mjcb_time").value = clock
        self.__dict__.update(vars(physics))
        self.about = f"mujoco.batch {mujoco.__version__} as it is imported"

    def _init_with_gymnasium(self, plan: dict, seed: int, path: str) -> None:
        import mujoco
        from mujoco.batch import Batch

        model, env_count = mujoco.MjModel.from_xml_path(path), plan["env_count"]
        envs = [gymnasium_env(plan["task"]["id"]).unwrapped for _ in range(env_count)]
        batch = Batch(model, env_count, nthread=1)
        seen = [flat(env.reset(seed=seed + index)[0]) for index, env in enumerate(envs)]
        for index, env in enumerate(envs):
            batch.qpos[index], batch.qvel[index] = env.data.qpos, env.data.qvel
        frame_skip, dtype = envs[0].frame_skip, envs[0].action_space.dtype

        def step(actions: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
            pairs = zip(envs, actions.astype(dtype), strict=True)
            observations = np.stack([flat(env.step(action)[0]) for env, action in pairs])
            return observations, np.stack([env.data.ctrl for env in envs])

        steps = episode_steps(plan, frame_skip, model.nu)
        controls = episode_controls(plan, seed, np.stack(seen), step, steps)
        starts = batch.state.copy()
        super().__init__(model, frame_skip, starts, controls, plan["decision_steps"])
        self.about = f"mujoco.batch {mujoco.__version__}, {Path(path).name} as Gymnasium ships it"


def gymnasium_model_path(task_id: str) -> str | None:
    """The model file of one of Gymnasium's own MuJoCo environments."""
    try:
        env = gymnasium_env(task_id).unwrapped
    except AbsentError:
        return None
    return getattr(env, "fullpath", None) if hasattr(env, "frame_skip") else None


class RandomActor:
    """Actions drawn uniformly within their bounds."""

    def __init__(self, plan: dict, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._low, self._high = plan["spec"]["action_low"], plan["spec"]["action_high"]
        self._shape = (plan["env_count"], plan["decision_steps"], plan["spec"]["action_len"])

    def actions(self, observations: NDArray) -> NDArray[np.float64]:
        """As the policy's."""
        return self._random.uniform(self._low, self._high, self._shape)

    def carry_on(self, ended: NDArray[np.bool_]) -> None:
        """Nothing is carried on."""


def episode_controls(
    plan: dict,
    seed: int,
    observations: NDArray,
    step: Callable[[NDArray[np.float64]], tuple[NDArray, NDArray]],
    steps: int,
) -> NDArray[np.float64]:
    """Controls of an episode, (steps, E, nu), drawn before anything is measured.

    The worker's own policy draws them, unless the plan wants random actions: physics costs what
    the states cost that a policy leads to, and pushing against a joint's limit is dear. ``step``
    applies actions, (E, A), and returns what is seen then, (E, O), and the controls, (E, nu).
    """
    actor = (Actor if plan["controls"] == "policy" else RandomActor)(plan, seed)
    nobody, controls = np.zeros(plan["env_count"], np.bool_), []
    while len(controls) < steps:
        actions = actor.actions(observations)
        for k in range(min(actions.shape[1], steps - len(controls))):
            observations, control = step(actions[:, k])
            controls.append(control.copy())
        actor.carry_on(nobody)
    return np.stack(controls)


def episode_steps(plan: dict, frame_skip: int, nu: int) -> int:
    """Steps of an episode without its last, after which the environments begin anew."""
    fits = CONTROLS_BYTES_MAX // (plan["env_count"] * frame_skip * max(1, nu) * 8)
    return max(1, min(fits, (plan["spec"]["episode_steps"] or EPISODE_STEPS) - 1))


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
        self._actor = Actor(plan, seed)
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
        self._actor.carry_on(ended)
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
        self._actor = Actor(plan, seed)
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
        self._actor.carry_on(ended)
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

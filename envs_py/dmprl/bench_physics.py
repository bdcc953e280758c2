"""Runs only the physics, as an upper bound for the worker in ``dmprl bench rollout``.

The classes have the same interface as the loops of ``bench_peers``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmprl.bench_peers import AbsentError, RandomActor, flat, gymnasium_env
from dmprl.env_options import EnvOptions
from dmprl.numpy_policy import Actor

CONTROLS_BYTES_MAX = 64 << 20
"""Maximum size of an episode's controls; longer episodes are shortened."""
EPISODE_STEPS = 100
"""Length of an episode if the task has no limit."""


@dataclass(frozen=True)
class Episode:
    """An episode in each of E environments, for replaying only its physics."""

    model: Any
    """MuJoCo's model."""
    frame_skip: int
    """Simulation steps per environment step."""
    starts: NDArray[np.float64]
    """Rows of ``Batch.state``, (E, …)."""
    controls: NDArray[np.float64]
    """Controls of each environment step, (steps, E, nu)."""


@dataclass(frozen=True)
class Stage:
    """Environments at the start of an episode, and a function that steps them."""

    model: Any
    frame_skip: int
    observations: NDArray
    """Observations at the start, (E, O)."""
    step: Callable[[NDArray[np.float64]], tuple[NDArray, NDArray]]
    """Applies actions, (E, A); returns the observations, (E, O), and the controls, (E, nu)."""


class BatchPeer:
    """Runs ``mujoco.batch.Batch`` without a policy and without recording.

    It repeats the same episode in each environment.
    """

    def __init__(self, episode: Episode, k: int) -> None:
        from mujoco.batch import Batch

        model, controls, skip = episode.model, episode.controls, episode.frame_skip
        env_count = controls.shape[1]
        self._env_steps, self._substeps = env_count * k, k * skip
        self._batch, self._starts = Batch(model, env_count, nthread=1), episode.starts
        segments = max(1, len(controls) // k)
        controls = controls[np.arange(segments * k) % len(controls)]
        # (segments, E, K frame_skip, nu), as rollout expects.
        controls = controls.reshape(segments, k, env_count, model.nu).swapaxes(1, 2)
        self._controls = np.repeat(controls, skip, axis=2)
        self._segment = 0

    def segment(self) -> int:
        """Runs one segment; returns the number of environment steps."""
        if self._segment == 0:
            self._batch.state[:] = self._starts
        self._batch.rollout(self._substeps, self._controls[self._segment], record=())
        self._segment = (self._segment + 1) % len(self._controls)
        return self._env_steps


class Ceiling(BatchPeer):
    """Runs physics with the worker's model and process settings.

    No worker can be faster; the difference is the overhead of the worker.
    """

    def __init__(self, plan: dict, seed: int) -> None:
        super().__init__(worker_episode(plan, seed), plan["decision_steps"])
        self.about = "mujoco.batch with the worker's model and settings"


class PlainMujoco(BatchPeer):
    """Runs physics with MuJoCo's default settings, on Gymnasium's model file if there is one."""

    def __init__(self, plan: dict, seed: int) -> None:
        import mujoco

        about = f"mujoco.batch {mujoco.__version__}"
        path = gymnasium_model_path(plan)
        if path is not None:
            episode = gymnasium_episode(plan, seed, path)
            self.about = f"{about}, {Path(path).name} of Gymnasium"
        else:
            from dmprl.mujoco_batch import mujoco_hook

            clock = mujoco_hook("mjcb_time").value
            episode = worker_episode(plan, seed)  # removes the clock
            mujoco_hook("mjcb_time").value = clock
            self.about = f"{about} with its default settings"
        super().__init__(episode, plan["decision_steps"])


def worker_episode(plan: dict, seed: int) -> Episode:
    """Creates an episode of the worker's environments, and applies their process settings."""
    from dmprl.segment_env import SegmentBuffers, make

    task_id, env_count = plan["task"]["id"], plan["env_count"]
    options = EnvOptions.parse(plan["options"])
    try:
        env = make(task_id, env_count, 1, options)
    except Exception as error:
        raise AbsentError(f"cannot create {task_id}: {error}") from None
    # Duck typing, because this works for every environment that steps a Batch.
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

    stage = Stage(task.model, task.frame_skip, out.next_observations, step)
    return Episode(task.model, task.frame_skip, starts, episode_controls(plan, seed, stage))


def gymnasium_episode(plan: dict, seed: int, path: str) -> Episode:
    """Creates an episode of Gymnasium's environments, on their model file."""
    import mujoco
    from mujoco.batch import Batch

    model, env_count = mujoco.MjModel.from_xml_path(path), plan["env_count"]
    envs = [gymnasium_env(plan).unwrapped for _ in range(env_count)]
    batch = Batch(model, env_count, nthread=1)
    observed = [flat(env.reset(seed=seed + index)[0]) for index, env in enumerate(envs)]
    for index, env in enumerate(envs):
        batch.qpos[index], batch.qvel[index] = env.data.qpos, env.data.qvel
    frame_skip, dtype = envs[0].frame_skip, envs[0].action_space.dtype

    def step(actions: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        pairs = zip(envs, actions.astype(dtype), strict=True)
        observations = np.stack([flat(env.step(action)[0]) for env, action in pairs])
        return observations, np.stack([env.data.ctrl for env in envs])

    starts = batch.state.copy()
    stage = Stage(model, frame_skip, np.stack(observed), step)
    return Episode(model, frame_skip, starts, episode_controls(plan, seed, stage))


def gymnasium_model_path(plan: dict) -> str | None:
    """Finds the model file of one of Gymnasium's own MuJoCo environments.

    The policy of an environment with wrappers cannot act on the observations of the physics alone.
    """
    if EnvOptions.parse(plan["options"]).wrappers:
        return None
    try:
        env = gymnasium_env(plan).unwrapped
    except AbsentError:
        return None
    return getattr(env, "fullpath", None) if hasattr(env, "frame_skip") else None


def episode_controls(plan: dict, seed: int, stage: Stage) -> NDArray[np.float64]:
    """Draws the controls of an episode, (steps, E, nu), before the measurement.

    They come from the worker's own policy, unless the plan has random actions. The cost of physics
    depends on the states that a policy visits: pushing against a joint's limit, for example, is
    expensive.
    """
    actor = (Actor if plan["controls"] == "policy" else RandomActor)(plan, seed)
    steps = episode_steps(plan, stage)
    none_ended, controls = np.zeros(plan["env_count"], np.bool_), []
    observations = stage.observations
    while len(controls) < steps:
        actions = actor.actions(observations)
        for k in range(min(actions.shape[1], steps - len(controls))):
            observations, control = stage.step(actions[:, k])
            controls.append(control.copy())
        actor.end_segments(none_ended)
    return np.stack(controls)


def episode_steps(plan: dict, stage: Stage) -> int:
    """Returns the number of steps to replay: all but an episode's last, after which it is reset."""
    bytes_per_step = plan["env_count"] * stage.frame_skip * max(1, stage.model.nu) * 8
    steps_max = CONTROLS_BYTES_MAX // bytes_per_step
    return max(1, min(steps_max, (plan["spec"]["episode_steps"] or EPISODE_STEPS) - 1))

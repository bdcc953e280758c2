"""Runs dmprl's own tasks on MuJoCo's batched simulation, with one call per segment.

A :class:`MujocoTask` defines a task: model, start states, observation, reward. Its methods receive
all environments and all steps at once, as arrays. :class:`BatchSegmentEnv` runs it on
:class:`mujoco.batch.Batch`, which steps E simulations in C without the GIL. It uses one thread,
because the worker processes already use all cores.

Shapes: E environments, K steps of a segment, O observation, A action.
"""

from __future__ import annotations

import copy
import ctypes
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from dmprl.env_options import Randomise
from dmprl.randomise import ModelRandomiser
from dmprl.segment_env import (
    SUCCESS_NOT_REPORTED,
    EnvSpec,
    GoalRows,
    Goals,
    NotGoalConditionedError,
    SegmentBuffers,
    SegmentEnv,
    SegmentEnvError,
    seed_after_failure,
)

Fields = Mapping[str, NDArray]
"""Arrays of MjData by name. Dimensions such as (E,) or (E, K) precede those of MjData."""


class Start(NamedTuple):
    """Start state of an episode: views of one environment's state, or of each, (E, …)."""

    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]
    mocap_pos: NDArray[np.float64]
    mocap_quat: NDArray[np.float64]


class MujocoTask(ABC):
    """Definition of a task, for E environments at once.

    Observations are rows of float64. Actions are float32, as in Gymnasium's action spaces. Reward
    and success are functions of observations and actions.
    """

    id: str
    """Gymnasium id."""
    frame_skip: int
    """Simulation steps per environment step."""
    episode_steps: int
    """Steps after which an episode is truncated."""
    recorded: tuple[str, ...]
    """Names of the MjData fields that :meth:`observe` reads."""
    camera: ClassVar[Mapping[str, Any]] = {}
    """Settings of MuJoCo's free camera for pictures of the task."""
    goal_in_pictures: ClassVar[str] = ""
    """Appearance of the goal in pictures; empty if it is not visible or unknown."""

    def __init__(self, env_count: int) -> None:
        self.env_count = env_count
        self._scratch: dict[tuple[str, tuple[int, ...], type], NDArray] = {}
        self.model = self.load_model()
        self.action_low, self.action_high = (
            bound.astype(np.float32) for bound in self.model.actuator_ctrlrange.T
        )

    def batch(self, segment_steps: int, episode_steps: int | None) -> BatchSegmentEnv:
        """Creates the environments; if ``episode_steps`` is None, their episodes have no limit."""
        return BatchSegmentEnv(self, segment_steps, episode_steps)

    @abstractmethod
    def load_model(self) -> mujoco.MjModel:
        """Compiles the model."""

    def derive_constants(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Recomputes what depends on the masses, after these were changed in ``model``.

        ``data`` is a work area, created once because that takes longer than all the rest.
        """
        mujoco.mj_setConst(model, data)

    def picture_model(self) -> mujoco.MjModel:
        """Returns the model for pictures, with the same states as :attr:`model`."""
        return self.model

    @abstractmethod
    def observation_names(self) -> list[str]:
        """Names the O entries of an observation."""

    @abstractmethod
    def draw_start(self, rng: np.random.Generator, start: Start) -> None:
        """Writes one environment's start state over the model's default in ``start``."""

    def scratch(self, name: str, shape: tuple[int, ...], dtype: type = np.float64) -> NDArray:
        """Returns a work array, created once for each name, shape and type."""
        array = self._scratch.get((name, shape, dtype))
        if array is None:
            array = self._scratch[name, shape, dtype] = np.zeros(shape, dtype)
        return array

    def effort(self, actions: NDArray[np.float32], dtype: type = np.float32) -> NDArray:
        """Returns the sum of squares of each action (E, k, A), computed in ``dtype``."""
        squares = self.scratch("squares", actions.shape, dtype)
        np.square(actions, out=squares, dtype=dtype)
        return np.sum(squares, axis=-1, out=self.scratch("effort", actions.shape[:-1], dtype))

    def episodes_began(self, indices: NDArray[np.int32]) -> None:  # noqa: B027 - most keep nothing
        """Discards the task's data about the last episode of these environments."""

    @abstractmethod
    def observe(self, fields: Fields, out: NDArray[np.float64]) -> None:
        """Writes the observation of each state; ``fields`` (…, …), ``out`` (…, O)."""

    @abstractmethod
    def rewards(
        self,
        observations: NDArray[np.float64],
        actions: NDArray[np.float32],
        out: NDArray[np.float64],
    ) -> None:
        """Writes each step's reward.

        ``observations`` (E, k+1, O), row i before step i; ``actions`` and ``out`` (E, k, …).
        """

    def successes(self, observations: NDArray[np.float64], out: NDArray[np.uint8]) -> None:
        """Writes whether each state (E, O) is a success; by default this is not reported."""
        out[:] = SUCCESS_NOT_REPORTED

    def goals(self) -> Goals:
        """Returns the positions of the goals in an observation; see :class:`~dmprl.goal_task`.

        Raises:
            NotGoalConditionedError: if there are none, as by default.
        """
        raise NotGoalConditionedError(f"{self.id}: its observation has no goals")

    def goal_rewards(
        self,
        achieved: NDArray[np.float64],
        desired: NDArray[np.float64],
        out: NDArray[np.float64],
    ) -> None:
        """Writes the rewards (…) of steps that achieved goals (…, G), for desired ones (…, G)."""
        raise NotImplementedError


class BatchSegmentEnv(SegmentEnv):
    """E simulations of one :class:`MujocoTask` whose actions are the actuators' controls."""

    def __init__(self, task: MujocoTask, segment_steps: int, episode_steps: int | None) -> None:
        self.task = task
        self.env_count = task.env_count
        self.segment_steps = segment_steps
        self.batch = Batch(task.model, self.env_count, nthread=1)
        self._names = task.observation_names()
        self._current = np.zeros((self.env_count, len(self._names)))
        self._actions = np.zeros((self.env_count, segment_steps, len(task.action_low)), np.float32)
        self._rows = np.arange(self.env_count)
        self._episode_steps = episode_steps or 0
        self._limit = episode_steps or np.iinfo(np.int32).max
        # Number of steps until truncation; 0 before the first reset.
        self._remaining = np.zeros(self.env_count, np.int32)
        self._all_began = False
        self._generators: list[np.random.Generator | None] = [None] * self.env_count
        self._seeds = [0] * self.env_count
        self._failures = [0] * self.env_count
        self._messages: list[str] = []
        self._randomisers: list[ModelRandomiser] = []
        self._starts = Start(*(self.batch.bind(name) for name in Start._fields))
        self._fields = {name: self.batch.bind(name) for name in task.recorded}
        # The state after mj_resetData. Copying it is cheaper than that call, and the forward pass
        # recomputes everything else that mj_resetData clears.
        self._new_state = self.batch.state[0].copy()
        self._prepare()

    def randomise(self, ranges: Randomise) -> None:
        """Gives each environment a model of its own, drawn for each episode.

        Raises:
            RandomiseError: if a key cannot be applied to the task.
        """
        task = self.task
        self._models = [copy.copy(task.model) for _ in range(self.env_count)]
        self._randomisers = [
            ModelRandomiser(task.id, ranges, model, task.derive_constants) for model in self._models
        ]

    def _prepare(self) -> None:
        """Allocates the arrays of a segment, for each possible number of steps."""
        task, envs = self.task, self.env_count
        self._controls, self._records, self._ends = [], [], []
        for steps in range(1, self.segment_steps + 1):
            substeps = steps * task.frame_skip
            controls = np.zeros((envs, substeps, task.model.nu))
            records = {
                name: np.zeros((envs, substeps, *field.shape[1:]))
                for name, field in self._fields.items()
            }
            last = slice(task.frame_skip - 1, None, task.frame_skip)
            self._controls.append(controls)
            self._records.append(records)
            self._ends.append({name: record[:, last] for name, record in records.items()})

    def spec(self) -> EnvSpec:  # noqa: D102 - inherited
        task = self.task
        return {
            "id": task.id,
            "observation_len": len(self._names),
            "observation_names": self._names,
            "action_len": len(task.action_low),
            "action_low": task.action_low.astype(np.float64).tolist(),
            "action_high": task.action_high.astype(np.float64).tolist(),
            "control_dt_s": task.model.opt.timestep * task.frame_skip,
            "episode_steps": self._episode_steps,
        }

    def reset(  # noqa: D102 - inherited
        self, mask: NDArray[np.uint8], seeds: NDArray[np.uint64], out: SegmentBuffers
    ) -> None:
        indices = np.flatnonzero(mask).astype(np.int32)
        for index in indices.tolist():
            self._seeds[index], self._failures[index] = int(seeds[index]), 0
            self._seed_all(index, self._seeds[index])
        self.begin(indices, out)

    def begin(self, indices: NDArray[np.int32], out: SegmentBuffers) -> None:
        """Starts an episode in each of these environments, with its own generator."""
        self._begin(indices)
        out.next_observations[indices] = self._current[indices]

    def seed(self, index: int, rng: np.random.Generator) -> None:
        """Sets the generator of an environment's start states."""
        self._generators[index] = rng

    def seed_model(self, index: int, seed: int) -> None:
        """Seeds the draws of an environment's model."""
        if self._randomisers:
            self._randomisers[index].seed(seed)

    def _seed_all(self, index: int, seed: int) -> None:
        self.seed(index, generator(seed))
        self.seed_model(index, seed)

    def step_segment(  # noqa: D102 - inherited
        self, actions: NDArray[np.float64], out: SegmentBuffers
    ) -> None:
        if actions.shape != self._actions.shape:
            raise ValueError(f"actions {actions.shape}, expected (E, K, A) = {self._actions.shape}")
        remaining = self._remaining
        if not self._all_began:
            index = int(remaining.argmin())
            raise SegmentEnvError(f"{self.task.id}, environment {index}: step before reset")
        steps = min(self.segment_steps, int(remaining.max()))
        np.copyto(self._actions, actions, casting="same_kind")
        out.observations[:, 0] = self._current
        failed = self._simulate(steps, out)
        observations = out.observations[:, : steps + 1]
        self.task.rewards(observations, self._actions[:, :steps], out.rewards[:, :steps])
        self._current[:] = observations[:, -1]
        np.minimum(remaining, steps, out=out.steps)
        # The simulation continues after the end of a shorter episode; only the state at its end
        # counts.
        self.task.successes(observations[self._rows, out.steps], out.success)
        remaining -= out.steps
        out.terminated[:] = 0
        np.equal(remaining, 0, out=out.truncated, casting="unsafe")
        out.failed[:] = 0
        if steps < self.segment_steps or out.truncated.any() or failed is not None:
            self._end_episodes(failed, out)
        out.next_observations[:] = self._current

    def _simulate(self, steps: int, out: SegmentBuffers) -> NDArray[np.int32] | None:
        """Runs ``steps`` steps and observes each; returns the environments that failed."""
        skip, which = self.task.frame_skip, steps - 1
        controls = self._controls[which]
        controls.reshape(self.env_count, steps, skip, -1)[:] = self._actions[:, :steps, None]
        records = self._records[which]
        failed = None
        try:
            self.batch.rollout(steps * skip, controls, record=self.task.recorded, out=records)
        except mujoco.batch.SimulationError as error:
            failed = error.ids
        self.task.observe(self._ends[which], out.observations[:, 1 : steps + 1])
        return self._failed(failed)

    def _failed(self, raised: NDArray[np.int32] | None) -> NDArray[np.int32] | None:
        """Returns the environments with an error or a warning, and stores a message for each."""
        if raised is None and not self.batch.warning.any():
            return None
        # MuJoCo stops a simulation after a warning.
        warnings = self.batch.warning[:, :, 1]
        failed = np.flatnonzero(warnings.any(axis=1))
        if raised is not None:
            failed = np.union1d(failed, raised)
        for index in failed.tolist():
            kinds = [mujoco.mjtWarning(kind).name for kind in np.flatnonzero(warnings[index])]
            reason = self.batch.error(index) or f"MuJoCo warning ({', '.join(kinds)})"
            self._messages.append(f"{self.task.id}, environment {index}, this segment: {reason}")
        return failed.astype(np.int32)

    def _end_episodes(self, failed: NDArray[np.int32] | None, out: SegmentBuffers) -> None:
        """Clears the rows after the end of each episode and starts a new one."""
        for index in np.flatnonzero(out.steps < self.segment_steps).tolist():
            out.observations[index, out.steps[index] + 1 :] = 0.0
            out.rewards[index, out.steps[index] :] = 0.0
        if failed is not None:
            out.failed[failed] = 1
            for array in (out.observations, out.rewards, out.steps, out.truncated):
                array[failed] = 0
            out.success[failed] = SUCCESS_NOT_REPORTED
            for index in failed.tolist():
                self._failures[index] += 1
                seed = seed_after_failure(self._seeds[index], self._failures[index])
                self._seed_all(index, seed)
        ended = np.flatnonzero(out.truncated | out.failed).astype(np.int32)
        if ended.size:
            self._begin(ended)

    def _begin(self, indices: NDArray[np.int32]) -> None:
        """Starts an episode in each of these environments."""
        self.batch.state[indices] = self._new_state
        for index in indices.tolist():
            start = Start(*(states[index] for states in self._starts))
            self.task.draw_start(self._generators[index], start)
            if self._randomisers:
                self._randomisers[index].draw()
                self._randomisers[index].place(start.qpos)
        if self._randomisers:
            self.batch.set_models(self._models)  # which have changed
        self.batch.forward(indices)
        self.batch.warning[indices] = 0
        self.task.episodes_began(indices)
        self._remaining[indices] = self._limit
        self._all_began = bool(self._remaining.all())
        if indices.size == self.env_count:
            self.task.observe(self._fields, self._current)
        else:
            began = {name: field[indices] for name, field in self._fields.items()}
            observations = np.zeros((indices.size, self._current.shape[1]))
            self.task.observe(began, observations)
            self._current[indices] = observations

    def goals(self) -> Goals:  # noqa: D102 - inherited
        return self.task.goals()

    def relabel(self, rows: GoalRows) -> None:  # noqa: D102 - inherited
        count = int(rows.count[0])
        achieved, desired = rows.achieved[:count], rows.desired[:count]
        self.task.goal_rewards(achieved, desired, rows.rewards[:count])
        rows.terminated[:count] = 0  # no task ends an episode before its time limit

    def take_failures(self) -> list[str]:  # noqa: D102 - inherited
        messages, self._messages = self._messages, []
        return messages


def generator(seed: int) -> np.random.Generator:
    """Creates a generator as Gymnasium does from the same seed."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))


def quieten_mujoco() -> None:
    """Disables MuJoCo's timer and its log file, in a worker's process.

    MuJoCo's Python bindings install a clock that each stage of a step reads twice, which takes a
    quarter of a step's time on Reacher. Without it, only ``MjData.timer`` is missing. MuJoCo would
    also write its warnings to MUJOCO_LOG.TXT in the working directory; here they become failures
    with a message. The replaced hook must be a C function, so that the simulation does not need the
    GIL; strlen takes a string and has no effect.
    """
    mujoco_hook("mjcb_time").value = None
    strlen = ctypes.cast(ctypes.CDLL(None).strlen, ctypes.c_void_p)
    mujoco_hook("mju_user_warning").value = strlen.value


def mujoco_hook(name: str) -> ctypes.c_void_p:
    """Returns a function pointer of MuJoCo's library that its Python bindings do not expose."""
    library = ctypes.CDLL(str(next(Path(mujoco.__file__).parent.glob("libmujoco*"))))
    return ctypes.c_void_p.in_dll(library, name)

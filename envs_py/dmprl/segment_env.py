"""Several environments behind one call per segment.

A policy decides once per *segment*: K actions, applied open loop. So the worker needs Python only
once per segment, for all its E environments together; this module is that one place. Shapes: E
environments, K steps of a segment, O observation, A action.
"""

from __future__ import annotations

import importlib
import sys
from abc import ABC, abstractmethod
from types import ModuleType
from typing import NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

SUCCESS_NO, SUCCESS_YES, SUCCESS_NOT_REPORTED = 0, 1, 2
"""Values of :attr:`SegmentBuffers.success`."""


EXTRAS = {"panda_gym": "panda-gym", "gymnasium_robotics": "robotics"}
"""Packages that are known to work, and the extra of this one that installs each."""

OBSERVATION_NAMES_MAX = 10_000
"""Longer observations go without names: a specification is written down, and sent as one line."""


class SegmentEnvError(RuntimeError):
    """An environment failed for good. The message names its id, its index and the step."""


class UnsupportedSpaceError(TypeError):
    """An environment's spaces are not what a continuous controller can use."""


class NotGoalConditionedError(TypeError):
    """Hindsight is asked of an environment without goals, or that cannot tell what they reward."""


class Goals(TypedDict):
    """Where an observation holds the goal that was reached, and the one that is wanted."""

    achieved: int
    """First entry of the one,"""
    desired: int
    """and of the other."""
    length: int
    """Entries of each."""
    sparse: bool
    """Whether the reward says no more than reached or not."""


class EnvSpec(TypedDict):
    """What learner and policy must know (``shared/src/spec.rs``)."""

    id: str
    observation_len: int
    action_len: int
    action_low: list[float]
    action_high: list[float]
    control_dt_s: float
    """Duration of one environment step [s]; 0.0 when the environment does not say."""
    episode_steps: int
    """Steps after which an episode is truncated; 0 when it never is."""
    observation_names: NotRequired[list[str]]
    """Of each entry of an observation, such as ``achieved_goal[0]``; empty: they have none."""


class SegmentBuffers:
    """Where a :class:`SegmentEnv` writes: the caller's arrays, allocated once, C-contiguous.

    The worker reads them through the buffer protocol, without a copy. After ``step_segment``:

    - ``observations`` float64 (E, K+1, O): row k is what preceded step k; row ``steps`` is what
      followed the last step really run, so the true final observation of an episode. Later rows
      are zero.
    - ``rewards`` float64 (E, K): zero from ``steps`` on.
    - ``terminated``, ``truncated`` uint8 (E,): of the last step run. Both may be set.
    - ``success`` uint8 (E,): 0 no, 1 yes, 2 not reported; of the last step run.
    - ``steps`` int32 (E,): steps really run, 1 to K.
    - ``failed`` uint8 (E,): 1 where the environment raised, or returned something not finite,
      during this call. Its other rows of this call mean nothing then: zeros, ``steps`` too.
    - ``next_observations`` float64 (E, O): the observation to act on next: of the new episode
      where the old one ended, else the last one. ``reset`` writes only this one.
    """

    def __init__(
        self, env_count: int, segment_steps: int, observation_len: int, action_len: int
    ) -> None:
        self.observations = np.zeros((env_count, segment_steps + 1, observation_len))
        self.rewards = np.zeros((env_count, segment_steps))
        self.terminated = np.zeros(env_count, np.uint8)
        self.truncated = np.zeros(env_count, np.uint8)
        self.success = np.full(env_count, SUCCESS_NOT_REPORTED, np.uint8)
        self.steps = np.zeros(env_count, np.int32)
        self.failed = np.zeros(env_count, np.uint8)
        self.next_observations = np.zeros((env_count, observation_len))
        # What the caller hands in lies beside it, for the same reason: allocated once.
        self.actions = np.zeros((env_count, segment_steps, action_len))
        self.mask = np.zeros(env_count, np.uint8)
        self.seeds = np.zeros(env_count, np.uint64)


class GoalRows:
    """Steps with goals of their own, for :meth:`SegmentEnv.relabel`; allocated once.

    Only the first ``count[0]`` of M rows are used. ``achieved`` and ``desired`` float64 (M, G) are
    the caller's; ``rewards`` float64 (M,) and ``terminated`` uint8 (M,) the answer.
    """

    def __init__(self, rows_max: int, goal_len: int) -> None:
        self.count = np.zeros(1, np.uint64)
        self.achieved = np.zeros((rows_max, goal_len))
        self.desired = np.zeros((rows_max, goal_len))
        self.rewards = np.zeros(rows_max)
        self.terminated = np.zeros(rows_max, np.uint8)


class SegmentEnv(ABC):
    """E environments that step a whole segment in one call.

    Subclass this to bring a simulator that is faster than one Gymnasium environment after the
    other, and name it ``module:Class``; it is constructed as ``Class(env_count, segment_steps)``.

    An implementation keeps no reference to the buffers beyond a call, and writes every row of
    every array that the call is documented to write.
    """

    env_count: int
    segment_steps: int

    @abstractmethod
    def spec(self) -> EnvSpec:
        """Sizes, bounds and timing; the same for all E environments, constant."""

    @abstractmethod
    def reset(
        self, mask: NDArray[np.uint8], seeds: NDArray[np.uint64], out: SegmentBuffers
    ) -> None:
        """Starts a new episode in every environment whose ``mask`` is not zero.

        - ``mask`` uint8 (E,); ``seeds`` uint64 (E,): the same seed gives the same episode.
        - Writes the masked rows of ``out.next_observations``.
        - An environment that fails at this is made again and reset with the same seed.

        Raises:
            SegmentEnvError: it failed again.
        """

    @abstractmethod
    def step_segment(self, actions: NDArray[np.float64], out: SegmentBuffers) -> None:
        """Runs up to K steps in every environment and writes all of ``out``'s results.

        - ``actions`` float64 (E, K, A), in environment units.
        - An environment stops at its first terminated or truncated step. It is then reset at the
          end of this call, without a seed: its own random generator goes on, so a run depends on
          the first seeds alone. Thus the caller never has to reset between episodes.
        - An environment that raises or returns something not finite, in a step or in that reset,
          costs its own segment and nothing else. It is closed, made again and reset with
          :func:`seed_after_failure`; ``out.failed`` says so, and its row of
          ``out.next_observations`` begins the new episode. The others go on undisturbed.

        Raises:
            SegmentEnvError: it could not be made again. An implementation that cannot make its
                environments again may raise at the first failure: the worker then ends, and a
                new one is started.
        """

    def take_failures(self) -> list[str]:
        """Sentences about the failures since the last call.

        Each names id, environment index, step and cause, as those of :class:`SegmentEnvError`.
        """
        return []

    def goals(self) -> Goals:
        """Where the goals stand in an observation.

        Raises:
            NotGoalConditionedError: there are none, or their reward cannot be asked for.
        """
        raise NotGoalConditionedError(f"{self.spec()['id']}: its observation holds no goals")

    def relabel(self, rows: GoalRows) -> None:
        """Writes what steps would have been rewarded with, had other goals been wanted.

        For hindsight. Called at an episode's end with all its copies, and only where :meth:`goals`
        answers.
        """
        raise NotImplementedError

    def close(self) -> None:  # noqa: B027 - nothing to release is the usual case
        """Releases what the environments hold."""


def seed_after_failure(first_seed: int, failures: int) -> int:
    """The seed of an environment that was made again.

    The same failures lead to the same episodes, and no episode that led to a failure is repeated.

    - ``first_seed``: of the caller's last ``reset``; ``failures``: since then, this one included.
    - Returns 31 bits: some environments take no more.
    """
    return int(np.random.SeedSequence([first_seed, failures]).generate_state(1)[0]) >> 1


def make(task_id: str, env_count: int, segment_steps: int) -> SegmentEnv:
    """The environments of a task.

    - ``task_id``: a Gymnasium id, ``module:Id`` for one that ``module`` registers when imported,
      or ``module:name`` with a class that is a :class:`SegmentEnv`, a
      ``dmprl.mujoco_batch.MujocoTask`` or a ``gymnasium.Env``, or with a function that makes one of
      the last.
    """
    if env_count < 1 or segment_steps < 1:
        raise ValueError(f"{env_count} environments, {segment_steps} steps: both must be 1 or more")
    candidate = named_object(task_id)
    if isinstance(candidate, type) and issubclass(candidate, SegmentEnv):
        return candidate(env_count, segment_steps)
    batched = sys.modules.get("dmprl.mujoco_batch")  # imported by whoever subclasses its task
    if batched and isinstance(candidate, type) and issubclass(candidate, batched.MujocoTask):
        batched.quieten_mujoco()
        return candidate(env_count).batch(segment_steps, candidate.episode_steps)

    from dmprl.tasks import make_batch

    batch = make_batch(task_id.removeprefix("dmprl:"), env_count, segment_steps)
    if batch is not None:
        return batch

    from dmprl.gymnasium_env import GymnasiumSegmentEnv  # a SegmentEnv may do without Gymnasium

    return GymnasiumSegmentEnv(task_id, env_count, segment_steps, candidate)


def named_object(task_id: str) -> object:
    """What ``module:name`` names in that module; None without a module, or if it has no such."""
    module_name, _, name = task_id.rpartition(":")
    return getattr(_import(task_id, module_name), name, None) if module_name else None


def _import(task_id: str, module_name: str) -> ModuleType:
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise  # found, but something that it imports is missing
        extra = EXTRAS.get(module_name)
        raise ModuleNotFoundError(
            f"{task_id}: no module {error.name!r} among the installed packages or in the "
            "directories given with --python-path"
            + (
                f"; install it with: .venv/bin/python -m pip install './envs_py[{extra}]'"
                if extra
                else ""
            ),
            name=error.name,
        ) from None

"""Finds failures of single environments, for :class:`SegmentEnv` classes that can replace them."""

from __future__ import annotations

import traceback
from collections import deque

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dmprl.observation_names import names_of
from dmprl.segment_env import (
    OBSERVATION_NAMES_MAX,
    SUCCESS_NOT_REPORTED,
    SegmentBuffers,
    SegmentEnv,
    SegmentEnvError,
    seed_after_failure,
)

FAILURES_KEPT_MAX = 10_000
"""Maximum number of stored failure messages; the oldest are dropped."""

FAILURES = (Exception, SystemExit)
"""Exceptions of an environment. ``sys.exit`` would otherwise end the whole worker."""


class CheckedSegmentEnv(SegmentEnv):
    """Checks calls and results, clears the results of failed environments, and keeps messages.

    A subclass sets ``_observation_space``, the space before flattening, and calls
    :meth:`_allocate` when it knows the sizes.
    """

    _observation_space: spaces.Space

    def __init__(self, task_id: str, env_count: int, segment_steps: int) -> None:
        self.task_id = task_id
        self.env_count = env_count
        self.segment_steps = segment_steps
        # Seed of the caller's last reset of each environment, and its failures since.
        self._first_seeds = [0] * env_count
        self._failure_counts = [0] * env_count
        self._failed_now: list[int] = []
        self._failure_total = 0
        self._failures: deque[str] = deque(maxlen=FAILURES_KEPT_MAX)

    def _allocate(self, observation_len: int, action_space: spaces.Box) -> None:
        """Allocates arrays; ``action_space`` is that of one environment."""
        envs, steps = self.env_count, self.segment_steps
        self._observation_len = observation_len
        self._action_shape = (envs, steps, spaces.flatdim(action_space))
        self._action_dtype = action_space.dtype
        self._current = np.zeros((envs, observation_len))
        self._started = np.zeros(envs, np.bool_)
        self._rows = np.arange(envs)
        self._finite_observations = np.zeros((envs, steps + 1, observation_len), np.bool_)
        self._finite_rewards = np.zeros((envs, steps), np.bool_)

    def take_failures(self) -> list[str]:  # noqa: D102 - inherited
        failures = list(self._failures)
        self._failures.clear()
        return failures

    def _observation_names(self) -> list[str]:
        if self._observation_len > OBSERVATION_NAMES_MAX:
            return []
        return names_of(self._observation_space)

    def _typed(self, actions: NDArray[np.float64]) -> NDArray[np.floating]:
        """Checks a call of ``step_segment``; returns its actions in the space's type.

        The result is a new array for each call. An environment may keep an action, for example to
        penalise its change, so its memory must not be reused.
        """
        if not self._started.all():
            raise SegmentEnvError(
                f"{self.task_id}, environment {int(self._started.argmin())}: step before reset"
            )
        if actions.shape != self._action_shape:
            raise ValueError(f"actions {actions.shape}, expected (E, K, A) = {self._action_shape}")
        return actions.astype(self._action_dtype)

    def _check_finite(self, out: SegmentBuffers) -> None:
        """Checks a whole segment at once, which is several times faster than step by step."""
        if not np.isfinite(out.rewards, out=self._finite_rewards).all():
            for index in np.flatnonzero(~self._finite_rewards.all(axis=1)).tolist():
                step = int(self._finite_rewards[index].argmin())
                where = f"{self.task_id}, environment {index}, step {step} of the segment"
                reward = out.rewards[index, step]
                self._fail(index, SegmentEnvError(f"{where}: reward is {reward}"), out)
        if not np.isfinite(out.observations, out=self._finite_observations).all():
            for index in np.flatnonzero(~self._finite_observations.all(axis=(1, 2))).tolist():
                row = int(self._finite_observations[index].all(axis=1).argmin())
                when = f"step {row - 1} of the segment"
                self._fail(index, self._not_finite(index, when, out.observations[index, row]), out)

    def _fail(self, index: int, failure: SegmentEnvError, out: SegmentBuffers) -> None:
        """Clears the results of a failed environment; the subclass replaces it later."""
        self._note(failure)
        self._failed_now.append(index)
        out.failed[index] = 1
        out.observations[index] = 0.0
        out.rewards[index] = 0.0
        out.terminated[index], out.truncated[index] = 0, 0
        out.success[index], out.steps[index] = SUCCESS_NOT_REPORTED, 0

    def _note(self, failure: SegmentEnvError) -> None:
        self._failures.append(str(failure))
        self._failure_total += 1
        # Only some tracebacks go to the worker's log: they are long and mostly identical.
        if failure.__cause__ is not None and self._failure_total.bit_count() == 1:
            traceback.print_exception(failure.__cause__)

    def _seed_after_failure(self, index: int) -> int:
        """Counts a failure and returns the seed of the episode after it."""
        self._failure_counts[index] += 1
        return seed_after_failure(self._first_seeds[index], self._failure_counts[index])

    def _not_finite(self, index: int, when: str, row: NDArray[np.float64]) -> SegmentEnvError:
        entry = int(np.flatnonzero(~np.isfinite(row))[0])
        name = names_of(self._observation_space)[entry]
        where = f"{self.task_id}, environment {index}, {when}"
        return SegmentEnvError(f"{where}: {name} is {row[entry]}")

    def _failure(self, index: int, when: str, error: BaseException) -> SegmentEnvError:
        failure = SegmentEnvError(
            f"{self.task_id}, environment {index}, {when}: {type(error).__name__}: {error}"
        )
        failure.__cause__ = error
        return failure

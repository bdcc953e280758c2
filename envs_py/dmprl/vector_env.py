"""Wraps a ``gymnasium.vector.VectorEnv`` as a :class:`~dmprl.segment_env.SegmentEnv`.

A vector environment steps all its environments together. So one that ends within a segment is
stepped on until the segment is over. Those idle steps belong to an episode that is discarded: their
results are ignored, and a reset with a mask then starts the real next episode. This is the same in
all autoreset modes. That reset has a seed, because the idle steps have advanced the environment's
random generator.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from dmprl import robotics_repair
from dmprl.checked_env import FAILURES, CheckedSegmentEnv
from dmprl.env_options import NO_OPTIONS, EnvOptions, RandomiseError
from dmprl.flat_spaces import check_spaces, flat_rows
from dmprl.goal_rule import GoalRule
from dmprl.gymnasium_env import success_of
from dmprl.hindsight import GymnasiumGoals, attribute_of, declared_rule
from dmprl.segment_env import (
    EnvSpec,
    GoalRows,
    Goals,
    SegmentBuffers,
    SegmentEnvError,
    seed_of_episode,
)

EXPECTED = (
    "expected a vector environment that takes one seed for each environment, reset(seed=[...]), "
    "and resets only those of options={'reset_mask': mask}, as SyncVectorEnv and AsyncVectorEnv do"
)


class UnsupportedVectorEnvError(TypeError):
    """Raised if a vector environment cannot be run in segments. The message has the remedy."""


class VectorSegmentEnv(CheckedSegmentEnv):
    """The environments of one ``VectorEnv``, in any autoreset mode.

    - ``named``: creates the vector environment, as ``named(num_envs=E, **options.kwargs)``.

    Differences from other environments: the episodes after the first start with
    :func:`~dmprl.segment_env.seed_of_episode`; an exception is a failure of all E environments,
    because it does not tell which of them raised it, and all are recreated; one that returns NaN or
    infinity is reset, not recreated; and a failure in a :meth:`reset` of only some is permanent.

    Raises:
        UnsupportedVectorEnvError: if the vector environment does not fit; it is tried once.
    """

    def __init__(
        self,
        task_id: str,
        env_count: int,
        segment_steps: int,
        named: Callable[..., VectorEnv],
        options: EnvOptions = NO_OPTIONS,
    ) -> None:
        super().__init__(task_id, env_count, segment_steps)
        key = options.randomise.of_model()
        if key:
            reason = "its environments are stepped together, with models of their own"
            raise RandomiseError.of(key, task_id, reason)
        self.options = options
        self._named = named
        # An AsyncVectorEnv has its environments in other processes, so one more describes them.
        self._sample: gymnasium.Env | None = None
        if "gymnasium_robotics" in sys.modules:
            robotics_repair.repair()
        self._env = self._make()
        if "mujoco" in sys.modules:
            from dmprl import mujoco_warnings

            mujoco_warnings.to_standard_error()
        try:
            self._prepare()
        except BaseException:
            self.close()
            raise

    def _make(self) -> VectorEnv:
        env = self._named(num_envs=self.env_count, **self.options.kwargs)
        if not isinstance(env, VectorEnv):
            raise UnsupportedVectorEnvError(
                f"{self.task_id} has a parameter num_envs, but returned {type(env).__name__}; "
                "expected a gymnasium.vector.VectorEnv"
            )
        return env

    def _prepare(self) -> None:
        env = self._env
        if env.num_envs != self.env_count:
            raise self._unsupported(
                f"it has {env.num_envs} environments; expected num_envs = {self.env_count}"
            )
        self._mode = self._autoreset_mode()
        self._observation_space = env.single_observation_space
        self._action_space = env.single_action_space
        check_spaces(self._observation_space, self._action_space, self.task_id)
        self._allocate(spaces.flatdim(self._observation_space), self._action_space)
        low, high = self._action_space.low, self._action_space.high
        self._idle = np.clip(np.zeros_like(low), low, high)
        self._episodes = np.zeros(self.env_count, np.int64)
        self._at = "reset"
        self._goals: GymnasiumGoals | None = None
        self._try()
        if isinstance(env.unwrapped, AsyncVectorEnv):
            self._sample = env.unwrapped.env_fns[0]()

    def _autoreset_mode(self) -> AutoresetMode:
        declared = self._env.metadata.get("autoreset_mode")
        try:
            mode = AutoresetMode(declared)
        except ValueError:
            raise self._unsupported(
                f"metadata['autoreset_mode'] is {declared!r}; expected an AutoresetMode, such as "
                "AutoresetMode.DISABLED for environments that only a reset starts again"
            ) from None
        inner = self._env.unwrapped
        if (
            mode is AutoresetMode.NEXT_STEP
            and isinstance(inner, AsyncVectorEnv)
            and not inner.shared_memory
        ):
            # Its reset does not cancel the one that the next step is due.
            raise self._unsupported(
                "an AsyncVectorEnv without shared memory ignores the first action after a reset "
                "with a mask; pass autoreset_mode=AutoresetMode.DISABLED, or shared_memory=True"
            )
        return mode

    def _try(self) -> None:
        """Checks that a reset with a mask and a seed is exact, and changes no other environment."""
        seeds = list(range(self.env_count))
        first_only = np.arange(self.env_count) == 0
        try:
            self._masked_reset(np.ones(self.env_count, np.bool_), seeds)
            start = self._current[0].copy()
            # An action that moves, unlike the idle one, but is not extreme.
            action = self._idle + (self._action_space.high - self._idle) / 2
            actions = np.stack([action] * self.env_count)
            before = flat_rows(self._observation_space, self._env.step(actions)[0])
            after = self._masked_reset(first_only, seeds)
        except FAILURES as error:
            raise self._unsupported(
                f"it failed when it was tried: {type(error).__name__}: {error}; {EXPECTED}"
            ) from error
        if not np.allclose(self._current[0], start, equal_nan=True):
            raise self._unsupported(f"two resets with the same seed differ; {EXPECTED}")
        if not np.array_equal(after[1:], before[1:], equal_nan=True):
            raise self._unsupported(
                f"a reset of environment 0 changed the observation of another one; {EXPECTED}"
            )
        self._started[:] = False

    def spec(self) -> EnvSpec:  # noqa: D102 - inherited
        env = self._one()
        control_dt_s = getattr(env.unwrapped, "dt", 0.0)
        limit = env.spec.max_episode_steps if env.spec else None
        return {
            "id": self.task_id,
            "observation_len": self._observation_len,
            "action_len": self._action_shape[2],
            "action_low": self._action_space.low.ravel().astype(np.float64).tolist(),
            "action_high": self._action_space.high.ravel().astype(np.float64).tolist(),
            "control_dt_s": float(control_dt_s) if np.isscalar(control_dt_s) else 0.0,
            "episode_steps": int(limit or attribute_of(env, "max_episode_steps") or 0),
            "observation_names": self._observation_names(),
        }

    def _one(self) -> gymnasium.Env | VectorEnv:
        """Returns what describes an environment: one of them if possible, else the vector."""
        inner = self._env.unwrapped
        if isinstance(inner, SyncVectorEnv):
            return inner.envs[0]
        return self._sample or self._env

    def reset(  # noqa: D102 - inherited
        self, mask: NDArray[np.uint8], seeds: NDArray[np.uint64], out: SegmentBuffers
    ) -> None:
        chosen = mask != 0
        for index in np.flatnonzero(chosen).tolist():
            self._first_seeds[index], self._failure_counts[index] = int(seeds[index]), 0
        self._episodes[chosen] = 0
        try:
            self._begin(chosen, self._first_seeds)
        except SegmentEnvError as failure:
            if not chosen.all():
                raise
            self._note(failure)
            self._recreate()
            self._begin(chosen, self._first_seeds)
        out.next_observations[chosen] = self._current[chosen]

    def step_segment(  # noqa: D102 - inherited
        self, actions: NDArray[np.float64], out: SegmentBuffers
    ) -> None:
        actions = self._typed(actions).reshape(*self._action_shape[:2], *self._action_space.shape)
        for results in (out.observations, out.rewards, out.terminated, out.truncated, out.failed):
            results.fill(0)
        out.observations[:, 0] = self._current
        try:
            ended = self._run(actions, out)
            self._check_finite(out)
            self._current[:] = out.observations[self._rows, out.steps]
            self._begin_next(ended & (out.failed == 0), out)
        except UnsupportedVectorEnvError:
            raise
        except FAILURES as error:
            self._fail_all(error, out)
        out.next_observations[:] = self._current

    def _run(self, actions: NDArray[np.floating], out: SegmentBuffers) -> NDArray[np.bool_]:
        """Steps all environments to the end of the segment; returns whose episode has ended."""
        env, running = self._env, np.ones(self.env_count, np.bool_)
        for step in range(self.segment_steps):
            self._at = f"step {step} of the segment"
            given = actions[:, step].copy()
            given[~running] = self._idle
            observations, rewards, terminated, truncated, infos = env.step(given)
            terminated, truncated = np.asarray(terminated, bool), np.asarray(truncated, bool)
            over = terminated | truncated
            ended = running & over
            rows = flat_rows(self._observation_space, observations)
            if ended.any() and self._mode is AutoresetMode.SAME_STEP:
                self._take_final(rows, infos, ended)
            out.observations[running, step + 1] = rows[running]
            out.rewards[running, step] = np.asarray(rewards)[running]
            out.steps[running] = step + 1
            out.terminated[ended], out.truncated[ended] = terminated[ended], truncated[ended]
            is_last = step + 1 == self.segment_steps
            self._note_success(running if is_last else ended, ended, infos, out)
            running &= ~over
            if is_last or not running.any():
                break
            if over.any() and self._mode is AutoresetMode.DISABLED:
                # It must not be stepped before. The reset that counts follows the segment.
                env.reset(options={"reset_mask": over})
        return ~running

    def _take_final(
        self, rows: NDArray[np.float64], infos: dict[str, Any], ended: NDArray[np.bool_]
    ) -> None:
        """Replaces the first observations of new episodes by the final ones of those before."""
        final = infos.get("final_obs")
        if final is None:
            raise self._unsupported(
                "it resets environments in the step that ends an episode, but its infos have no "
                "'final_obs'; add it, or construct it with autoreset_mode=AutoresetMode.DISABLED"
            )
        if isinstance(final, np.ndarray) and final.dtype == np.object_:
            for index in np.flatnonzero(ended).tolist():
                rows[index] = spaces.flatten(self._observation_space, final[index])
        else:
            rows[ended] = flat_rows(self._observation_space, final)[ended]

    def _note_success(
        self,
        of: NDArray[np.bool_],
        ended: NDArray[np.bool_],
        infos: dict[str, Any],
        out: SegmentBuffers,
    ) -> None:
        final = infos.get("final_info", {}) if self._mode is AutoresetMode.SAME_STEP else infos
        for index in np.flatnonzero(of).tolist():
            out.success[index] = success_of(info_of(final if ended[index] else infos, index))

    def _begin_next(self, ended: NDArray[np.bool_], out: SegmentBuffers) -> None:
        """Starts the episodes after those that ended, and after failures."""
        if ended.any():
            self._at = "reset"
            self._episodes[ended] += 1
            self._masked_reset(
                ended, list(map(seed_of_episode, self._first_seeds, self._episodes.tolist()))
            )
            for index in self._not_finite_starts(ended):
                self._fail(index, self._not_finite(index, "reset", self._current[index]), out)
        if self._failed_now:
            self._begin_after_failures()

    def _begin_after_failures(self) -> None:
        self._at = "reset"
        failed, seeds = np.zeros(self.env_count, np.bool_), list(self._first_seeds)
        for index in self._failed_now:
            failed[index], seeds[index] = True, self._seed_after_failure(index)
        self._failed_now.clear()
        self._begin(failed, seeds)

    def _fail_all(self, error: BaseException, out: SegmentBuffers) -> None:
        """Recreates all environments after an exception, which does not name one of them."""
        for index in np.flatnonzero(out.failed == 0).tolist():
            self._fail(index, self._failure(index, self._at, error), out)
        self._failed_now[:] = range(self.env_count)
        self._recreate()
        self._begin_after_failures()

    def _recreate(self) -> None:
        # The processes of an AsyncVectorEnv may not answer any more.
        kills = isinstance(self._env.unwrapped, AsyncVectorEnv)
        with contextlib.suppress(*FAILURES):
            self._env.close(**({"terminate": True} if kills else {}))
        try:
            self._env = self._make()
        except FAILURES as failure:
            raise self._failure(0, "recreated after a failure", failure) from failure

    def _begin(self, chosen: NDArray[np.bool_], seeds: list[int]) -> None:
        """Starts episodes; a failure is permanent."""
        try:
            self._masked_reset(chosen, seeds)
        except FAILURES as error:
            raise self._failure(int(chosen.argmax()), "reset", error) from error
        for index in self._not_finite_starts(chosen):
            raise self._not_finite(index, "reset", self._current[index])

    def _masked_reset(self, chosen: NDArray[np.bool_], seeds: list[int]) -> NDArray[np.float64]:
        """Resets the chosen environments; returns the observations of all."""
        given = [seed if start else None for seed, start in zip(seeds, chosen, strict=True)]
        observations, _ = self._env.reset(seed=given, options={"reset_mask": chosen.copy()})
        rows = flat_rows(self._observation_space, observations)
        self._current[chosen] = rows[chosen]
        self._started |= chosen
        return rows

    def _not_finite_starts(self, chosen: NDArray[np.bool_]) -> list[int]:
        return np.flatnonzero(chosen & ~np.isfinite(self._current).all(axis=1)).tolist()

    def goals(self) -> Goals:  # noqa: D102 - inherited
        self._goals = GymnasiumGoals(self.task_id, self._one(), self._observation_space)
        return self._goals.goals

    def relabel(self, rows: GoalRows) -> None:  # noqa: D102 - inherited
        self._goals.relabel(self._one(), rows)

    def goal_rule(self) -> GoalRule | None:
        """Returns the environment's own ``goal_rule``, an attribute or a method, or finds one."""
        return declared_rule(self._one(), super().goal_rule)

    def close(self) -> None:  # noqa: D102 - inherited
        self._env.close()
        if self._sample is not None:
            self._sample.close()

    def _unsupported(self, reason: str) -> UnsupportedVectorEnvError:
        return UnsupportedVectorEnvError(f"{self.task_id}: {reason}")


def info_of(infos: dict[str, Any], index: int) -> dict[str, Any]:
    """Returns the success that the infos of a vector environment have for one environment.

    The optional mask ``_key`` marks the environments that have reported ``key``.
    """
    return {
        key: infos[key][index]
        for key in ("is_success", "success")
        if key in infos and infos.get(f"_{key}", np.ones(index + 1, np.bool_))[index]
    }

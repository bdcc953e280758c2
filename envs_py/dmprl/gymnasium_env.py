"""Wraps any Gymnasium environment as a :class:`~dmprl.segment_env.SegmentEnv`.

The environments of a worker are stepped one after the other, in one thread. MuJoCo releases the GIL
in ``mj_step``, so threads could run their physics in parallel. But the worker processes already use
all cores, and half of a step is Python code, which threads cannot run in parallel.
"""

from __future__ import annotations

import contextlib
import copy
import math
import sys
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import gymnasium
import numpy as np
from gymnasium.envs import registration
from numpy.typing import NDArray

from dmprl import robotics_repair
from dmprl.checked_env import FAILURES, CheckedSegmentEnv
from dmprl.env_options import NO_OPTIONS, EnvOptions
from dmprl.flat_spaces import flattened
from dmprl.goal_rule import GoalRule
from dmprl.hindsight import GymnasiumGoals, declared_rule
from dmprl.segment_env import (
    SUCCESS_NO,
    SUCCESS_NOT_REPORTED,
    SUCCESS_YES,
    EnvSpec,
    GoalRows,
    Goals,
    SegmentBuffers,
    SegmentEnvError,
    named_object,
)


class GymnasiumSegmentEnv(CheckedSegmentEnv):
    """E copies of one Gymnasium environment, with all wrappers of its registration except two.

    The passive checker and the order enforcer are omitted: they only check the caller, which costs
    time in every step, and :meth:`step_segment` checks the order itself.

    - ``named``: the object that ``task_id`` names if it is ``module:Name``. The optional attribute
      ``max_episode_steps`` of a class or function limits its episodes.
    - ``options``: arguments of ``gymnasium.make``, and wrappers, which are applied to its result
      and thus outside the time limit, and what each episode draws anew, except delays.
    """

    def __init__(
        self,
        task_id: str,
        env_count: int,
        segment_steps: int,
        named: object = None,
        options: EnvOptions = NO_OPTIONS,
    ) -> None:
        super().__init__(task_id, env_count, segment_steps)
        self.options = options
        self._registered = self._registration(named)
        if "mujoco" in sys.modules:
            from dmprl import mujoco_warnings

            mujoco_warnings.to_standard_error()
        self._observation_space = None
        self._goals: GymnasiumGoals | None = None
        self._envs = [self._make() for _ in range(env_count)]
        first = self._envs[0]
        self._allocate(first.observation_space.shape[0], first.action_space)

    def _registration(self, named: object) -> registration.EnvSpec:
        if "gymnasium_robotics" in sys.modules:
            robotics_repair.repair()
        is_class = isinstance(named, type)
        if issubclass(named, gymnasium.Env) if is_class else callable(named):
            limit = getattr(named, "max_episode_steps", None)
            return registration.EnvSpec(
                self.task_id,
                entry_point=named,
                max_episode_steps=limit if isinstance(limit, int) and limit > 0 else None,
                order_enforce=False,
            )
        registered = gymnasium.registry.get(self.task_id.rpartition(":")[2])
        if registered is None:  # an id without a version, or an unknown one
            env = self._make_unregistered()
            registered = gymnasium.registry[env.unwrapped.spec.id]
            env.close()
        registered = copy.copy(registered)
        registered.order_enforce = False
        if isinstance(registered.entry_point, str):
            registration.load_env_creator(registered.entry_point)  # imports its module
        return registered

    def _make_unregistered(self) -> gymnasium.Env:
        try:
            return gymnasium.make(self.task_id, **self.options.kwargs)
        except gymnasium.error.UnregisteredEnv as error:
            module, _, name = self.task_id.rpartition(":")
            if not module:
                raise gymnasium.error.NameNotFound(
                    f"{error} If a package registers it, name the package: PACKAGE:{name}, such as "
                    "gymnasium_robotics:FetchPush-v4 after `dmprl env add gymnasium-robotics`"
                ) from None
            raise gymnasium.error.NameNotFound(
                f"{self.task_id}: the module {module} exists, but has no class or function {name} "
                f"and registers no environment with that name ({error})"
            ) from None

    def _make(self, more: Mapping[str, object] = MappingProxyType({})) -> gymnasium.Env:
        """Creates an environment; ``more`` are arguments that take precedence."""
        kwargs = {**self.options.kwargs, **more}
        env = gymnasium.make(self._registered, disable_env_checker=True, **kwargs)
        if self.options.randomise.of_model():
            from dmprl.randomised_env import randomised_env  # imports MuJoCo

            env = randomised_env(env, self.options.randomise)
        env = wrapped(env, self.options.wrappers)
        self._observation_space = env.observation_space
        return flattened(env, self.task_id)

    def spec(self) -> EnvSpec:  # noqa: D102 - inherited
        env = self._envs[0]
        control_dt_s = getattr(env.unwrapped, "dt", 0.0)
        return {
            "id": self.task_id,
            "observation_len": self._observation_len,
            "action_len": env.action_space.shape[0],
            "action_low": env.action_space.low.astype(np.float64).tolist(),
            "action_high": env.action_space.high.astype(np.float64).tolist(),
            "control_dt_s": float(control_dt_s) if np.isscalar(control_dt_s) else 0.0,
            "episode_steps": (env.spec.max_episode_steps if env.spec else None) or 0,
            "observation_names": self._observation_names(),
        }

    def reset(  # noqa: D102 - inherited
        self, mask: NDArray[np.uint8], seeds: NDArray[np.uint64], out: SegmentBuffers
    ) -> None:
        for index in np.flatnonzero(mask).tolist():
            seed = int(seeds[index])
            self._first_seeds[index], self._failure_counts[index] = seed, 0
            try:
                self._reset(index, seed, out)
            except SegmentEnvError as failure:
                self._note(failure)
                self._replace(index, seed, out)

    def step_segment(  # noqa: D102 - inherited
        self, actions: NDArray[np.float64], out: SegmentBuffers
    ) -> None:
        actions = self._typed(actions)
        out.failed.fill(0)
        out.observations[:, 0] = self._current
        for index, env in enumerate(self._envs):
            self._run(index, env, actions[index], out)
        self._check_finite(out)
        self._current[:] = out.observations[self._rows, out.steps]
        out.next_observations[:] = self._current
        for index in np.flatnonzero(out.terminated | out.truncated).tolist():
            try:
                self._reset(index, None, out)
            except SegmentEnvError as failure:
                self._fail(index, failure, out)
        # Last, so that new environments cannot affect the results of the others.
        while self._failed_now:
            index = self._failed_now.pop(0)
            self._replace(index, self._seed_after_failure(index), out)

    def goals(self) -> Goals:  # noqa: D102 - inherited
        self._goals = GymnasiumGoals(self.task_id, self._envs[0], self._observation_space)
        return self._goals.goals

    def relabel(self, rows: GoalRows) -> None:  # noqa: D102 - inherited
        self._goals.relabel(self._envs[0], rows)

    def goal_rule(self) -> GoalRule | None:
        """Returns the environment's own ``goal_rule``, an attribute or a method, or finds one."""
        return declared_rule(self._envs[0], super().goal_rule)

    def close(self) -> None:  # noqa: D102 - inherited
        for env in self._envs:
            env.close()

    def _run(
        self, index: int, env: gymnasium.Env, actions: NDArray[np.floating], out: SegmentBuffers
    ) -> None:
        """Steps one environment to the end of the segment or of its episode."""
        observations, rewards = out.observations[index], out.rewards[index]
        env_step = env.step
        step = 0
        try:
            for action in actions:
                observation, reward, terminated, truncated, info = env_step(action)
                rewards[step] = reward
                observations[step + 1] = observation
                step += 1
                if terminated or truncated:
                    break
            out.success[index] = success_of(info)
        except FAILURES as error:
            self._fail(index, self._failure(index, f"step {step} of the segment", error), out)
            return
        if step < self.segment_steps:
            observations[step + 1 :] = 0.0
            rewards[step:] = 0.0
        out.steps[index] = step
        out.terminated[index] = bool(terminated)
        out.truncated[index] = bool(truncated)

    def _reset(self, index: int, seed: int | None, out: SegmentBuffers) -> None:
        try:
            self._current[index], _ = self._envs[index].reset(seed=seed)
        except FAILURES as error:
            raise self._failure(index, "reset", error) from error
        if not np.isfinite(self._current[index]).all():
            raise self._not_finite(index, "reset", self._current[index])
        self._started[index] = True
        out.next_observations[index] = self._current[index]

    def _replace(self, index: int, seed: int, out: SegmentBuffers) -> None:
        """Closes a failed environment, recreates it and resets it."""
        with contextlib.suppress(*FAILURES):  # it has failed already
            self._envs[index].close()
        try:
            self._envs[index] = self._make()
        except FAILURES as error:
            raise self._failure(index, "recreated after a failure", error) from error
        self._reset(index, seed, out)


def wrapped(env: gymnasium.Env, names: Sequence[str]) -> gymnasium.Env:
    """Applies wrappers by name (``module:name``), the innermost first."""
    for name in names:
        wrapper = named_object(name)
        if not callable(wrapper):
            module, _, word = name.rpartition(":")
            raise AttributeError(f"the module {module} has no class or function {word}")
        env = wrapper(env)
        if not isinstance(env, gymnasium.Env):
            raise TypeError(f"{name} returned {type(env).__name__}; expected a gymnasium.Env")
    return env


def success_of(info: dict) -> int:
    """Converts ``info["is_success"]`` or ``info["success"]`` for ``SegmentBuffers.success``."""
    success = info.get("is_success", info.get("success"))
    if success is None or math.isnan(success):
        return SUCCESS_NOT_REPORTED
    return SUCCESS_YES if success else SUCCESS_NO

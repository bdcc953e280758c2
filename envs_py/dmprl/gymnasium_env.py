"""Any Gymnasium environment as a :class:`~dmprl.segment_env.SegmentEnv`.

The environments of a worker step one after the other in one thread. MuJoCo releases the GIL inside
``mj_step``, so threads could overlap their physics; but a machine's cores are already filled with
workers, each a process of its own, and half of a step is Python that threads cannot overlap.
"""

from __future__ import annotations

import copy
import math
import sys

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dmprl import robotics_repair
from dmprl.segment_env import (
    SUCCESS_NO,
    SUCCESS_NOT_REPORTED,
    SUCCESS_YES,
    EnvSpec,
    SegmentBuffers,
    SegmentEnv,
    SegmentEnvError,
    UnsupportedSpaceError,
)

SUPPORTED_SPACES = (
    "supported are a Box observation with one dimension (or a Dict or Tuple that Gymnasium can "
    "flatten) and a bounded Box action of floats with one dimension"
)


class GymnasiumSegmentEnv(SegmentEnv):
    """E copies of one Gymnasium environment, all wrappers of its registration applied.

    Two wrappers are left out because they only check the caller and cost time in every step: the
    passive checker and the order enforcer (:meth:`step_segment` checks the order itself).
    """

    def __init__(self, task_id: str, env_count: int, segment_steps: int) -> None:
        self.task_id = task_id
        self.env_count = env_count
        self.segment_steps = segment_steps
        registered = self._registration()
        self._envs = [self._make(registered) for _ in range(env_count)]
        first = self._envs[0]
        self._observation_len = first.observation_space.shape[0]
        self._action_shape = (env_count, segment_steps, first.action_space.shape[0])
        self._action_dtype = first.action_space.dtype
        self._current = np.zeros((env_count, self._observation_len))
        self._started = np.zeros(env_count, np.bool_)
        self._rows = np.arange(env_count)
        self._finite_observations = np.zeros(
            (env_count, segment_steps + 1, self._observation_len), np.bool_
        )
        self._finite_rewards = np.zeros((env_count, segment_steps), np.bool_)

    def _registration(self) -> gymnasium.envs.registration.EnvSpec:
        if "gymnasium_robotics" in sys.modules:
            robotics_repair.repair()
        registered = gymnasium.registry.get(self.task_id.rpartition(":")[2])
        if registered is None:  # without version, or unknown: Gymnasium finds it, or suggests
            made = gymnasium.make(self.task_id)
            registered = gymnasium.registry[made.unwrapped.spec.id]
            made.close()
        registered = copy.copy(registered)
        registered.order_enforce = False
        return registered

    def _make(self, registered: gymnasium.envs.registration.EnvSpec) -> gymnasium.Env:
        env = gymnasium.make(registered, disable_env_checker=True)
        observation, action = env.observation_space, env.action_space
        if isinstance(observation, spaces.Dict | spaces.Tuple) and observation.is_np_flattenable:
            # A Dict's entries in the order of its space, which Gymnasium sorts by key.
            env = gymnasium.wrappers.FlattenObservation(env)
            observation = env.observation_space
        if not isinstance(observation, spaces.Box) or len(observation.shape) != 1:
            raise UnsupportedSpaceError(
                f"{self.task_id}: observation space {observation}; {SUPPORTED_SPACES}"
            )
        if (
            not isinstance(action, spaces.Box)
            or len(action.shape) != 1
            or not np.issubdtype(action.dtype, np.floating)
            or not action.is_bounded("both")
        ):
            raise UnsupportedSpaceError(
                f"{self.task_id}: action space {action}; {SUPPORTED_SPACES}"
            )
        return env

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
        }

    def reset(  # noqa: D102 - inherited
        self, mask: NDArray[np.uint8], seeds: NDArray[np.uint64], out: SegmentBuffers
    ) -> None:
        for index in np.flatnonzero(mask).tolist():
            self._reset(index, int(seeds[index]), out)

    def step_segment(  # noqa: D102 - inherited
        self, actions: NDArray[np.float64], out: SegmentBuffers
    ) -> None:
        if not self._started.all():
            raise SegmentEnvError(
                f"{self.task_id}, environment {int(self._started.argmin())}: step before reset"
            )
        if actions.shape != self._action_shape:
            raise ValueError(f"actions {actions.shape}, expected (E, K, A) = {self._action_shape}")
        # A new array each time, in the space's own type: an environment may keep an action
        # (to charge for its change, say), so its memory must not be used again.
        actions = actions.astype(self._action_dtype)
        out.observations[:, 0] = self._current
        for index, env in enumerate(self._envs):
            self._run(index, env, actions[index], out)
        self._check_finite(out)
        self._current[:] = out.observations[self._rows, out.steps]
        out.next_observations[:] = self._current
        for index in np.flatnonzero(out.terminated | out.truncated).tolist():
            self._reset(index, None, out)

    def close(self) -> None:  # noqa: D102 - inherited
        for env in self._envs:
            env.close()

    def _run(
        self, index: int, env: gymnasium.Env, actions: NDArray[np.floating], out: SegmentBuffers
    ) -> None:
        """Steps one environment up to the end of the segment or of its episode."""
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
        except Exception as error:
            raise self._failure(index, f"step {step} of the segment", error) from error
        if step < self.segment_steps:
            observations[step + 1 :] = 0.0
            rewards[step:] = 0.0
        out.steps[index] = step
        out.terminated[index] = bool(terminated)
        out.truncated[index] = bool(truncated)
        out.success[index] = success_of(info)

    def _reset(self, index: int, seed: int | None, out: SegmentBuffers) -> None:
        try:
            self._current[index], _ = self._envs[index].reset(seed=seed)
        except Exception as error:
            raise self._failure(index, "reset", error) from error
        if not np.isfinite(self._current[index]).all():
            self._raise_not_finite(index, "reset", self._current[index])
        self._started[index] = True
        out.next_observations[index] = self._current[index]

    def _check_finite(self, out: SegmentBuffers) -> None:
        """Looks at the whole segment at once: step by step it would cost several times as much."""
        if not np.isfinite(out.rewards, out=self._finite_rewards).all():
            index, step = np.argwhere(~self._finite_rewards)[0].tolist()
            reward = out.rewards[index, step]
            where = f"{self.task_id}, environment {index}, step {step} of the segment"
            raise SegmentEnvError(f"{where}: reward is {reward}")
        if not np.isfinite(out.observations, out=self._finite_observations).all():
            index, row, _ = np.argwhere(~self._finite_observations)[0].tolist()
            self._raise_not_finite(
                index, f"step {row - 1} of the segment", out.observations[index, row]
            )

    def _raise_not_finite(self, index: int, when: str, row: NDArray[np.float64]) -> None:
        entry = int(np.flatnonzero(~np.isfinite(row))[0])
        where = f"{self.task_id}, environment {index}, {when}"
        raise SegmentEnvError(f"{where}: observation[{entry}] is {row[entry]}")

    def _failure(self, index: int, when: str, error: Exception) -> SegmentEnvError:
        return SegmentEnvError(
            f"{self.task_id}, environment {index}, {when}: {type(error).__name__}: {error}"
        )


def success_of(info: dict) -> int:
    """``info["is_success"]`` or ``info["success"]`` as a value of ``SegmentBuffers.success``."""
    success = info.get("is_success", info.get("success"))
    if success is None or (isinstance(success, float) and math.isnan(success)):
        return SUCCESS_NOT_REPORTED
    return SUCCESS_YES if success else SUCCESS_NO

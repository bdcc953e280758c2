"""Goals in the observations of a Gymnasium environment, and rewards for other goals.

Hindsight experience replay (Andrychowicz et al. 2017) stores copies of an episode with other goals.
Only the environment can compute the rewards for them, with the method ``compute_reward`` that
Gymnasium-Robotics and panda-gym introduced.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dmprl.goal_rule import GoalRule
from dmprl.segment_env import GoalRows, Goals, NotGoalConditionedError

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    AnyEnv = gymnasium.Env | VectorEnv

PROBES = 32
"""Pairs of goals for testing ``compute_reward`` before use."""


class GymnasiumGoals:
    """The goals of one kind of environment, independent of its instances.

    - ``env``: an environment with a ``Dict`` observation, or any wrapper around it; or a vector
      environment that has the methods itself.
    - ``space``: that ``Dict``, of one environment.

    Raises:
        NotGoalConditionedError: if the observation has no goals, or rewards for other goals are
            unavailable.
    """

    def __init__(self, task_id: str, env: AnyEnv, space: spaces.Space) -> None:
        self._task_id = task_id
        achieved, desired = self._spaces(space)
        length, self._shape = spaces.flatdim(achieved), achieved.shape
        self._dtypes = achieved.dtype, desired.dtype
        first = self._first_entries(space)
        self.goals: Goals = {
            "achieved": first["achieved_goal"],
            "desired": first["desired_goal"],
            "length": length,
            "sparse": self._is_sparse(env, achieved, desired),
        }

    def relabel(self, env: AnyEnv, rows: GoalRows) -> None:
        """Implements :meth:`SegmentEnv.relabel` with ``env``."""
        count = int(rows.count[0])
        achieved, desired = self._shaped(rows.achieved[:count], rows.desired[:count])
        infos = [{} for _ in range(count)]  # only the goals are known here
        rows.rewards[:count] = self._rewards(env, achieved, desired, infos)
        rows.terminated[:count] = terminated_at(env, achieved, desired)

    def _spaces(self, space: spaces.Space) -> tuple[spaces.Box, spaces.Box]:
        if not isinstance(space, spaces.Dict):
            raise self._refused(f"its observation is not a Dict, but {space}")
        found = []
        for name in ("achieved_goal", "desired_goal"):
            part = space.spaces.get(name)
            if not isinstance(part, spaces.Box):
                raise self._refused(f"its observation has no Box named {name}: {space}")
            found.append(part)
        if found[0].shape != found[1].shape:
            raise self._refused(f"its goals have different shapes: {found[0]}, {found[1]}")
        return found[0], found[1]

    def _first_entries(self, space: spaces.Dict) -> dict[str, int]:
        """Computes the index of each entry of the Dict in the flattened observation."""
        first, at = {}, 0
        for name, part in space.spaces.items():
            first[name] = at
            at += spaces.flatdim(part)
        return first

    def _is_sparse(self, env: AnyEnv, achieved: spaces.Box, desired: spaces.Box) -> bool:
        """Returns whether the reward is sparse, after checking that it can be computed.

        A reward by distance differs for random pairs; one by threshold has at most two values.
        """
        if attribute_of(env, "compute_reward") is None:
            raise self._refused(
                "it has no method compute_reward(achieved_goal, desired_goal, info)"
            )
        drawn = []
        for seed, space in enumerate((achieved, desired)):
            space = copy.deepcopy(space)  # the space's random state must not change
            space.seed(seed)
            drawn.append(np.stack([space.sample() for _ in range(PROBES)]))
        rewards = self._rewards(env, *drawn, [{} for _ in range(PROBES)])
        return len(np.unique(rewards)) <= 2

    def _rewards(
        self, env: AnyEnv, achieved: NDArray, desired: NDArray, infos: list[dict]
    ) -> NDArray:
        rewards = np.asarray(attribute_of(env, "compute_reward")(achieved, desired, infos))
        if rewards.shape != (len(achieved),):
            raise self._refused(
                f"its compute_reward takes one goal at a time: for goals of shape "
                f"{achieved.shape} it returned shape {rewards.shape}, expected {(len(achieved),)}"
            )
        return rewards

    def _shaped(self, *rows: NDArray[np.float64]) -> list[NDArray]:
        typed = zip(rows, self._dtypes, strict=True)
        return [row.reshape(-1, *self._shape).astype(dtype) for row, dtype in typed]

    def _refused(self, reason: str) -> NotGoalConditionedError:
        return NotGoalConditionedError(f"{self._task_id}: {reason}")


def attribute_of(env: AnyEnv, name: str, default: Any = None) -> Any:
    """Returns an attribute of an environment or of one that it wraps, or ``default``."""
    if isinstance(env, gymnasium.Env):
        return env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else default
    return getattr(env, name, getattr(env.unwrapped, name, default))


def declared_rule(env: AnyEnv, default: Callable[[], GoalRule]) -> GoalRule | None:
    """Returns the environment's own ``goal_rule``, an attribute or a method, or ``default()``."""
    declared = attribute_of(env, "goal_rule", default)
    return declared() if callable(declared) else declared


def terminated_at(env: AnyEnv, achieved: NDArray, desired: NDArray) -> Any:
    """Returns for each pair of goals whether the step would have ended its episode.

    ``compute_terminated``, if the environment has it, takes one goal at a time. panda-gym does not
    have it; its episodes end at success.
    """
    ends = attribute_of(env, "compute_terminated")
    if ends is not None:
        return [bool(ends(*goals, {})) for goals in zip(achieved, desired, strict=True)]
    panda_gym = sys.modules.get("panda_gym.envs.core")
    if panda_gym and isinstance(env.unwrapped, panda_gym.RobotTaskEnv):
        return env.unwrapped.task.is_success(achieved, desired)
    return 0

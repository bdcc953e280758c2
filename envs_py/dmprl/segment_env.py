"""The interface between a worker and its environments: one call per segment for all of them.

In training, a policy decides once per *segment* of K actions, which are applied open loop. So the
worker calls Python only once per segment, for all its E environments together. Shapes: E
environments, K steps of a segment, O observation, A action.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from abc import ABC, abstractmethod
from pathlib import Path
from types import ModuleType
from typing import NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

from dmprl import goal_rule
from dmprl.env_options import NO_OPTIONS, EnvOptions
from dmprl.goal_rule import GoalRule

SUCCESS_NO, SUCCESS_YES, SUCCESS_NOT_REPORTED = 0, 1, 2
"""Values of :attr:`SegmentBuffers.success`."""


EXTRAS = {"panda_gym": "panda-gym", "gymnasium_robotics": "robotics"}
"""Supported packages, with the extra of dmprl that installs each."""

OBSERVATION_NAMES_MAX = 10_000
"""Maximum length of an observation with names, because a specification is sent as one line."""


class SegmentEnvError(RuntimeError):
    """Raised if an environment fails permanently. The message has its id, index and step."""


class UnsupportedSpaceError(TypeError):
    """Raised if an environment's spaces do not suit a continuous controller."""


class NotGoalConditionedError(TypeError):
    """Raised if hindsight is used, but the environment has no goals, or no rewards for them."""


class Goals(TypedDict):
    """Positions of the achieved and the desired goal in an observation."""

    achieved: int
    """First entry of the achieved goal."""
    desired: int
    """First entry of the desired goal."""
    length: int
    """Number of entries of each goal."""
    sparse: bool
    """Whether the reward only depends on whether the goal was reached."""


class EnvSpec(TypedDict):
    """Properties of an environment that policies need (``shared/runtime/src/spec.rs``)."""

    id: str
    observation_len: int
    action_len: int
    action_low: list[float]
    action_high: list[float]
    control_dt_s: float
    """Duration of one environment step [s]; 0.0 if the environment does not report it."""
    episode_steps: int
    """Steps after which an episode is truncated; 0 if there is no limit."""
    observation_names: NotRequired[list[str]]
    """Name of each entry of an observation, such as ``achieved_goal[0]``; empty if unknown."""


class SegmentBuffers:
    """Results of a :class:`SegmentEnv`, in C-contiguous arrays of the caller, allocated once.

    The worker reads them through the buffer protocol, without a copy. After ``step_segment``:

    - ``observations`` float64 (E, K+1, O): row k is the observation before step k; row ``steps`` is
      the one after the last executed step, that is, the true final observation of an episode. Later
      rows are zero.
    - ``rewards`` float64 (E, K): zero from ``steps`` on.
    - ``terminated``, ``truncated`` uint8 (E,): of the last executed step. Both may be set.
    - ``success`` uint8 (E,): 0 no, 1 yes, 2 not reported; of the last executed step.
    - ``steps`` int32 (E,): executed steps, 1 to K.
    - ``failed`` uint8 (E,): 1 if the environment raised an exception, or returned NaN or infinity,
      during this call. All its other rows of this call, including ``steps``, are then zero and
      invalid.
    - ``next_observations`` float64 (E, O): the observation for the next action: the first one of
      the new episode if the old one ended, else the last one. ``reset`` writes only this array.

    Write into the arrays only during a call. The worker reads them between calls without a lock, so
    a thread of your environment that writes at that time corrupts its segments.
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
        # The caller's inputs are allocated once too.
        self.actions = np.zeros((env_count, segment_steps, action_len))
        self.mask = np.zeros(env_count, np.uint8)
        self.seeds = np.zeros(env_count, np.uint64)


class GoalRows:
    """Steps with other goals, for :meth:`SegmentEnv.relabel`; allocated once.

    Only the first ``count[0]`` of M rows are used. The caller writes ``achieved`` and ``desired``,
    float64 (M, G). The results are ``rewards``, float64 (M,), and ``terminated``, uint8 (M,).
    """

    def __init__(self, rows_max: int, goal_len: int) -> None:
        self.count = np.zeros(1, np.uint64)
        self.achieved = np.zeros((rows_max, goal_len))
        self.desired = np.zeros((rows_max, goal_len))
        self.rewards = np.zeros(rows_max)
        self.terminated = np.zeros(rows_max, np.uint8)


class SegmentEnv(ABC):
    """E environments that step a whole segment in one call.

    Subclass this for a simulator that is faster than a loop over Gymnasium environments. Its task
    id is ``module:Class``, and it is constructed as ``Class(env_count, segment_steps, **kwargs)``
    with the arguments in ``task.kwargs``. An implementation must not keep a reference to the
    buffers after a call, and must write every row of every array that the call is documented to
    write.
    """

    env_count: int
    segment_steps: int

    @abstractmethod
    def spec(self) -> EnvSpec:
        """Returns sizes, bounds and timing. They are constant and equal for all E environments."""

    @abstractmethod
    def reset(
        self, mask: NDArray[np.uint8], seeds: NDArray[np.uint64], out: SegmentBuffers
    ) -> None:
        """Starts a new episode in every environment whose ``mask`` is not zero.

        - ``mask`` uint8 (E,); ``seeds`` uint64 (E,): equal seeds give equal episodes.
        - Writes the masked rows of ``out.next_observations``.
        - An environment that fails is recreated and reset with the same seed.

        Raises:
            SegmentEnvError: if it failed again.
        """

    @abstractmethod
    def step_segment(self, actions: NDArray[np.float64], out: SegmentBuffers) -> None:
        """Runs up to K steps in every environment and writes all of ``out``'s results.

        - ``actions`` float64 (E, K, A), in environment units.
        - An environment stops at its first terminated or truncated step. It is then reset at the
          end of this call, without a seed: its own random generator continues, so a run depends
          only on the first seeds. :func:`seed_of_episode` is an alternative. The caller does not
          reset between episodes.
        - An environment that raises an exception or returns NaN or infinity, in a step or in that
          reset, loses only its own segment. It is closed, recreated and reset with
          :func:`seed_after_failure`; ``out.failed`` is set, and its row of
          ``out.next_observations`` starts the new episode. The other environments are not affected.

        Raises:
            SegmentEnvError: if it could not be recreated. An implementation that cannot recreate
                its environments may raise this at the first failure. The worker then exits and is
                restarted.
        """

    def take_failures(self) -> list[str]:
        """Returns messages about the failures since the last call.

        Each has the id, environment index, step and cause, as in :class:`SegmentEnvError`.
        """
        return []

    def goals(self) -> Goals:
        """Returns the positions of the goals in an observation.

        Raises:
            NotGoalConditionedError: if there are none, or rewards for them are unavailable.
        """
        raise NotGoalConditionedError(f"{self.spec()['id']}: its observation has no goals")

    def relabel(self, rows: GoalRows) -> None:
        """Computes the rewards that steps would have had with other goals, for hindsight.

        Called at the end of an episode with the rows of all its copies, and only if :meth:`goals`
        does not raise an exception.
        """
        raise NotImplementedError

    def goal_rule(self) -> GoalRule | None:
        """Returns the rule by which goals are rewarded, so that the learner needs no copies.

        The default finds one by probing :meth:`relabel`. Override it to declare a rule, or to
        return None: rewards then always come from :meth:`relabel`. A rule is proven before use.

        Raises:
            NoGoalRuleError: if none is found.
        """
        return goal_rule.fit(self)

    def close(self) -> None:  # noqa: B027 - nothing to release is the usual case
        """Releases the environments' resources."""


def seed_after_failure(first_seed: int, failures: int) -> int:
    """Derives the seed of an environment that was recreated.

    The seed is reproducible, but differs from the previous one, so an episode that led to a failure
    is not repeated.

    - ``first_seed``: seed of the caller's last ``reset``.
    - ``failures``: number of failures since then, including this one.
    - Returns 31 bits, because some environments accept no more.
    """
    return int(np.random.SeedSequence([first_seed, failures]).generate_state(1)[0]) >> 1


def seed_of_episode(first_seed: int, episode: int) -> int:
    """Derives the seed of a later episode, for environments that are always reset with a seed.

    - ``first_seed``: seed of the caller's last ``reset``.
    - ``episode``: number of episodes that have ended since then, including the last one.
    - Returns 31 bits, as :func:`seed_after_failure` does.
    """
    return int(np.random.SeedSequence([first_seed, episode, 1]).generate_state(1)[0]) >> 1


def make(
    task_id: str, env_count: int, segment_steps: int, options: EnvOptions = NO_OPTIONS
) -> SegmentEnv:
    """Creates the environments of a task.

    - ``task_id``: a Gymnasium id; ``module:Id`` if ``module`` registers the id when it is imported;
      or ``module:name``, where ``name`` is a subclass of :class:`SegmentEnv`,
      ``dmprl.mujoco_batch.MujocoTask``, ``gymnasium.Env`` or ``gymnasium.vector.VectorEnv``, or a
      function that returns a ``gymnasium.Env`` or, with a parameter ``num_envs``, a ``VectorEnv``.
    - ``options``: arguments and wrappers. Environments with wrappers are Gymnasium environments,
      stepped one by one, even those of dmprl's own tasks.

    Raises:
        OptionsError: if they cannot be created with these options; the cause is the original error.
        RandomiseError: if a key of ``task.randomise`` cannot be applied to them.
    """
    if env_count < 1 or segment_steps < 1:
        raise ValueError(
            f"{env_count} environments, {segment_steps} steps; expected 1 or more of both"
        )
    env = _make(task_id, env_count, segment_steps, options)
    return delayed(env, options)


def delayed(env: SegmentEnv, options: EnvOptions) -> SegmentEnv:
    """Adds the delays that ``options`` demand."""
    if not options.randomise.delays():
        return env
    from dmprl.delayed_env import DelayedEnv  # that module imports this one

    return DelayedEnv(env, options.randomise)


def _make(task_id: str, env_count: int, segment_steps: int, options: EnvOptions) -> SegmentEnv:
    candidate = named_object(task_id)
    with options.explained(task_id):
        if not options.wrappers:
            batch = _make_batch(task_id, candidate, env_count, segment_steps, options)
            if batch is not None:
                if options.randomise.of_model():
                    from dmprl.randomise import randomise_batch  # imports MuJoCo

                    randomise_batch(batch, options.randomise)
                return batch

        batch_kind = kind_of_batch(candidate)
        if batch_kind:
            raise TypeError(f"{batch_kind} cannot be wrapped; expected a gymnasium.Env")

        # A SegmentEnv works without Gymnasium.
        from dmprl.gymnasium_env import GymnasiumSegmentEnv

        if options.wrappers:
            from dmprl.task_env import gymnasium_maker

            candidate = gymnasium_maker(task_id, candidate, options)
        return GymnasiumSegmentEnv(task_id, env_count, segment_steps, candidate, options)


def _make_batch(
    task_id: str, candidate: object, env_count: int, segment_steps: int, options: EnvOptions
) -> SegmentEnv | None:
    """Creates environments that are stepped together; None for Gymnasium environments."""
    if isinstance(candidate, type) and issubclass(candidate, SegmentEnv):
        return candidate(env_count, segment_steps, **options.kwargs)
    if makes_vector_env(candidate):
        from dmprl.vector_env import VectorSegmentEnv

        return VectorSegmentEnv(task_id, env_count, segment_steps, candidate, options)
    batched = sys.modules.get("dmprl.mujoco_batch")  # imported with every subclass of its task
    if batched and isinstance(candidate, type) and issubclass(candidate, batched.MujocoTask):
        batched.quieten_mujoco()
        kwargs, episode_steps = options.split_time_limit(candidate.episode_steps)
        return candidate(env_count, **kwargs).batch(segment_steps, episode_steps)

    from dmprl.tasks import make_batch

    return make_batch(task_id.removeprefix("dmprl:"), env_count, segment_steps, options)


def makes_vector_env(named: object) -> bool:
    """Returns whether ``named`` is a ``VectorEnv`` or a function with a parameter ``num_envs``."""
    if isinstance(named, type):
        vector = sys.modules.get("gymnasium.vector")  # imported with every subclass
        return vector is not None and issubclass(named, vector.VectorEnv)
    try:
        return callable(named) and "num_envs" in inspect.signature(named).parameters
    except (TypeError, ValueError):  # some callables have no signature
        return False


def kind_of_batch(named: object) -> str:
    """Describes the object of a task whose environments are stepped together; otherwise empty."""
    if isinstance(named, type) and issubclass(named, SegmentEnv):
        return "a SegmentEnv"
    return "a vector environment" if makes_vector_env(named) else ""


def named_object(task_id: str) -> object:
    """Returns the object that ``module:name`` names; None without a module, or if it is missing."""
    module_name, _, name = task_id.rpartition(":")
    return getattr(_import(task_id, module_name), name, None) if module_name else None


def _import(task_id: str, module_name: str) -> ModuleType:
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise  # the module exists, but one of its imports is missing
        raise ModuleNotFoundError(
            f"{task_id}: no module {error.name!r} among the installed packages or in the "
            f"directories given with --python-path{_remedy(module_name, error.name)}",
            name=error.name,
        ) from None


def _remedy(module_name: str, missing: str) -> str:
    if extra := EXTRAS.get(module_name):
        return f"; install it with: dmprl env add 'dmprl[{extra}]'"
    here = Path(missing)
    for found in (here.with_suffix(".py"), here):
        if "." not in missing and found.exists():
            return f". {found} is in the current folder, so add: --python-path ."
    return ""

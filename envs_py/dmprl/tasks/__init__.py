"""The tasks of the paper and their variants.

A worker runs a task as a batch of environments (:func:`make_batch`). As a Gymnasium environment it
runs one at a time (``gymnasium.make("dmprl/Thrower-v0")`` after ``import dmprl``).
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from dmprl.env_options import EnvOptions

if TYPE_CHECKING:
    from dmprl.mujoco_batch import BatchSegmentEnv, MujocoTask


class Registered(NamedTuple):
    """Module and class of a task, and its time limit, which Gymnasium needs for registration."""

    module: str
    name: str
    episode_steps: int


PANDA_OBJECTS = {"PandaPush": 50, "PandaSlide": 50, "PandaPickAndPlace": 50, "PandaStack": 100}
"""Length of an episode of the Panda's tasks with objects."""

TASKS = {
    "dmprl/Reacher-v5": Registered("dmprl.tasks.reacher", "Reacher", 50),
    "dmprl/Reacher-v1": Registered("dmprl.tasks.reacher", "ReacherV1", 50),
    "dmprl/Pusher-v5": Registered("dmprl.tasks.pusher", "Pusher", 100),
    "dmprl/Pusher-v0": Registered("dmprl.tasks.pusher", "PusherV0", 100),
    "dmprl/Thrower-v0": Registered("dmprl.tasks.thrower", "Thrower", 100),
    "dmprl/PandaReach-v0": Registered("dmprl.tasks.panda", "PandaReach", 50),
    "dmprl/PandaReachJoints-v0": Registered("dmprl.tasks.panda", "PandaReachJoints", 50),
    "dmprl/BoxPushingDense-v0": Registered("dmprl.tasks.box_pushing", "BoxPushingDense", 100),
    "dmprl/BoxPushingTemporalSparse-v0": Registered(
        "dmprl.tasks.box_pushing", "BoxPushingTemporalSparse", 100
    ),
} | {
    f"dmprl/{name}{variant}-v0": Registered("dmprl.tasks.panda_objects", name + variant, steps)
    for name, steps in PANDA_OBJECTS.items()
    for variant in ("", "Dense", "Joints", "JointsDense")
}
"""Every task by its Gymnasium id."""

SAME_AS_GYMNASIUM = ("Reacher-v5", "Pusher-v5")
"""Gymnasium ids whose episodes are bit-identical to dmprl's, so that a worker may use dmprl's."""


def registered(task_id: str) -> Registered | None:
    """Returns the task with this id, which may be one of Gymnasium's ids."""
    return TASKS.get(f"dmprl/{task_id}" if task_id in SAME_AS_GYMNASIUM else task_id)


def replaces(task_id: str, options: EnvOptions) -> bool:
    """Returns whether dmprl's task is used for this id.

    With arguments, Gymnasium's ids name Gymnasium's environments, because dmprl's have none but the
    time limit.
    """
    if task_id in SAME_AS_GYMNASIUM:
        return options.kwargs.keys() <= {"max_episode_steps"}
    return task_id in TASKS


def make_task(
    task_id: str, env_count: int, kwargs: Mapping[str, Any] = MappingProxyType({})
) -> MujocoTask | None:
    """Creates a task for ``env_count`` environments; None if dmprl has no task with this id.

    :raises TypeError: if the task does not have one of the arguments ``kwargs``.
    """
    entry = registered(task_id)
    if entry is None:
        return None
    task = getattr(importlib.import_module(entry.module), entry.name)
    known = list(inspect.signature(task).parameters)[1:]  # after env_count
    unknown = [name for name in kwargs if name not in known]
    if unknown:
        expected = ", ".join([*known, "max_episode_steps"])
        raise TypeError(f"{task_id} has no argument {', '.join(unknown)}; expected {expected}")
    return task(env_count, **kwargs)


def make_batch(
    task_id: str, env_count: int, segment_steps: int, options: EnvOptions
) -> BatchSegmentEnv | None:
    """Creates a task's environments for a worker; None if dmprl has no task with this id.

    This changes settings of the process; see :func:`dmprl.mujoco_batch.quieten_mujoco`.
    """
    entry = registered(task_id)
    if entry is None or not replaces(task_id, options):
        return None
    kwargs, episode_steps = options.split_time_limit(entry.episode_steps)
    task = make_task(task_id, env_count, kwargs)

    from dmprl.mujoco_batch import quieten_mujoco

    quieten_mujoco()
    return task.batch(segment_steps, episode_steps)

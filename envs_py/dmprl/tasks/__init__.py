"""The tasks of the paper and their variants.

A worker runs a task as a batch of environments (:func:`make_batch`). As a Gymnasium environment it
runs one at a time (``gymnasium.make("dmprl/Thrower-v0")`` after ``import dmprl``).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, NamedTuple

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


def make_task(task_id: str, env_count: int) -> MujocoTask | None:
    """Creates a task for ``env_count`` environments; None if dmprl has no task with this id."""
    entry = registered(task_id)
    if entry is None:
        return None
    return getattr(importlib.import_module(entry.module), entry.name)(env_count)


def make_batch(task_id: str, env_count: int, segment_steps: int) -> BatchSegmentEnv | None:
    """Creates a task's environments for a worker; None if dmprl has no task with this id.

    This changes settings of the process; see :func:`dmprl.mujoco_batch.quieten_mujoco`.
    """
    task = make_task(task_id, env_count)
    if task is None:
        return None

    from dmprl.mujoco_batch import quieten_mujoco

    quieten_mujoco()
    return task.batch(segment_steps, task.episode_steps)

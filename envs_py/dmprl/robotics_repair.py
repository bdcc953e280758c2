"""Makes Gymnasium-Robotics work with MuJoCo 4.

Version 1.4.2 of Gymnasium-Robotics, the newest, tests whether a joint's type, a NumPy integer, is
in a tuple of MuJoCo's enumerators. In MuJoCo 4 an enumerator is never equal to a NumPy integer on
its right, so FetchReach and all code that sets a joint by name fail with an AssertionError.
"""

from __future__ import annotations

import enum
import types

import numpy as np


def repair() -> None:
    """Replaces the joint types in a module of Gymnasium-Robotics by integers that compare equal."""
    from gymnasium_robotics.utils import mujoco_utils

    seen = mujoco_utils.mujoco
    if seen.mjtJoint.mjJNT_HINGE == np.int32(seen.mjtJoint.mjJNT_HINGE):
        return
    members = seen.mjtJoint.__members__.items()
    joint_types = enum.IntEnum("mjtJoint", {name: int(value) for name, value in members})
    mujoco_utils.mujoco = types.SimpleNamespace(**(vars(seen) | {"mjtJoint": joint_types}))

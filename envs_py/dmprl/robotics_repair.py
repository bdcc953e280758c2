"""Makes Gymnasium-Robotics work with MuJoCo 4.

Its newest version, 1.4.2, tests whether a joint's type, a NumPy integer, is in a tuple of MuJoCo's
enumerators. In MuJoCo 4 an enumerator on the left equals no NumPy integer, so FetchReach and
everything that sets a joint by name end in an AssertionError without a message.
"""

from __future__ import annotations

import enum
import types

import numpy as np


def repair() -> None:
    """Gives one module of Gymnasium-Robotics joint types that compare as before."""
    from gymnasium_robotics.utils import mujoco_utils

    seen = mujoco_utils.mujoco
    if seen.mjtJoint.mjJNT_HINGE == np.int32(seen.mjtJoint.mjJNT_HINGE):
        return
    members = seen.mjtJoint.__members__.items()
    joint_types = enum.IntEnum("mjtJoint", {name: int(value) for name, value in members})
    mujoco_utils.mujoco = types.SimpleNamespace(**(vars(seen) | {"mjtJoint": joint_types}))

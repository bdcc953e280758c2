"""Makes Gymnasium-Robotics work with MuJoCo 4, and twice as fast.

Version 1.4.2 of Gymnasium-Robotics, the newest, tests whether a joint's type, a NumPy integer, is
in a tuple of MuJoCo's enumerators. In MuJoCo 4 an enumerator is never equal to a NumPy integer on
its right, so FetchReach and all code that sets a joint by name fail with an AssertionError.

Its observations look up every joint of the robot by name, which takes longer than the simulation.
Here the joints are looked up once for each model.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

RobotState = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Positions and velocities of a robot's joints."""


def repair() -> None:
    """Replaces joint types by integers, and the function that reads the state of a robot."""
    from gymnasium_robotics.utils import mujoco_utils

    if isinstance(mujoco_utils.robot_get_obs, RobotReader):
        return
    seen = mujoco_utils.mujoco
    members = seen.mjtJoint.__members__.items()
    joint_types = types.SimpleNamespace(**{name: int(value) for name, value in members})
    mujoco_utils.mujoco = types.SimpleNamespace(**(vars(seen) | {"mjtJoint": joint_types}))
    mujoco_utils.robot_get_obs = RobotReader(mujoco_utils.robot_get_obs, seen)


class Places(NamedTuple):
    """Places of a robot's joints in the state of a simulation."""

    qpos: NDArray[np.intp]
    qvel: NDArray[np.intp]


class RobotReader:
    """Does the same as Gymnasium-Robotics' ``robot_get_obs``, which is ``original``."""

    def __init__(self, original: Callable[..., RobotState], mujoco: Any) -> None:
        self._original = original
        self._mujoco = mujoco
        self._places: dict[tuple[object, ...], Places | None] = {}

    def __call__(self, model: Any, data: Any, joint_names: Sequence[str]) -> RobotState:
        """Returns positions and velocities of all joints whose names start with ``robot``."""
        key = (tuple(joint_names), model.jnt_type.tobytes(), model.name_jntadr.tobytes())
        if key not in self._places:
            self._places[key] = self._find(model, joint_names)
        places = self._places[key]
        if places is None:
            return self._original(model, data, joint_names)
        return data.qpos[places.qpos], data.qvel[places.qvel]

    def _find(self, model: Any, joint_names: Sequence[str]) -> Places | None:
        """Finds the joints; None if one has several positions, or there are less than two."""
        mujoco = self._mujoco
        joint = mujoco.mjtObj.mjOBJ_JOINT
        names = [name for name in joint_names if name.startswith("robot")]
        ids = np.array([mujoco.mj_name2id(model, joint, name) for name in names], np.intp)
        single = [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)]
        # The original returns a number instead of an array for one joint.
        if len(ids) < 2 or not np.isin(model.jnt_type[ids], single).all():
            return None
        return Places(model.jnt_qposadr[ids].astype(np.intp), model.jnt_dofadr[ids].astype(np.intp))

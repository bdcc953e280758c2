"""Finds the joints of a MuJoCo model that belong to the robot."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

KINDS = {
    mujoco.mjtJoint.mjJNT_HINGE.value: "hinge",
    mujoco.mjtJoint.mjJNT_SLIDE.value: "slide",
}
"""Joints with one degree of freedom; ball and free joints have several."""
BY_JOINT = (mujoco.mjtTrn.mjTRN_JOINT.value, mujoco.mjtTrn.mjTRN_JOINTINPARENT.value)


class Joints(NamedTuple):
    """Joints with one degree of freedom, in the order of the model."""

    names: list[str]
    kinds: list[str]
    """``hinge`` [rad] or ``slide`` [m]."""
    qpos: list[int]
    """Index of each joint in the model's positions."""
    qvel: list[int]
    """Index of each joint in the model's velocities."""


def robot_joints(model: mujoco.MjModel) -> Joints:
    """Finds the joints that actuators move, directly or by a tendon.

    A robot may also be welded to a body that the program moves (Gymnasium-Robotics' Fetch). All
    joints between that body and the world then belong to the robot.
    """
    moved = _actuated(model) | _dragged(model)
    kept = [joint for joint in sorted(moved) if model.jnt_type[joint] in KINDS]
    return Joints(
        [model.joint(joint).name or f"joint{joint}" for joint in kept],
        [KINDS[model.jnt_type[joint]] for joint in kept],
        [int(model.jnt_qposadr[joint]) for joint in kept],
        [int(model.jnt_dofadr[joint]) for joint in kept],
    )


def _actuated(model: mujoco.MjModel) -> set[int]:
    joints: set[int] = set()
    for kind, (target, _) in zip(model.actuator_trntype, model.actuator_trnid, strict=True):
        if kind in BY_JOINT:
            joints.add(int(target))
        elif kind == mujoco.mjtTrn.mjTRN_TENDON.value:
            first, count = model.tendon_adr[target], model.tendon_num[target]
            wraps = range(first, first + count)
            joints.update(
                int(model.wrap_objid[wrap])
                for wrap in wraps
                if model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_JOINT.value
            )
    return joints


def _dragged(model: mujoco.MjModel) -> set[int]:
    joints: set[int] = set()
    for equality in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_WELD.value):
        bodies = (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
        of_bodies = model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_BODY.value
        mocap = [model.body_mocapid[body] >= 0 for body in bodies] if of_bodies else []
        if sum(mocap) == 1:
            body = bodies[mocap.index(False)]
            while body > 0:
                first = int(model.body_jntadr[body])
                joints.update(range(first, first + int(model.body_jntnum[body])))
                body = int(model.body_parentid[body])
    return joints

"""Pusher: an arm of seven joints pushes a cylinder to a goal.

There are two versions: Gymnasium's Pusher-v5, bit-identical, and Gym's Pusher-v0, which the paper
used. In Pusher-v0 the position of a body is the centre of mass of its subtree, so the tip is
between the arm's two prongs instead of at the wrist. Its reward depends on the state before the
step, and its cylinder has a thousandth of the mass.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from dmprl.mujoco_batch import Fields, MujocoTask, Start
from dmprl.tasks.models import gymnasium_model, gymnasium_picture_model
from dmprl.tasks.reacher import minus_distance

JOINTS = (
    "shoulder_pan",
    "shoulder_lift",
    "upper_arm_roll",
    "elbow_flex",
    "forearm_roll",
    "wrist_flex",
    "wrist_roll",
)
"""The arm's joints, also in Thrower."""
OBSERVED_BODIES = ("tips_arm", "object", "goal")


class Pusher(MujocoTask):
    """Gymnasium's Pusher-v5."""

    id = "Pusher-v5"
    frame_skip = 5
    episode_steps = 100
    recorded: tuple[str, ...] = ("qpos", "qvel", "xpos")
    camera: ClassVar[Mapping[str, Any]] = {"distance": 3.0, "elevation": -30.0, "azimuth": 130.0}
    goal_in_pictures = "red disc"
    model_file = "pusher_v5.xml"

    def load_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        model = gymnasium_model(self.model_file)
        self._bodies = [model.body(name).id for name in OBSERVED_BODIES]
        return model

    def picture_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        return gymnasium_picture_model(self.model_file)

    def observation_names(self) -> list[str]:  # noqa: D102 - inherited
        return arm_observation_names(OBSERVED_BODIES)

    def draw_start(  # noqa: D102 - inherited
        self, rng: np.random.Generator, start: Start
    ) -> None:
        while True:
            # Positions of the slide joints, y first. The goal is at their origin.
            offset = np.array([rng.uniform(-0.3, 0.0), rng.uniform(-0.2, 0.2)])
            if np.linalg.norm(offset) > 0.17:
                break
        start.qpos[7:9] = offset
        start.qpos[9:] = 0.0
        start.qvel[:] += rng.uniform(-0.005, 0.005, 11)
        start.qvel[7:] = 0.0

    def observe(self, fields: Fields, out: NDArray[np.float64]) -> None:  # noqa: D102 - inherited
        observe_arm(fields, self.recorded[-1], self._bodies, out)

    def rewards(  # noqa: D102 - inherited
        self,
        observations: NDArray[np.float64],
        actions: NDArray[np.float32],
        out: NDArray[np.float64],
    ) -> None:
        rows = self.rewarded(observations)
        tips, cylinder, goal = rows[..., 14:17], rows[..., 17:20], rows[..., 20:23]
        difference = self.scratch("difference", cylinder.shape)
        near = self.scratch("near", out.shape)
        minus_distance(np.subtract(cylinder, tips, out=difference), near)
        minus_distance(np.subtract(cylinder, goal, out=difference), out)
        effort = self.effort(actions)
        effort *= 0.1
        out -= effort
        near *= 0.5
        out += near

    def rewarded(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the states whose distances are rewarded: those after the steps."""
        return observations[:, 1:]


class PusherV0(Pusher):
    """Gym's Pusher-v0, which the paper used."""

    id = "dmprl/Pusher-v0"
    recorded = ("qpos", "qvel", "subtree_com")
    model_file = "pusher.xml"

    def load_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        model = super().load_model()
        include_armature(model, mujoco.MjData(model))
        return model

    def derive_constants(  # noqa: D102 - inherited
        self, model: mujoco.MjModel, data: mujoco.MjData
    ) -> None:
        super().derive_constants(model, data)
        include_armature(model, data)

    def rewarded(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the states before the steps."""
        return observations[:, :-1]


def include_armature(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Makes contacts as stiff as in MuJoCo 1 and 2, for which Gym's versions were made.

    A contact's softness is scaled by the inverse inertia of both bodies. Since MuJoCo 3, the value
    of a body with only slide joints ignores the armature of the joints. The cylinder's inertia is
    then a millionth of the effective one, and the arm passes through it. MuJoCo 2 used, for each
    joint, its entry in the diagonal of the inverse inertia matrix, and for each body the mean over
    the axes of the inverse inertia at its centre of mass (sliding bodies do not rotate).

    ``data`` is a work area.
    """
    mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    inverse = np.zeros((model.nv, model.nv))
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE):
        dof, body = model.jnt_dofadr[joint], model.jnt_bodyid[joint]
        model.dof_invweight0[dof] = inverse[dof, dof]
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
        model.body_invweight0[body, 0] = np.trace(jacobian @ inverse @ jacobian.T) / 3


def arm_observation_names(bodies: tuple[str, ...]) -> list[str]:
    """Names the entries that :func:`observe_arm` writes."""
    names = [f"angle_{joint}" for joint in JOINTS] + [f"velocity_{joint}" for joint in JOINTS]
    return names + [f"{body}_{axis}" for body in bodies for axis in "xyz"]


def observe_arm(
    fields: Fields, positions: str, bodies: list[int], out: NDArray[np.float64]
) -> None:
    """Writes joint angles [rad] (7), their velocities (7) and the bodies' positions [m] (3 x 3).

    ``positions`` names the field with the positions.
    """
    out[..., :7] = fields["qpos"][..., :7]
    out[..., 7:14] = fields["qvel"][..., :7]
    for place, body in enumerate(bodies):
        out[..., 14 + 3 * place : 17 + 3 * place] = fields[positions][..., body, :]

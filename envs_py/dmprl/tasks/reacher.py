"""Reacher: a planar arm of two joints moves its fingertip to a target.

There are two versions: Gymnasium's Reacher-v5, bit-identical, and Reacher-v1, which Gym had until
0.9.4. In Reacher-v1 some targets are out of reach, the distance has a third coordinate (always
zero), and the reward depends on the state before the step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from dmprl.mujoco_batch import Fields, MujocoTask, Start
from dmprl.tasks.models import gymnasium_model, gymnasium_picture_model

FINGERTIP, TARGET = 3, 4
"""Indices of bodies in the model."""


class Reacher(MujocoTask):
    """Gymnasium's Reacher-v5."""

    id = "Reacher-v5"
    frame_skip = 2
    episode_steps = 50
    recorded = ("qpos", "qvel", "xpos")
    camera: ClassVar[Mapping[str, Any]] = {"distance": 1.0, "elevation": -60.0, "azimuth": 90.0}
    goal_in_pictures = "red ball"
    distance_dims = 2

    def load_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        model = gymnasium_model("reacher.xml")
        # Its geoms cannot collide. Without the collision detection a step takes a fifth less time.
        assert not np.any(model.geom_contype), "a geom of reacher.xml can collide"
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        return model

    def picture_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        return gymnasium_picture_model("reacher.xml")

    def observation_names(self) -> list[str]:  # noqa: D102 - inherited
        names = ["cos_joint0", "cos_joint1", "sin_joint0", "sin_joint1", "target_x", "target_y"]
        names += ["velocity_joint0", "velocity_joint1"]
        return names + [f"fingertip_to_target_{axis}" for axis in "xyz"[: self.distance_dims]]

    def draw_start(  # noqa: D102 - inherited
        self, rng: np.random.Generator, start: Start
    ) -> None:
        start.qpos[:] += rng.uniform(-0.1, 0.1, 4)
        start.qpos[2:] = self.draw_target(rng)
        start.qvel[:] += rng.uniform(-0.005, 0.005, 4)
        start.qvel[2:] = 0.0

    def draw_target(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draws a point within reach [m]."""
        while True:
            target = rng.uniform(-0.2, 0.2, 2)
            if math.sqrt(target.dot(target)) < 0.2:  # five times as fast as np.linalg.norm
                return target

    def observe(self, fields: Fields, out: NDArray[np.float64]) -> None:  # noqa: D102 - inherited
        qpos, qvel, positions = fields["qpos"], fields["qvel"], fields["xpos"]
        dims = self.distance_dims
        np.cos(qpos[..., :2], out=out[..., 0:2])
        np.sin(qpos[..., :2], out=out[..., 2:4])
        out[..., 4:6] = qpos[..., 2:]
        out[..., 6:8] = qvel[..., :2]
        np.subtract(
            positions[..., FINGERTIP, :dims], positions[..., TARGET, :dims], out=out[..., 8:]
        )

    def rewards(  # noqa: D102 - inherited
        self,
        observations: NDArray[np.float64],
        actions: NDArray[np.float32],
        out: NDArray[np.float64],
    ) -> None:
        minus_distance(self.rewarded(observations)[..., 8:], out)
        out -= self.effort(actions)

    def rewarded(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the states whose distances are rewarded: those after the steps."""
        return observations[:, 1:]


class ReacherV1(Reacher):
    """Gym's Reacher-v1, which the paper used."""

    id = "dmprl/Reacher-v1"
    distance_dims = 3

    def draw_target(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draws a point of the square, a fifth of which is out of reach [m].

        Gym intended the disc of Reacher-v5, but compared the norm with 2 instead of 0.2.
        """
        return rng.uniform(-0.2, 0.2, 2)

    def rewarded(self, observations: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the states before the steps."""
        return observations[:, :-1]


def minus_distance(differences: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Writes ``-|difference|`` of each row, rounded as ``np.linalg.norm`` rounds a single row."""
    np.vecdot(differences, differences, out=out)
    np.sqrt(out, out=out)
    np.negative(out, out=out)

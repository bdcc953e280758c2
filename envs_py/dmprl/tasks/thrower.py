"""Thrower: an arm of seven joints throws a ball into a box.

This is Gym's Thrower-v0, which the paper used and no maintained package provides. The model is
built from its published dimensions (``models/thrower.xml``). The position of a body is the centre
of mass of its subtree, and the reward depends on the state before the step. In later versions of
Gym the point where the ball hits the ground moves with the rolling ball; here it is fixed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from dmprl.mujoco_batch import Fields, MujocoTask, Start
from dmprl.tasks.models import own_model
from dmprl.tasks.pusher import arm_observation_names, observe_arm
from dmprl.tasks.reacher import minus_distance

OBSERVED_BODIES = ("wrist_roll", "ball", "goal")
GROUND_HEIGHT = -0.25
"""Height below which a ball has hit the ground [m]."""


class Thrower(MujocoTask):
    """Gym's Thrower-v0."""

    id = "dmprl/Thrower-v0"
    frame_skip = 5
    episode_steps = 100
    recorded = ("qpos", "qvel", "subtree_com")
    camera: ClassVar[Mapping[str, Any]] = {
        "distance": 2.8,
        "elevation": -25.0,
        "azimuth": 150.0,
        "lookat": (0.15, 0.0, -0.1),
    }
    goal_in_pictures = "red box"

    def __init__(self, env_count: int) -> None:
        super().__init__(env_count)
        self._has_hit = np.zeros(env_count, np.bool_)
        self._hit_xy = np.zeros((env_count, 2))

    def load_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        model = own_model("thrower.xml")
        self._bodies = [model.body(name).id for name in OBSERVED_BODIES]
        return model

    def observation_names(self) -> list[str]:  # noqa: D102 - inherited
        return arm_observation_names(OBSERVED_BODIES)

    def draw_start(  # noqa: D102 - inherited
        self, rng: np.random.Generator, start: Start
    ) -> None:
        start.qpos[7:9] = rng.uniform(-0.3, 0.3, 2)
        start.qvel[:] += rng.uniform(-0.005, 0.005, 15)
        start.qvel[7:] = 0.0

    def episodes_began(self, indices: NDArray[np.int32]) -> None:  # noqa: D102 - inherited
        self._has_hit[indices] = False

    def observe(self, fields: Fields, out: NDArray[np.float64]) -> None:  # noqa: D102 - inherited
        observe_arm(fields, "subtree_com", self._bodies, out)

    def rewards(  # noqa: D102 - inherited
        self,
        observations: NDArray[np.float64],
        actions: NDArray[np.float32],
        out: NDArray[np.float64],
    ) -> None:
        ball, goal = observations[:, :-1, 17:20], observations[:, :-1, 20:22]
        thrown_to = self.scratch("thrown_to", goal.shape)
        thrown_to[:] = ball[..., :2]
        for step in range(thrown_to.shape[1]):
            hits = (ball[:, step, 2] < GROUND_HEIGHT) & ~self._has_hit
            self._hit_xy[hits] = ball[hits, step, :2]
            self._has_hit |= hits
            thrown_to[self._has_hit, step] = self._hit_xy[self._has_hit]
        thrown_to -= goal
        minus_distance(thrown_to, out)
        effort = self.effort(actions, np.float64)
        effort *= 0.002
        out -= effort

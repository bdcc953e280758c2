"""PandaReach: a Franka Panda moves its end effector to a point.

This is panda-gym's task in MuJoCo, with its start, goals, actions, reward and timing. The arm's
servos respond like PyBullet's (``models/panda.xml``). There are three differences:

- Reaching the goal does not end the episode, as in panda-gym 2: the reward is for coming close and
  staying there.
- For both kinds of actions the observation is one vector with the joints and the end effector;
  panda-gym's has only the end effector.
- The arm is compensated for gravity, as the real one is. panda-gym's arm sags a little in every
  step, and the next step starts from there: by 17 cm in an episode of random actions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from dmprl.mujoco_batch import Fields, Start
from dmprl.stepwise_batch import StepwiseTask
from dmprl.tasks.models import own_model, own_model_without_decoration
from dmprl.tasks.panda_kinematics import JOINTS, InverseKinematics
from dmprl.tasks.reacher import minus_distance

NEUTRAL = (0.0, 0.41, 0.0, -1.85, 0.0, 2.26, 0.79)
"""Joint angles at the start [rad]; the end effector is at (0.0384, 0, 0.1974) m."""
GOAL_LOW, GOAL_HIGH = (-0.15, -0.15, 0.0), (0.15, 0.15, 0.3)
"""Corners of the box from which goals are drawn [m]."""
DISPLACEMENT = 0.05
"""Displacement by an action of 1 in one step: of a joint [rad], or of the end effector [m]."""
SUCCESS_DISTANCE = 0.05
"""Distance below which the goal counts as reached [m]."""
MODEL = "panda.xml"


class PandaReachJoints(StepwiseTask):
    """The task with displacements of the seven joints as actions."""

    id = "dmprl/PandaReachJoints-v0"
    frame_skip = 20
    episode_steps = 50
    recorded: tuple[str, ...] = ("qpos", "qvel", "site_xpos", "mocap_pos", "sensordata")
    camera: ClassVar[Mapping[str, Any]] = {
        "distance": 1.5,
        "elevation": -19.0,
        "azimuth": 137.0,
        "lookat": (-0.28, 0.0, 0.22),
    }
    goal_in_pictures = "green ball"
    action_len = JOINTS

    def __init__(self, env_count: int) -> None:
        super().__init__(env_count)
        # The actuators' ranges are joint angles, which the actions are not.
        self.action_high = np.ones(self.action_len, np.float32)
        self.action_low = -self.action_high
        self._displacement = np.zeros((env_count, self.action_len))

    def load_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        return own_model_without_decoration(MODEL)

    def picture_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        return own_model(MODEL)

    def observation_names(self) -> list[str]:  # noqa: D102 - inherited
        joints = range(1, JOINTS + 1)
        names = [f"angle_joint{joint}" for joint in joints]
        names += [f"velocity_joint{joint}" for joint in joints]
        names += [f"end_effector_to_goal_{axis}" for axis in "xyz"]
        return names + [f"velocity_end_effector_{axis}" for axis in "xyz"]

    def draw_start(  # noqa: D102 - inherited
        self, rng: np.random.Generator, start: Start
    ) -> None:
        start.qpos[:] = NEUTRAL
        start.mocap_pos[0] = rng.uniform(GOAL_LOW, GOAL_HIGH)

    def observe(self, fields: Fields, out: NDArray[np.float64]) -> None:  # noqa: D102 - inherited
        out[..., 0:7] = fields["qpos"]
        out[..., 7:14] = fields["qvel"]
        np.subtract(
            fields["mocap_pos"][..., 0, :], fields["site_xpos"][..., 0, :], out=out[..., 14:17]
        )
        out[..., 17:20] = fields["sensordata"]

    def rewards(  # noqa: D102 - inherited
        self,
        observations: NDArray[np.float64],
        actions: NDArray[np.float32],
        out: NDArray[np.float64],
    ) -> None:
        minus_distance(observations[:, 1:, 14:17], out)

    def successes(  # noqa: D102 - inherited
        self, observations: NDArray[np.float64], out: NDArray[np.uint8]
    ) -> None:
        distance = np.linalg.norm(observations[:, 14:17], axis=1)
        np.less(distance, SUCCESS_DISTANCE, out=out, casting="unsafe")

    def targets(  # noqa: D102 - inherited
        self, fields: Fields, actions: NDArray[np.float32], out: NDArray[np.float64]
    ) -> None:
        np.add(fields["qpos"], self.displacement(actions), out=out)

    def displacement(self, actions: NDArray[np.float32]) -> NDArray[np.float64]:
        """Returns the displacement of actions (E, A) [rad or m]; valid until the next call."""
        np.clip(actions, -1.0, 1.0, out=self._displacement)
        self._displacement *= DISPLACEMENT
        return self._displacement


class PandaReach(PandaReachJoints):
    """The task with displacements of the end effector as actions; the gripper points down."""

    id = "dmprl/PandaReach-v0"
    recorded = tuple(sorted({*PandaReachJoints.recorded, *InverseKinematics.recorded}))
    action_len = 3

    def __init__(self, env_count: int) -> None:
        super().__init__(env_count)
        self._kinematics = InverseKinematics(self.model, env_count)

    def targets(  # noqa: D102 - inherited
        self, fields: Fields, actions: NDArray[np.float32], out: NDArray[np.float64]
    ) -> None:
        self._kinematics.displace(fields, self.displacement(actions), out)

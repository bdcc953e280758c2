"""Box pushing: a Franka Panda with a rod pushes and turns a box, with torques as actions.

This is the benchmark of fancy-gym, with its start, goals, observations, actions, rewards and
timing, for a box that always starts at the same place. The differences are in decision 0093.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from dmprl.mujoco_batch import Fields, Start
from dmprl.stepwise_batch import StepwiseTask
from dmprl.tasks.box_pushing_scene import TORQUE_MAX, box_pushing_model
from dmprl.tasks.panda_kinematics import JOINTS, ForwardKinematics

START_ANGLES = (0.38707, 0.17621, 0.24989, -2.39914, -0.07987, 2.56857, 1.47952)
"""Joint angles at the start [rad], with the rod upright inside the box: fancy-gym's inverse
kinematics, which it computes at each start, give these for the box's only start."""
BOX_START = (0.4, 0.3, -0.01, 0.0, 0.0, 0.0, 1.0)
"""Position [m] and quaternion of the box at the start."""
GOAL_RANGE = (0.3, -0.45, -0.01), (0.6, 0.45, -0.01)
"""Corners of the rectangle from which goals are drawn [m]."""
GOAL_DISTANCE_MIN = 0.3
"""Smallest distance of a goal from the start of the box [m]."""
TORQUE = 10.0
"""Torque of an action of 1, in addition to what holds the arm [N m]."""
ANGLE_LOW = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)
ANGLE_HIGH = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)
"""Joint angles beyond which each radian costs 1."""
SPEED_MAX = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)
"""Joint velocities beyond which each radian per second costs 1."""
ROD_DISTANCE_MIN = 0.05
"""Distance of rod and box below which coming closer is not rewarded [m]."""
INCLINATION_FREE = np.pi / 4
"""Inclination of the rod up to which it costs nothing [rad]."""
FINAL_SCALE = 100.0
"""Weight of the last step's distances in the sparse reward."""
FINAL_SPEED_COST = 50.0
SUCCESS_DISTANCE, SUCCESS_ANGLE = 0.05, 0.5
"""Distance [m] and angle [rad] from the goal below which it counts as reached."""
BOX, GOAL = slice(14, 21), slice(21, 28)
"""Entries of the box's and the goal's pose in an observation."""


class BoxPushing(StepwiseTask):
    """What both tasks share; they differ in their rewards."""

    frame_skip = 10
    episode_steps = 100
    recorded = ("qpos", "qvel", "mocap_pos", "mocap_quat", "qfrc_bias")
    camera: ClassVar[Mapping[str, Any]] = {
        "distance": 1.5,
        "elevation": -32.0,
        "azimuth": 150.0,
        "lookat": (0.3, 0.0, 0.2),
    }
    goal_in_pictures = "translucent box"
    energy_cost: float
    """Cost of a squared torque [1/(N m)²]."""

    def __init__(self, env_count: int) -> None:
        super().__init__(env_count)
        self.action_high = np.ones(JOINTS, np.float32)
        self.action_low = -self.action_high
        self._torque_max = np.array(TORQUE_MAX)
        self._kinematics = ForwardKinematics(self.model, env_count)

    def load_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        return box_pushing_model(with_decoration=False)

    def picture_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        return box_pushing_model(with_decoration=True)

    def observation_names(self) -> list[str]:  # noqa: D102 - inherited
        joints = range(1, JOINTS + 1)
        names = [f"angle_joint{joint}" for joint in joints]
        names += [f"velocity_joint{joint}" for joint in joints]
        for body in ("box", "goal"):
            names += [f"{body}_{axis}" for axis in "xyz"]
            names += [f"{body}_quaternion_{part}" for part in "wxyz"]
        return names

    def draw_start(  # noqa: D102 - inherited
        self, rng: np.random.Generator, start: Start
    ) -> None:
        start.qpos[:JOINTS] = START_ANGLES
        start.qpos[JOINTS:] = BOX_START
        while True:
            position = rng.uniform(*GOAL_RANGE)
            angle = rng.uniform(0.0, 2.0 * np.pi)
            if np.linalg.norm(position[:2] - BOX_START[:2]) >= GOAL_DISTANCE_MIN:
                break
        start.mocap_pos[0] = position
        # fancy-gym exchanges sine and cosine: this is a turn by π minus the angle.
        start.mocap_quat[0] = np.sin(angle / 2.0), 0.0, 0.0, np.cos(angle / 2.0)

    def observe(self, fields: Fields, out: NDArray[np.float64]) -> None:  # noqa: D102 - inherited
        out[..., :JOINTS] = fields["qpos"][..., :JOINTS]
        out[..., JOINTS : 2 * JOINTS] = fields["qvel"][..., :JOINTS]
        out[..., BOX] = fields["qpos"][..., JOINTS:]
        out[..., 21:24] = fields["mocap_pos"][..., 0, :]
        out[..., 24:28] = fields["mocap_quat"][..., 0, :]

    def targets(  # noqa: D102 - inherited
        self, fields: Fields, actions: NDArray[np.float32], out: NDArray[np.float64]
    ) -> None:
        np.clip(actions, -1.0, 1.0, out=out)
        out *= TORQUE
        # Gravity and Coriolis forces at the start of the step.
        out += fields["qfrc_bias"][:, :JOINTS]
        np.clip(out, -self._torque_max, self._torque_max, out=out)

    def rewards(  # noqa: D102 - inherited
        self,
        observations: NDArray[np.float64],
        actions: NDArray[np.float32],
        out: NDArray[np.float64],
    ) -> None:
        rows = observations[:, 1:]
        torques = np.clip(actions, -1.0, 1.0, dtype=np.float64)
        torques *= TORQUE
        np.multiply(np.vecdot(torques, torques), -self.energy_cost, out=out)
        out -= limit_cost(rows)
        for step in range(out.shape[1]):
            self._add_rod_reward(rows[:, step], out[:, step])

    def _add_rod_reward(self, rows: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        """Adds the reward (E,) of the rod's position and inclination in states (E, O)."""
        pose = self._kinematics.pose(rows[:, :JOINTS])
        distance = norm(rows[:, 14:17] - pose[:, :, 3])
        out -= 2.0 * np.maximum(distance, ROD_DISTANCE_MIN)
        inclination = angle_from_down(pose)
        out -= np.where(inclination > INCLINATION_FREE, inclination / np.pi, 0.0)

    def successes(  # noqa: D102 - inherited
        self, observations: NDArray[np.float64], out: NDArray[np.uint8]
    ) -> None:
        out[:] = (goal_distance(observations) < SUCCESS_DISTANCE) & (
            goal_angle(observations) < SUCCESS_ANGLE
        )


class BoxPushingDense(BoxPushing):
    """Rewards a small distance and angle from the goal in each step."""

    id = "dmprl/BoxPushingDense-v0"
    energy_cost = 0.0005

    def rewards(  # noqa: D102 - inherited
        self,
        observations: NDArray[np.float64],
        actions: NDArray[np.float32],
        out: NDArray[np.float64],
    ) -> None:
        super().rewards(observations, actions, out)
        out -= goal_cost(observations[:, 1:])


class BoxPushingTemporalSparse(BoxPushing):
    """Rewards a small distance and angle from the goal, and a slow arm, only in step 100."""

    id = "dmprl/BoxPushingTemporalSparse-v0"
    energy_cost = 0.02

    def __init__(self, env_count: int) -> None:
        super().__init__(env_count)
        self._elapsed = np.zeros(env_count, np.int64)

    def episodes_began(self, indices: NDArray[np.int32]) -> None:  # noqa: D102 - inherited
        self._elapsed[indices] = 0

    def rewards(  # noqa: D102 - inherited
        self,
        observations: NDArray[np.float64],
        actions: NDArray[np.float32],
        out: NDArray[np.float64],
    ) -> None:
        super().rewards(observations, actions, out)
        for step in range(out.shape[1]):
            self._elapsed += 1
            if (ended := self._elapsed == self.episode_steps).any():
                last = observations[ended, step + 1]
                cost = FINAL_SCALE * goal_cost(last)
                cost += FINAL_SPEED_COST * norm(last[:, JOINTS : 2 * JOINTS])
                out[ended, step] -= cost


def goal_cost(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes the cost (…) of the distance and angle to the goal in states (…, O)."""
    return 3.5 * goal_distance(rows) + goal_angle(rows) / np.pi


def goal_distance(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes the distance (…) of box and goal in states (…, O) [m]."""
    return norm(rows[..., 14:17] - rows[..., 21:24])


def goal_angle(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes the angle (…) between box and goal in states (…, O) [rad]."""
    cosine = np.abs(np.vecdot(rows[..., 17:21], rows[..., 24:28]))
    return 2.0 * np.arccos(np.minimum(cosine, 1.0))


def limit_cost(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes the cost (…) of angles and velocities beyond the joints' limits."""
    angles, speeds = rows[..., :JOINTS], np.abs(rows[..., JOINTS : 2 * JOINTS])
    beyond = np.maximum(angles - ANGLE_HIGH, 0.0)
    beyond += np.maximum(ANGLE_LOW - angles, 0.0)
    beyond += np.maximum(speeds - SPEED_MAX, 0.0)
    return np.sum(beyond, axis=-1)


def angle_from_down(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes the angle (E,) of poses (E, 3, 4) from a half turn about x, the rod upright [rad].

    It is the rotation's angle, so turning the rod about itself counts, too.
    """
    square = 1.0 + pose[:, 0, 0] - pose[:, 1, 1] - pose[:, 2, 2]
    return 2.0 * np.arccos(0.5 * np.sqrt(np.clip(square, 0.0, 4.0)))


def norm(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes the Euclidean norms (…) of vectors (…, n)."""
    return np.sqrt(np.vecdot(vectors, vectors))

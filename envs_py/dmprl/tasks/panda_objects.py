"""Four tasks in which a Franka Panda moves objects: push, slide, pick and place, stack.

These are panda-gym's tasks in MuJoCo, with its objects, starts, goals, actions, rewards and timing.
Each has a sparse and a dense reward, and displacements of the end effector or of the joints as
actions. The differences are those of :mod:`dmprl.tasks.panda`: reaching the goal does not end the
episode, the arm does not sag, and the observation holds more:

- With joint displacements, the joints' angles and velocities come first.
- The fingers' velocity follows their width, so that a movement primitive can start from both.
- Each object's position relative to the end effector follows its velocities. Whether the arm
  touches an object depends on this small difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from dmprl.goal_task import GoalTask
from dmprl.mujoco_batch import Fields, Start
from dmprl.tasks.panda import DISPLACEMENT, NEUTRAL
from dmprl.tasks.panda_kinematics import JOINTS, InverseKinematics
from dmprl.tasks.panda_scene import BLUE, PUCK_FRICTION, Scene, cube, puck, scene_model

FINGERS = slice(JOINTS, JOINTS + 2)
"""Entries of the fingers in positions, velocities and controls."""
WIDTH_CHANGE = 0.2
"""Change of the fingers' width by an action of 1 in one step [m]."""
OBJECT_RANGE = (-0.15, -0.15, 0.0), (0.15, 0.15, 0.0)
"""Corners of the square in which objects start [m]."""
ON_TABLE_SHARE = 0.3
"""Share of the goals of pick and place that are on the table, besides those in its box."""
POSE_ENTRIES = 7
"""Entries of a free object in the positions: its position and a quaternion."""
OBJECT_ENTRIES = 15
"""Entries of an object in an observation: position, rotation, both velocities, and position
relative to the end effector."""


class PandaObjects(GoalTask):
    """A task with displacements of the end effector, and of fingers that move, as actions."""

    frame_skip = 20
    episode_steps = 50
    recorded: tuple[str, ...] = tuple(
        sorted({"qpos", "qvel", "mocap_pos", "sensordata", *InverseKinematics.recorded})
    )
    camera: ClassVar[Mapping[str, Any]] = {
        "distance": 1.05,
        "elevation": -28.0,
        "azimuth": 155.0,
        "lookat": (-0.1, 0.0, 0.1),
    }
    goal_in_pictures = "translucent object"
    scene: Scene
    goal_range: ClassVar[tuple[tuple[float, ...], ...]] = OBJECT_RANGE
    """Corners of the box from which goals are drawn [m]; heights are above the table."""
    arm_entries = 0
    """Entries of the arm's joints in an observation."""
    arm_action_len = 3

    def __init__(self, env_count: int) -> None:
        super().__init__(env_count)
        action_len = self.arm_action_len + self.scene.has_gripper
        self.action_high = np.ones(action_len, np.float32)
        self.action_low = -self.action_high
        self._clipped = np.zeros((env_count, action_len))
        self._kinematics = InverseKinematics(self.model, env_count)
        self._objects_qpos = JOINTS + 2 * self.scene.has_gripper
        # Objects start as high as at their goals: each above those before it.
        self._heights = [
            (1 + 2 * layer) * moved.start_height for layer, moved in enumerate(self.scene.objects)
        ]

    @property
    def goal_len(self) -> int:  # noqa: D102 - inherited
        return 3 * len(self.scene.objects)

    def load_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        return scene_model(self.scene, with_decoration=False)

    def picture_model(self) -> mujoco.MjModel:  # noqa: D102 - inherited
        return scene_model(self.scene, with_decoration=True)

    def observation_names(self) -> list[str]:  # noqa: D102 - inherited
        objects = [f"object{n + 1}" for n in range(len(self.scene.objects))]
        objects = objects if len(objects) > 1 else ["object"]
        names = [f"achieved_{name}_{axis}" for name in objects for axis in "xyz"]
        names += [f"desired_{name}_{axis}" for name in objects for axis in "xyz"]
        joints = range(1, self.arm_entries // 2 + 1)
        names += [f"angle_joint{joint}" for joint in joints]
        names += [f"velocity_joint{joint}" for joint in joints]
        names += [f"end_effector_{axis}" for axis in "xyz"]
        names += [f"velocity_end_effector_{axis}" for axis in "xyz"]
        if self.scene.has_gripper:
            names += ["width_fingers", "velocity_fingers"]
        for name in objects:
            names += [f"{name}_{axis}" for axis in "xyz"]
            names += [f"{angle}_{name}" for angle in ("roll", "pitch", "yaw")]
            names += [f"velocity_{name}_{axis}" for axis in "xyz"]
            names += [f"angular_velocity_{name}_{axis}" for axis in "xyz"]
            names += [f"end_effector_to_{name}_{axis}" for axis in "xyz"]
        return names

    def draw_start(  # noqa: D102 - inherited
        self, rng: np.random.Generator, start: Start
    ) -> None:
        start.qpos[:JOINTS] = NEUTRAL
        # As panda-gym from the same seed: first the goal, then the objects, with heights.
        start.mocap_pos[:] = self.draw_goal(rng)
        start.mocap_pos[:, 2] += self._heights
        poses = start.qpos[self._objects_qpos :].reshape(-1, POSE_ENTRIES)
        for pose, height in zip(poses, self._heights, strict=True):
            pose[:3] = rng.uniform(*OBJECT_RANGE)
            pose[2] = height

    def draw_goal(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draws the goal (3,) of the lowest object, relative to the origin at its height."""
        return rng.uniform(*self.goal_range)

    def observe(self, fields: Fields, out: NDArray[np.float64]) -> None:  # noqa: D102 - inherited
        length, sensors = self.goal_len, fields["sensordata"]
        out[..., length : 2 * length] = fields["mocap_pos"].reshape(*out.shape[:-1], length)
        self.observe_arm(fields, out[..., 2 * length :])
        at = 2 * length + self.arm_entries
        out[..., at : at + 3] = fields["site_xpos"][..., 0, :]
        out[..., at + 3 : at + 6] = sensors[..., :3]
        at += 6
        if self.scene.has_gripper:
            np.sum(fields["qpos"][..., FINGERS], axis=-1, out=out[..., at])
            np.sum(fields["qvel"][..., FINGERS], axis=-1, out=out[..., at + 1])
            at += 2
        for index in range(len(self.scene.objects)):
            first = self._objects_qpos + POSE_ENTRIES * index
            pose = fields["qpos"][..., first : first + POSE_ENTRIES]
            out[..., 3 * index : 3 * index + 3] = pose[..., :3]
            out[..., at : at + 3] = pose[..., :3]
            euler_angles(pose[..., 3:], out[..., at + 3 : at + 6])
            out[..., at + 6 : at + 12] = sensors[..., 3 + 6 * index : 9 + 6 * index]
            np.subtract(
                pose[..., :3], fields["site_xpos"][..., 0, :], out=out[..., at + 12 : at + 15]
            )
            at += OBJECT_ENTRIES

    def observe_arm(self, fields: Fields, out: NDArray[np.float64]) -> None:
        """Writes the first ``arm_entries`` entries of ``out``."""

    def targets(  # noqa: D102 - inherited
        self, fields: Fields, actions: NDArray[np.float32], out: NDArray[np.float64]
    ) -> None:
        clipped = np.clip(actions, -1.0, 1.0, out=self._clipped)
        if self.scene.has_gripper:
            width = np.sum(fields["qpos"][:, FINGERS], axis=1)
            width += WIDTH_CHANGE * clipped[:, -1]
            out[:, FINGERS] = 0.5 * width[:, None]
        displacement = clipped[:, : self.arm_action_len]
        displacement *= DISPLACEMENT
        self.move_arm(fields, displacement, out[:, :JOINTS])

    def move_arm(
        self, fields: Fields, displacement: NDArray[np.float64], out: NDArray[np.float64]
    ) -> None:
        """Writes the joints' targets (E, 7) for a displacement [rad or m], which may be changed."""
        self._kinematics.displace(fields, displacement, out)


class JointControl(PandaObjects):
    """Replaces displacements of the end effector by those of the seven joints."""

    arm_entries = 2 * JOINTS
    arm_action_len = JOINTS

    def observe_arm(  # noqa: D102 - inherited
        self, fields: Fields, out: NDArray[np.float64]
    ) -> None:
        out[..., :JOINTS] = fields["qpos"][..., :JOINTS]
        out[..., JOINTS : 2 * JOINTS] = fields["qvel"][..., :JOINTS]

    def move_arm(  # noqa: D102 - inherited
        self, fields: Fields, displacement: NDArray[np.float64], out: NDArray[np.float64]
    ) -> None:
        np.add(fields["qpos"][:, :JOINTS], displacement, out=out)


class PandaPush(PandaObjects):
    """Pushes a cube over the table to its goal, with the gripper closed."""

    id = "dmprl/PandaPush-v0"
    scene = Scene((cube(),))


class PandaPushDense(PandaPush):
    """Push with a dense reward."""

    id = "dmprl/PandaPushDense-v0"
    sparse = False


class PandaPushJoints(JointControl, PandaPush):
    """Push with joint displacements."""

    id = "dmprl/PandaPushJoints-v0"


class PandaPushJointsDense(PandaPushJoints):
    """Push with joint displacements and a dense reward."""

    id = "dmprl/PandaPushJointsDense-v0"
    sparse = False


class PandaSlide(PandaObjects):
    """Makes a puck slide to a goal out of the arm's reach, with the gripper closed.

    The puck slides for up to the length of an episode. So where it is at the end depends on the
    remaining time, which the observation has as its last entry, from 1 to 0.
    """

    id = "dmprl/PandaSlide-v0"
    camera: ClassVar[Mapping[str, Any]] = {
        "distance": 1.4,
        "elevation": -28.0,
        "azimuth": 145.0,
        "lookat": (0.02, 0.0, 0.08),
    }
    scene = Scene(
        (puck(),), table_x=(-0.8, 0.6), has_edges=False, finger_friction=2.0 * PUCK_FRICTION
    )
    goal_range = ((0.25, -0.15, 0.0), (0.55, 0.15, 0.0))
    recorded: tuple[str, ...] = (*PandaObjects.recorded, "time")

    def observation_names(self) -> list[str]:  # noqa: D102 - inherited
        return [*super().observation_names(), "remaining_time"]

    def observe(self, fields: Fields, out: NDArray[np.float64]) -> None:  # noqa: D102 - inherited
        super().observe(fields, out)
        seconds = self.episode_steps * self.frame_skip * self.model.opt.timestep
        out[..., -1] = 1.0 - fields["time"] / seconds


class PandaSlideDense(PandaSlide):
    """Slide with a dense reward."""

    id = "dmprl/PandaSlideDense-v0"
    sparse = False


class PandaSlideJoints(JointControl, PandaSlide):
    """Slide with joint displacements."""

    id = "dmprl/PandaSlideJoints-v0"


class PandaSlideJointsDense(PandaSlideJoints):
    """Slide with joint displacements and a dense reward."""

    id = "dmprl/PandaSlideJointsDense-v0"
    sparse = False


class PandaPickAndPlace(PandaObjects):
    """Brings a cube to a goal on or above the table."""

    id = "dmprl/PandaPickAndPlace-v0"
    scene = Scene((cube(),), has_gripper=True)
    goal_range = ((-0.15, -0.15, 0.0), (0.15, 0.15, 0.2))

    def draw_goal(self, rng: np.random.Generator) -> NDArray[np.float64]:  # noqa: D102 - inherited
        goal = super().draw_goal(rng)
        if rng.random() < ON_TABLE_SHARE:
            goal[2] = 0.0
        return goal


class PandaPickAndPlaceDense(PandaPickAndPlace):
    """Pick and place with a dense reward."""

    id = "dmprl/PandaPickAndPlaceDense-v0"
    sparse = False


class PandaPickAndPlaceJoints(JointControl, PandaPickAndPlace):
    """Pick and place with joint displacements."""

    id = "dmprl/PandaPickAndPlaceJoints-v0"


class PandaPickAndPlaceJointsDense(PandaPickAndPlaceJoints):
    """Pick and place with joint displacements and a dense reward."""

    id = "dmprl/PandaPickAndPlaceJointsDense-v0"
    sparse = False


class PandaStack(PandaObjects):
    """Brings a heavy cube to a goal on the table, and a lighter one on top of it."""

    id = "dmprl/PandaStack-v0"
    episode_steps = 100
    success_distance = 0.1
    """Distance of both cubes' positions, taken as one point with six coordinates."""
    scene = Scene((cube(2.0, BLUE), cube()), has_gripper=True)


class PandaStackDense(PandaStack):
    """Stack with a dense reward."""

    id = "dmprl/PandaStackDense-v0"
    sparse = False


class PandaStackJoints(JointControl, PandaStack):
    """Stack with joint displacements."""

    id = "dmprl/PandaStackJoints-v0"


class PandaStackJointsDense(PandaStackJoints):
    """Stack with joint displacements and a dense reward."""

    id = "dmprl/PandaStackJointsDense-v0"
    sparse = False


def euler_angles(quaternion: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Writes roll, pitch and yaw (…, 3) [rad] of unit quaternions (…, 4), w first, as Bullet does.

    They are the angles about the fixed axes x, y and z, applied in this order.
    """
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y), out=out[..., 0])
    np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0), out=out[..., 1])
    np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z), out=out[..., 2])

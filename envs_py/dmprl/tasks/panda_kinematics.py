"""Solves the Panda's inverse kinematics for small displacements, for all environments together.

The method is damped least squares. MuJoCo has already computed the parts of the Jacobian at the
start, so the first iteration costs little more than a matrix inverse. Later iterations correct that
inverse with their own results (Broyden's method) instead of computing a new one, so each costs
little more than a forward pose. In the box of the goals, for displacements up to 0.05 m along each
axis, 99.9 % of the measured errors are below 0.3 mm.

Rejected alternatives: the first inverse in every iteration (5 mm at nearly the same cost), a new
inverse in every iteration (no better at twice the cost), and a second :class:`mujoco.batch.Batch`
for the poses, which also computes unneeded dynamics.

Shapes: E environments; a pose is a 3 x 4 matrix [rotation, position]. No matrix product mixes
environments, so the results are bit-identical for any number of environments.
"""

from __future__ import annotations

from itertools import pairwise

import mujoco
import numpy as np
from numpy.typing import NDArray

from dmprl.mujoco_batch import Fields

JOINTS = 7

CORRECTIONS = 2
"""Iterations after the first. With one, errors reach 3 mm; a third gains less than the resolution
of a servo."""

DAMPING = 0.05
"""Damping of the least squares. It prevents large joint motions near singular (stretched or folded)
poses, where they cannot move the end effector in some direction."""

GROWTH_MAX = 2.0
"""Maximum factor by which Broyden's method lengthens a step; larger ones are unreliable."""

TURN_MAX = 0.5
"""Maximum change of a joint [rad]. A larger one means that the target is out of reach."""

TINY = 1e-30
"""Added to squared norms, so that quotients are finite in environments without motion."""

_IDENTITY = np.eye(6)


class ForwardKinematics:
    """Computes the pose of the end effector, the model's first site."""

    def __init__(self, model: mujoco.MjModel, env_count: int) -> None:
        """Reads the chain from ``model``: its joints, each the parent of the next, then a site."""
        self._chain = _chain(model)
        # For each joint: 1, and the cosine and sine of its angle.
        self._turns = np.ones((env_count, JOINTS, 1, 3))
        # The transform of each joint's link, and of the end effector on the last link.
        self._links = np.zeros((env_count, JOINTS + 1, 1, 16))
        self._links[:, -1, 0] = _transform(model.site_pos[0], model.site_quat[0]).ravel()

    def pose(self, angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Computes the end effector's pose (E, 3, 4) at ``angles`` (E, 7) [rad]."""
        np.cos(angles, out=self._turns[:, :, 0, 1])
        np.sin(angles, out=self._turns[:, :, 0, 2])
        np.matmul(self._turns, self._chain, out=self._links[:, :JOINTS])
        transforms = self._links.reshape(-1, JOINTS + 1, 4, 4)
        while transforms.shape[1] > 1:
            transforms = transforms[:, 0::2] @ transforms[:, 1::2]
        return transforms[:, 0, :3]


class InverseKinematics:
    """Computes joint angles that bring the end effector to a point, with the gripper down."""

    recorded = ("site_xpos", "site_xmat", "cdof", "subtree_com")
    """Fields of MjData that :meth:`solve` reads besides qpos."""

    def __init__(self, model: mujoco.MjModel, env_count: int) -> None:
        """Reads the chain from ``model``: its joints, each the parent of the next, then a site."""
        self._forward = ForwardKinematics(model, env_count)
        self._error_of_pose = _error_of_pose()
        self._skew = _skew()
        self._root = model.body_rootid[model.jnt_bodyid[0]]
        self._start = np.zeros((env_count, 3, 4))
        self._damping = DAMPING**2 * np.eye(6)

    def displace(
        self, fields: Fields, displacement: NDArray[np.float64], out: NDArray[np.float64]
    ) -> None:
        """Writes the joint angles that move the end effector, but not below the table.

        As :meth:`solve`, with a ``displacement`` (E, 3) [m] from the current position. It is
        overwritten.
        """
        displacement += fields["site_xpos"][:, 0]
        np.maximum(displacement[:, 2], 0.0, out=displacement[:, 2])
        self.solve(fields, displacement, out)

    def solve(self, fields: Fields, target: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        """Writes the joint angles that bring the end effector to a point.

        - ``fields``: current qpos and :attr:`recorded`; the arm's joints are the model's first.
        - ``target`` (E, 3): the point [m].
        - ``out`` (E, 7): angles [rad].
        """
        qpos, start = fields["qpos"][:, :JOINTS], self._start
        start[:, :, :3] = fields["site_xmat"][:, 0].reshape(-1, 3, 3)
        start[:, :, 3] = fields["site_xpos"][:, 0]
        inverse = self._inverse_at(fields)
        step = self._step(inverse, start, target)
        turn, steps = step.copy(), []
        for _ in range(CORRECTIONS):
            steps.append((step, np.vecdot(step, step) + TINY))
            step = _corrected(self._step(inverse, self._forward.pose(qpos + turn), target), steps)
            turn += step
        largest = np.abs(turn).max(axis=1, keepdims=True)
        # Scales all joints, so that the end effector still moves towards the target.
        turn *= TURN_MAX / np.maximum(largest, TURN_MAX)
        np.add(qpos, turn, out=out)

    def _step(
        self,
        inverse: NDArray[np.float64],
        pose: NDArray[np.float64],
        target: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Computes the joint displacement (E, 7) from ``pose`` to the target, to first order."""
        error = pose.reshape(-1, 1, 12) @ self._error_of_pose
        error[:, 0, 3:] += target
        return (inverse @ error.transpose(0, 2, 1))[:, :, 0]

    def _inverse_at(self, fields: Fields) -> NDArray[np.float64]:
        """Computes the damped inverse (E, 7, 6) of the Jacobian.

        The Jacobian's rows are the angular and the linear velocity. MuJoCo's cdof is the transposed
        Jacobian (E, 7, 6) at the arm's centre of mass.
        """
        lever = fields["site_xpos"][:, 0] - fields["subtree_com"][:, self._root]
        shift = (lever[:, None] @ self._skew).reshape(-1, 6, 6)
        shift += _IDENTITY
        transposed = fields["cdof"][:, :JOINTS] @ shift
        square = transposed.transpose(0, 2, 1) @ transposed
        square += self._damping
        return transposed @ np.linalg.inv(square)


def _corrected(
    step: NDArray[np.float64], steps: list[tuple[NDArray[np.float64], NDArray[np.float64]]]
) -> NDArray[np.float64]:
    """Corrects a step of the first inverse, using the previous ``steps`` with their squared norms.

    This is Broyden's "good" update of the inverse, applied to vectors without forming a matrix, as
    in Kelley (1995).
    """
    for (earlier, square), (later, _) in pairwise(steps):
        step += later * (np.vecdot(step, earlier) / square)[:, None]
    last, square = steps[-1]
    step /= np.maximum(1.0 - np.vecdot(step, last) / square, 1.0 / GROWTH_MAX)[:, None]
    return step


def _chain(model: mujoco.MjModel) -> NDArray[np.float64]:
    """Computes the factors of 1, cosine and sine of each joint's angle (7, 3, 16).

    Their weighted sum is the pose of the link that the joint turns in its parent's frame.
    """
    chain = np.zeros((3, JOINTS, 4, 4))
    chain[0, :, 2, 2] = chain[0, :, 3, 3] = 1.0
    chain[1, :, 0, 0] = chain[1, :, 1, 1] = 1.0
    chain[2, :, 1, 0], chain[2, :, 0, 1] = 1.0, -1.0
    bodies = model.jnt_bodyid[:JOINTS]
    links = map(_transform, model.body_pos[bodies], model.body_quat[bodies])
    chain = np.array(list(links)) @ chain
    return np.ascontiguousarray(chain.reshape(3, JOINTS, 16).transpose(1, 0, 2))


def _transform(
    position: NDArray[np.float64], quaternion: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the transform (4, 4) of a body or a site in its parent's frame."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    transform = np.eye(4)
    transform[:3, :3] = rotation.reshape(3, 3)
    transform[:3, 3] = position
    return transform


def _error_of_pose() -> NDArray[np.float64]:
    """Returns the matrix (12, 6) that maps a pose to its error, without the target's position.

    The rotational error is half the sum of the cross products of the gripper's axes with
    (1, 0, 0), (0, -1, 0) and (0, 0, -1), their directions when it points down. For a small rotation
    this is the rotation vector that reverts it. The error of the position is minus the position.
    """
    matrix = np.zeros((3, 4, 6))
    matrix[2, 1, 0], matrix[1, 2, 0] = 0.5, -0.5
    matrix[2, 0, 1] = matrix[0, 2, 1] = 0.5
    matrix[1, 0, 2] = matrix[0, 1, 2] = -0.5
    for axis in range(3):
        matrix[axis, 3, 3 + axis] = -1.0
    return matrix.reshape(12, 6)


def _skew() -> NDArray[np.float64]:
    """Returns the matrix (3, 36) from a lever arm to the map from angular to linear velocity."""
    matrix = np.zeros((3, 6, 6))
    for first, second, third in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrix[second, first, 3 + third] = 1.0
        matrix[first, second, 3 + third] = -1.0
    return matrix.reshape(3, 36)

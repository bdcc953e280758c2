"""dmprl's Panda compared with the one in PyBullet's package (extra `panda-gym`)."""

import unittest
from pathlib import Path

import mujoco
import numpy as np
import pybullet
import pybullet_data

from dmprl.tasks.models import own_model
from dmprl.tasks.panda import MODEL, NEUTRAL

ARM, END_EFFECTOR = range(7), 11
"""Joints of PyBullet's URDF, and the link that panda-gym controls."""


class KinematicsTest(unittest.TestCase):
    def setUp(self):
        self.client = pybullet.connect(pybullet.DIRECT)
        self.addCleanup(pybullet.disconnect, self.client)
        self.arm = pybullet.loadURDF(
            str(Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"),
            basePosition=(-0.6, 0.0, 0.0),
            useFixedBase=True,
            physicsClientId=self.client,
        )
        self.model = own_model(MODEL)
        self.data = mujoco.MjData(self.model)

    def theirs(self, angles):
        """Returns position and rotation matrix of the end effector in PyBullet."""
        for joint, angle in zip(ARM, angles, strict=True):
            pybullet.resetJointState(self.arm, joint, angle, physicsClientId=self.client)
        state = pybullet.getLinkState(
            self.arm, END_EFFECTOR, computeForwardKinematics=True, physicsClientId=self.client
        )
        return np.array(state[4]), np.array(pybullet.getMatrixFromQuaternion(state[5]))

    def ours(self, angles):
        self.data.qpos[:] = angles
        mujoco.mj_kinematics(self.model, self.data)
        site = self.model.site("ee").id
        return self.data.site_xpos[site], self.data.site_xmat[site]

    def test_end_effector_agrees_with_pybullets_at_1000_random_poses(self):
        rng = np.random.default_rng(0)
        poses = [NEUTRAL, *rng.uniform(*self.model.jnt_range.T, (1000, 7))]
        position_error = rotation_error = 0.0
        for angles in poses:
            (position, rotation), (our_position, our_rotation) = (
                self.theirs(angles),
                self.ours(angles),
            )
            position_error = max(position_error, np.linalg.norm(position - our_position))
            rotation_error = max(rotation_error, np.abs(rotation - our_rotation).max())
        self.assertLess(position_error, 1e-3)
        self.assertLess(rotation_error, 1e-3)

    def test_masses_agree_with_pybullets(self):
        theirs = [pybullet.getDynamicsInfo(self.arm, link)[0] for link in range(11)]
        np.testing.assert_allclose(self.model.body_mass[-7:-1], theirs[:6], rtol=1e-9)
        # Link 7 carries flange, hand and fingers.
        self.assertAlmostEqual(self.model.body_mass[-1], sum(theirs[6:]), places=9)


if __name__ == "__main__":
    unittest.main()

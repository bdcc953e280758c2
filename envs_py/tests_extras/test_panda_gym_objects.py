"""dmprl's Panda tasks with objects, compared with panda-gym's own (extra `panda-gym`)."""

import unittest

import gymnasium
import numpy as np
import panda_gym  # noqa: F401 - registers its tasks
import pybullet

import dmprl  # noqa: F401 - registers its tasks
from dmprl.tasks import PANDA_OBJECTS
from dmprl.tasks.panda_objects import euler_angles


class PandaGymTest(unittest.TestCase):
    def test_rewards_and_successes_of_1000_random_states_are_equal(self):
        rng = np.random.default_rng(0)
        for name in PANDA_OBJECTS:
            for suffix in ("", "Dense"):
                ours = gymnasium.make(f"dmprl/{name}{suffix}-v0").unwrapped
                theirs = gymnasium.make(f"{name}{suffix}-v3").unwrapped
                length = ours.task.goal_len
                achieved = rng.uniform(-0.3, 0.3, (1000, length))
                spread = ours.task.success_distance / np.sqrt(length)
                desired = achieved + spread * rng.normal(size=achieved.shape)
                rewards = ours.compute_reward(achieved, desired, {})
                expected = theirs.compute_reward(achieved, desired, {})
                np.testing.assert_allclose(rewards, expected, rtol=1e-6)
                success = np.zeros(1000, np.uint8)
                ours.task.successes(np.hstack([achieved, desired]), success)
                np.testing.assert_array_equal(success, theirs.task.is_success(achieved, desired))
                self.assertTrue(100 < success.sum() < 900)
                theirs.close()

    def test_starts_and_goals_of_200_seeds_are_equal(self):
        for name in PANDA_OBJECTS:
            ours, theirs = gymnasium.make(f"dmprl/{name}-v0"), gymnasium.make(f"{name}-v3")
            for seed in range(200):
                row, expected = ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0]
                for key in ("achieved_goal", "desired_goal"):
                    np.testing.assert_allclose(row[key], expected[key], atol=1e-6)
            theirs.close()

    def test_actions_and_episodes_have_the_same_sizes(self):
        for name in PANDA_OBJECTS:
            for variant in ("", "Dense", "Joints", "JointsDense"):
                ours = gymnasium.make(f"dmprl/{name}{variant}-v0")
                theirs = gymnasium.make(f"{name}{variant}-v3")
                self.assertEqual(ours.action_space, theirs.action_space)
                self.assertEqual(ours.spec.max_episode_steps, theirs.spec.max_episode_steps)
                theirs.close()

    def test_euler_angles_are_bullets(self):
        rng = np.random.default_rng(0)
        quaternions, found = rng.normal(size=(1000, 4)), np.zeros((1000, 3))
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        euler_angles(quaternions, found)
        for (w, x, y, z), angles in zip(quaternions, found, strict=True):
            expected = pybullet.getEulerFromQuaternion((x, y, z, w))
            np.testing.assert_allclose(angles, expected, atol=1e-6)


if __name__ == "__main__":
    unittest.main()

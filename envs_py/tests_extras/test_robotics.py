"""Gymnasium-Robotics' Fetch, run as in a worker (extra `robotics`)."""

import subprocess
import sys
import unittest

import gymnasium
import numpy as np

from dmprl.env_options import NO_OPTIONS, EnvOptions, Randomise
from dmprl.goal_rule import proven
from dmprl.robotics_repair import RobotReader
from dmprl.segment_env import GoalRows, SegmentBuffers, make


def started(task_id, env_count, segment_steps, options=NO_OPTIONS):
    env = make(f"gymnasium_robotics:{task_id}", env_count, segment_steps, options)
    spec = env.spec()
    out = SegmentBuffers(env_count, segment_steps, spec["observation_len"], spec["action_len"])
    env.reset(np.ones(env_count, np.uint8), np.arange(env_count, dtype=np.uint64), out)
    return env, out


class FetchTest(unittest.TestCase):
    def test_sizes_and_timing_are_those_of_fetch(self):
        env, _ = started("FetchReach-v4", 1, 5)
        spec = env.spec()
        self.assertEqual((spec["observation_len"], spec["action_len"]), (16, 4))
        self.assertAlmostEqual(spec["control_dt_s"], 0.04)
        self.assertEqual(spec["episode_steps"], 50)

    def test_observation_is_achieved_goal_then_desired_goal_then_observation(self):
        """The Dict's entries by name: gripper (3), goal (3), gripper, fingers, velocities (10)."""
        env, out = started("FetchReach-v4", 4, 5)
        entries = env._envs[0].env.observation_space
        self.assertEqual(list(entries), ["achieved_goal", "desired_goal", "observation"])
        row = out.next_observations
        np.testing.assert_array_equal(row[:, 0:3], row[:, 6:9])
        self.assertEqual(len({goal.tobytes() for goal in row[:, 3:6]}), 4)

    def test_its_block_is_resized_and_moved_and_the_goal_is_not(self):
        ranges = Randomise(mass=(2.0, 3.0), object_size=(1.2, 1.2), start_pose=(0.01, 0.01))
        env, out = started("FetchPush-v4", 2, 5, EnvOptions(randomise=ranges))
        _, plain = started("FetchPush-v4", 2, 5)
        moved = out.next_observations - plain.next_observations
        # The block is 5 cm high.
        np.testing.assert_allclose(moved[:, :3], [[0.01, 0.01, 0.2 * 0.025]] * 2, atol=1e-9)
        np.testing.assert_array_equal(moved[:, 3:6], 0.0)
        env.step_segment(np.zeros((2, 5, 4)), out)
        self.assertFalse(out.failed.any())

    def test_joints_found_once_have_the_values_that_gymnasium_robotics_finds_by_name(self):
        from gymnasium_robotics.utils import mujoco_utils

        started("FetchPush-v4", 1, 5)
        reader = mujoco_utils.robot_get_obs
        self.assertIsInstance(reader, RobotReader)
        for task_id in ("FetchPush-v4", "HandReach-v3"):
            env = gymnasium.make(task_id).unwrapped
            env.reset(seed=3)
            env.step(env.action_space.sample())
            names = env._model_names.joint_names
            found = reader(env.model, env.data, names)
            by_name = reader._original(env.model, env.data, names)
            self.assertGreater(found[0].size, 10, task_id)
            for got, want in zip(found, by_name, strict=True):
                np.testing.assert_array_equal(got, want)
        # One joint is a number there.
        names = [name for name in names if name.startswith("robot")][:1]
        self.assertEqual(reader(env.model, env.data, names)[0].shape, ())

    def test_straight_to_the_goal_succeeds(self):
        env, out = started("FetchReachDense-v4", 4, 5)
        for _ in range(10):
            row = out.next_observations
            actions = np.zeros((4, 5, 4))
            actions[:, :, :3] = np.clip(5.0 * (row[:, 3:6] - row[:, 0:3]), -1.0, 1.0)[:, None]
            env.step_segment(actions, out)
            self.assertTrue(np.isfinite(out.observations).all())
        self.assertEqual(out.truncated.tolist(), [1] * 4)
        self.assertEqual(out.success.tolist(), [1] * 4)
        self.assertTrue((out.rewards[:, -1] > -0.05).all())

    def test_an_id_without_a_version_works_in_a_fresh_process(self):
        """As in a worker, Gymnasium-Robotics has not been imported before."""
        code = (
            "from dmprl.segment_env import make; "
            "print(make('gymnasium_robotics:FetchReach', 1, 5).spec()['observation_len'])"
        )
        result = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True
        )
        self.assertEqual(result.stdout.strip(), "16")

    def test_rules_of_fetch_are_proven(self):
        euclidean = {"norm": "euclidean", "components": [0, 1, 2], "ends_within": None}
        sparse = {**euclidean, "threshold": 0.05, "reached": 0.0, "missed": -1.0}
        self.assertEqual(proven(started("FetchPush-v4", 1, 5)[0]), sparse)
        self.assertEqual(
            proven(started("FetchPickAndPlaceDense-v4", 1, 5)[0]), {**euclidean, "factor": -1.0}
        )

    def test_relabelling_with_the_same_goals_does_not_change_an_episode(self):
        env, out = started("FetchReach-v4", 2, 5)
        goals = env.goals()
        self.assertEqual(goals, {"achieved": 0, "desired": 3, "length": 3, "sparse": True})
        rows = GoalRows(10, 3)
        while not (out.terminated | out.truncated).any():
            seen = out.next_observations
            actions = np.zeros((2, 5, env.spec()["action_len"]))
            actions[:, :, :3] = np.clip(5.0 * (seen[:, 3:6] - seen[:, 0:3]), -1.0, 1.0)[:, None]
            env.step_segment(actions, out)
            for index, steps in enumerate(out.steps):
                rows.count[0] = steps
                after = out.observations[index, 1 : steps + 1]
                rows.achieved[:steps], rows.desired[:steps] = after[:, 0:3], after[:, 3:6]
                env.relabel(rows)
                np.testing.assert_array_equal(rows.rewards[:steps], out.rewards[index, :steps])
                ended = np.zeros(steps, np.uint8)
                ended[-1] = out.terminated[index]
                np.testing.assert_array_equal(rows.terminated[:steps], ended)
        self.assertTrue((out.rewards == 0.0).any())


if __name__ == "__main__":
    unittest.main()

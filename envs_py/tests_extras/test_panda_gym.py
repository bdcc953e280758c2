"""panda-gym's own tasks, run as in a worker (extra `panda-gym`)."""

import unittest

import gymnasium
import numpy as np
import panda_gym  # noqa: F401 - registers its tasks

from dmprl.goal_rule import proven
from dmprl.segment_env import GoalRows, SegmentBuffers, make

REACH = ("PandaReach-v3", "PandaReachDense-v3", "PandaReachJoints-v3", "PandaReachJointsDense-v3")


def started(task_id, env_count, segment_steps):
    env = make(f"panda_gym:{task_id}", env_count, segment_steps)
    spec = env.spec()
    out = SegmentBuffers(env_count, segment_steps, spec["observation_len"], spec["action_len"])
    env.reset(np.ones(env_count, np.uint8), np.arange(env_count, dtype=np.uint64), out)
    return env, out


class PandaGymTest(unittest.TestCase):
    def test_sizes_and_bounds_are_those_of_panda_gym(self):
        for task_id in REACH:
            env, _ = started(task_id, 1, 5)
            spec = env.spec()
            env.close()
            actions = 7 if "Joints" in task_id else 3
            self.assertEqual((spec["observation_len"], spec["action_len"]), (12, actions))
            self.assertEqual(spec["action_low"], [-1.0] * actions)
            self.assertEqual(spec["action_high"], [1.0] * actions)
            self.assertEqual(spec["episode_steps"], 50)

    def test_observation_is_achieved_goal_then_desired_goal_then_observation(self):
        """The Dict's entries by name: end effector (3), goal (3), end effector and velocity (6)."""
        env, out = started("PandaReach-v3", 1, 5)
        plain = gymnasium.make("PandaReach-v3")
        entries, _ = plain.reset(seed=0)
        self.assertEqual(
            list(plain.observation_space), ["achieved_goal", "desired_goal", "observation"]
        )
        row = out.next_observations[0]
        np.testing.assert_allclose(row[0:3], entries["achieved_goal"], atol=1e-6)
        np.testing.assert_allclose(row[3:6], entries["desired_goal"], atol=1e-6)
        np.testing.assert_allclose(row[6:12], entries["observation"], atol=1e-6)
        np.testing.assert_allclose(row[0:3], [0.0384, 0.0, 0.1974], atol=1e-3)
        env.close()
        plain.close()

    def test_episodes_of_all_four_are_finite_and_end(self):
        rng = np.random.default_rng(0)
        for task_id in REACH:
            env, out = started(task_id, 2, 5)
            ends = np.zeros(2, int)
            while ends.min() < 2:
                env.step_segment(rng.uniform(-1, 1, (2, 5, env.spec()["action_len"])), out)
                self.assertTrue(np.isfinite(out.observations).all())
                self.assertTrue(((out.rewards <= 0) & (out.rewards > -2)).all())
                # In version 3 an episode ends when the goal is reached.
                np.testing.assert_array_equal(out.terminated, out.success)
                ends += (out.terminated | out.truncated) != 0
            env.close()

    def test_straight_to_the_goal_succeeds_in_few_steps(self):
        env, out = started("PandaReachDense-v3", 4, 1)
        steps, successes = np.zeros(4, int), 0
        while successes < 12:
            row = out.next_observations
            actions = np.clip((row[:, 3:6] - row[:, 0:3]) / 0.05, -1.0, 1.0)
            env.step_segment(actions[:, None], out)
            successes += out.success.sum()
            steps = np.where(out.terminated, 0, steps + 1)
            self.assertLess(steps.max(), 10)
        env.close()

    def test_rules_of_panda_gym_are_proven_with_their_end(self):
        euclidean = {"norm": "euclidean", "components": [0, 1, 2], "ends_within": 0.05}
        sparse = {**euclidean, "threshold": 0.05, "reached": 0.0, "missed": -1.0}
        for task_id, rule in (
            ("PandaReach-v3", sparse),
            ("PandaReachDense-v3", {**euclidean, "factor": -1.0}),
        ):
            env, _ = started(task_id, 1, 5)
            self.assertEqual(proven(env), rule)
            env.close()

    def test_relabelling_with_the_same_goals_does_not_change_an_episode(self):
        env, out = started("PandaReach-v3", 2, 5)
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

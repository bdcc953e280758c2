"""Positions of goals, rewards for other goals, and environments that are rejected."""

import sys
import unittest
from pathlib import Path

import numpy as np

from dmprl.segment_env import GoalRows, NotGoalConditionedError, make

sys.path.append(str(Path(__file__).parent))  # for the tiny environments' module


def rejection(task_id):
    try:
        make(task_id, 1, 5).goals()
    except NotGoalConditionedError as error:
        return str(error)
    return None


class GoalsTest(unittest.TestCase):
    def test_goals_are_found_in_the_flattened_observation(self):
        goals = make("tiny_envs:Reach-v0", 1, 5).goals()
        self.assertEqual(goals, {"achieved": 0, "desired": 1, "length": 1, "sparse": True})

    def test_a_reward_by_distance_is_not_sparse(self):
        self.assertFalse(make("tiny_envs:ReachFar-v0", 1, 5).goals()["sparse"])

    def test_unsuitable_environments_are_rejected_with_a_reason(self):
        for task_id, reason in [
            ("tiny_envs:Long-v0", "its observation is not a Dict"),
            ("tiny_envs:Goal-v0", "no Box named achieved_goal"),
            ("tiny_envs:ReachAlone-v0", "takes one goal at a time"),
            ("tiny_envs:Batch", "its observation has no goals"),
            ("Reacher-v5", "its observation has no goals"),
        ]:
            self.assertIn(reason, rejection(task_id), task_id)


class RelabelTest(unittest.TestCase):
    def rows(self, task_id):
        env = make(task_id, 2, 5)
        rows = GoalRows(6, env.goals()["length"])
        rows.count[0] = 4
        rows.achieved[:4, 0] = [0.0, 1.0, 2.0, 3.0]
        rows.desired[:4, 0] = [0.4, 1.6, 2.5, -3.0]
        rows.rewards[:], rows.terminated[:] = 9.0, 9
        env.relabel(rows)
        return rows

    def test_rewards_are_computed_for_the_given_goals(self):
        rows = self.rows("tiny_envs:Reach-v0")
        self.assertEqual(rows.rewards.tolist(), [0.0, -1.0, 0.0, -1.0, 9.0, 9.0])
        self.assertEqual(rows.terminated.tolist(), [0, 0, 0, 0, 9, 9])

    def test_steps_that_would_have_ended_the_episode_are_marked(self):
        rows = self.rows("tiny_envs:ReachEnds-v0")
        self.assertEqual(rows.terminated.tolist(), [1, 0, 1, 0, 9, 9])

    def test_goals_have_the_shape_and_type_of_their_space(self):
        env = make("tiny_envs:Reach-v0", 1, 5)
        env.goals()
        seen = []
        env._envs[0].unwrapped.compute_reward = lambda *given: seen.extend(given) or np.zeros(3)
        rows = GoalRows(3, 1)
        rows.count[0] = 3
        env.relabel(rows)
        achieved, desired, infos = seen
        self.assertEqual((achieved.shape, desired.dtype, infos), ((3, 1), np.float64, [{}] * 3))


if __name__ == "__main__":
    unittest.main()

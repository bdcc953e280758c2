"""Rules by which environments reward goals: fitted, declared, proven and rejected."""

import sys
import unittest
from pathlib import Path

import numpy as np

from dmprl.goal_rule import NoGoalRuleError, proven
from dmprl.segment_env import NotGoalConditionedError, SegmentBuffers, make

sys.path.append(str(Path(__file__).parent))  # for the tiny environments' module

SPARSE = {"norm": "euclidean", "threshold": 0.5, "reached": 0.0, "missed": -1.0}
ONE = {"components": [0], "ends_within": None}


def started(name):
    env = make(f"tiny_envs:{name}-v0", 1, 5)
    out = SegmentBuffers(1, 5, env.spec()["observation_len"], 1)
    env.reset(np.ones(1, np.uint8), np.zeros(1, np.uint64), out)
    return env


class ProvenTest(unittest.TestCase):
    def rejection(self, name):
        with self.assertRaises(NoGoalRuleError) as raised:
            proven(started(name))
        return str(raised.exception)

    def test_a_sparse_rule_is_fitted_with_its_exact_threshold(self):
        self.assertEqual(proven(started("Reach")), {**SPARSE, **ONE})

    def test_an_end_at_the_goal_is_part_of_the_rule(self):
        self.assertEqual(proven(started("ReachEnds"))["ends_within"], 0.5)

    def test_a_dense_rule_is_a_factor_of_the_distance(self):
        self.assertEqual(proven(started("ReachFar")), {"norm": "euclidean", "factor": -1.0, **ONE})

    def test_norm_components_and_other_rewards_are_found_in_32_bits(self):
        self.assertEqual(
            proven(started("ReachInBox")),
            {
                "norm": "max",
                "components": [0, 1],
                "threshold": 0.25,
                "reached": 10.0,
                "missed": 0.0,
                "ends_within": None,
            },
        )

    def test_a_declared_rule_is_proven_too(self):
        self.assertEqual(proven(started("ReachDeclared")), {**SPARSE, **ONE})
        self.assertIn("the reward is -1.0, not 0.0", self.rejection("ReachWrong"))

    def test_an_environment_can_declare_that_it_has_no_rule(self):
        self.assertIn("declares that it has none", self.rejection("ReachUndeclared"))

    def test_a_reward_that_follows_no_rule_is_rejected_with_a_reason(self):
        self.assertIn("at distance", self.rejection("ReachTwisted"))
        self.assertIn("not finite", self.rejection("ReachNan"))

    def test_an_environment_without_goals_is_no_matter_of_rules(self):
        with self.assertRaises(NotGoalConditionedError):
            proven(started("Long"))


if __name__ == "__main__":
    unittest.main()

"""Environments that raise exceptions, return NaN or infinity, or fail to reset."""

import contextlib
import io
import unittest
from unittest import mock

import numpy as np
import tiny_envs
from test_segment_env import started

from dmprl.segment_env import SUCCESS_NOT_REPORTED, SegmentEnvError, make, seed_after_failure


class StepTest(unittest.TestCase):
    """The second of three environments fails in the fourth step of a segment."""

    def after_failure(self, name):
        env, out = started(f"tiny_envs:{name}-v0", env_count=3)
        actions = np.zeros((3, 5, 1))
        actions[1, 3] = 2.0
        with contextlib.redirect_stderr(io.StringIO()) as log:
            env.step_segment(actions, out)
        self.log = log.getvalue()
        return env, out

    def message(self, name):
        (message,) = self.after_failure(name)[0].take_failures()
        return message

    def test_an_exception_names_environment_and_step(self):
        self.assertEqual(
            self.message("Raises"),
            "tiny_envs:Raises-v0, environment 1, step 3 of the segment: "
            "ValueError: the joint broke",
        )
        self.assertIn("tiny_envs.py", self.log)

    def test_values_that_are_not_finite_are_named(self):
        where = "environment 1, step 3 of the segment"
        self.assertIn(f"{where}: observation[1] is nan", self.message("NanObservation"))
        self.assertIn(f"{where}: reward is inf", self.message("InfReward"))
        self.assertEqual(self.log, "")

    def test_an_entry_of_a_dictionary_is_reported_by_its_name(self):
        env, out = started("tiny_envs:Nested-v0")
        env.step_segment(np.zeros((1, 5, 1)), out)
        self.assertRegex(env.take_failures()[0], r"step 1 of the segment: parts\.1 is nan$")

    def test_only_the_failed_environment_loses_its_segment(self):
        for name in ("Raises", "NanObservation", "InfReward"):
            with self.subTest(name):
                _, out = self.after_failure(name)
                whole, wanted = started(f"tiny_envs:{name}-v0", env_count=3)
                whole.step_segment(np.zeros((3, 5, 1)), wanted)
                self.assertEqual(out.failed.tolist(), [0, 1, 0])
                for rows in ("observations", "rewards", "steps", "success", "next_observations"):
                    got, expected = getattr(out, rows)[::2], getattr(wanted, rows)[::2]
                    np.testing.assert_array_equal(got, expected, rows)
                self.assertFalse(out.observations[1].any() or out.rewards[1].any())
                self.assertEqual((out.steps[1], out.success[1]), (0, SUCCESS_NOT_REPORTED))
                self.assertEqual((out.terminated[1], out.truncated[1]), (0, 0))

    def test_the_new_episode_has_the_seed_after_a_failure(self):
        env, out = self.after_failure("Raises")
        _, expected = started("tiny_envs:Raises-v0", seed=seed_after_failure(8, 1))
        np.testing.assert_array_equal(out.next_observations[1], expected.next_observations[0])
        env.step_segment(np.zeros((3, 5, 1)), out)
        self.assertEqual((out.failed.tolist(), out.steps.tolist()), ([0] * 3, [5] * 3))
        self.assertEqual(out.observations[:, 0, 0].tolist(), [5, 0, 5])

    def test_failures_are_returned_once(self):
        env, _ = self.after_failure("Raises")
        self.assertEqual(len(env.take_failures()), 1)
        self.assertEqual(env.take_failures(), [])

    def test_sys_exit_in_an_environment_is_a_failure(self):
        env, out = started("tiny_envs:FaultyExit-v0", segment_steps=25)
        for _ in range(4):
            with contextlib.redirect_stderr(io.StringIO()):
                env.step_segment(np.zeros((1, 25, 1)), out)
        self.assertIn("SystemExit: the gripper went home", env.take_failures()[0])

    def test_seeds_differ_by_failure_and_fit_into_31_bits(self):
        seeds = {seed_after_failure(first, count) for first in range(20) for count in range(1, 20)}
        self.assertEqual(len(seeds), 20 * 19)
        self.assertTrue(all(0 <= seed < 2**31 for seed in seeds))

    def test_a_user_defined_segment_env_reports_no_failures_by_default(self):
        self.assertEqual(make("tiny_envs:Batch", 1, 1).take_failures(), [])


class ResetTest(unittest.TestCase):
    def setUp(self):
        silence = contextlib.redirect_stderr(io.StringIO())
        silence.__enter__()
        self.addCleanup(silence.__exit__, None, None, None)

    def test_a_failed_automatic_reset_discards_the_segment_before_it(self):
        env, out = started("tiny_envs:FaultyReset-v0", env_count=2)
        env.step_segment(np.zeros((2, 5, 1)), out)
        self.assertEqual(out.failed.tolist(), [1, 1])
        self.assertIn("environment 1, reset: ValueError: no way back", env.take_failures()[1])
        self.assertEqual(out.next_observations[:, 0].tolist(), [0, 0])

    def test_a_failed_requested_reset_is_repeated_with_its_seed(self):
        env, out = started("tiny_envs:FaultyReset-v0")
        first = out.next_observations.copy()
        out.next_observations[:] = 9
        env.reset(np.ones(1, np.uint8), np.array([7], np.uint64), out)
        np.testing.assert_array_equal(out.next_observations, first)
        self.assertEqual(len(env.take_failures()), 1)

    def test_an_environment_that_cannot_be_recreated_is_an_error(self):
        env, out = started("tiny_envs:FaultyReset-v0")
        made = tiny_envs.FaultyReset.made
        with (
            mock.patch.object(tiny_envs.FaultyReset, "made_max", made),
            self.assertRaisesRegex(SegmentEnvError, "recreated after a failure: OSError: no more"),
        ):
            env.step_segment(np.zeros((1, 5, 1)), out)


if __name__ == "__main__":
    unittest.main()

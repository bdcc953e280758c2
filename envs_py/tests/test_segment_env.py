"""The contract of SegmentEnv, tested with Gymnasium environments."""

import contextlib
import sys
import tempfile
import unittest
from pathlib import Path

import gymnasium
import numpy as np

from dmprl.gymnasium_env import GymnasiumSegmentEnv, success_of
from dmprl.segment_env import (
    SUCCESS_NO,
    SUCCESS_NOT_REPORTED,
    SUCCESS_YES,
    SegmentBuffers,
    SegmentEnvError,
    UnsupportedSpaceError,
    make,
)

sys.path.append(str(Path(__file__).parent))  # for the tiny environments' module


EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"


def started(task_id, env_count=1, segment_steps=5, seed=7):
    """Returns a task's environments, reset with seeds `seed`, `seed` + 1, …, and their buffers."""
    return started_on(make(task_id, env_count, segment_steps), seed)


def started_on(env, seed=7):
    spec, env_count, segment_steps = env.spec(), env.env_count, env.segment_steps
    out = SegmentBuffers(env_count, segment_steps, spec["observation_len"], spec["action_len"])
    seeds = np.arange(seed, seed + env_count, dtype=np.uint64)
    env.reset(np.ones(env_count, np.uint8), seeds, out)
    return env, out


class ResetTest(unittest.TestCase):
    def test_actions_of_another_shape_are_rejected(self):
        env, out = started("tiny_envs:Long-v0")
        with self.assertRaisesRegex(ValueError, r"expected \(E, K, A\) = \(1, 5, 1\)"):
            env.step_segment(np.zeros((1, 4, 1)), out)

    def test_the_same_seed_gives_the_same_episode(self):
        env, out = started("Reacher-v5", env_count=2)
        first = out.next_observations.copy()
        env.reset(np.array([1, 1], np.uint8), np.array([8, 7], np.uint64), out)
        np.testing.assert_array_equal(out.next_observations, first[::-1])

    def test_only_masked_environments_are_reset(self):
        env, out = started("tiny_envs:Long-v0", env_count=2)
        env.step_segment(np.zeros((2, 5, 1)), out)
        env.reset(np.array([0, 1], np.uint8), np.array([0, 2**64 - 1], np.uint64), out)
        self.assertEqual(out.next_observations[:, 0].tolist(), [5.0, 0.0])
        env.step_segment(np.zeros((2, 5, 1)), out)
        self.assertEqual(out.steps.tolist(), [2, 5])

    def test_step_before_reset_is_rejected(self):
        env = make("tiny_envs:Long-v0", 2, 5)
        out = SegmentBuffers(2, 5, 2, 1)
        env.reset(np.array([1, 0], np.uint8), np.zeros(2, np.uint64), out)
        with self.assertRaisesRegex(SegmentEnvError, "environment 1: step before reset"):
            env.step_segment(np.zeros((2, 5, 1)), out)


class SegmentTest(unittest.TestCase):
    def test_any_environment_equals_a_plain_gymnasium_loop(self):
        # Gymnasium's Reacher; `make` would return dmprl's.
        env_count, segments = 3, 23  # two episodes (50 steps each) end within a segment
        env, out = started_on(GymnasiumSegmentEnv("Reacher-v5", env_count, 6))
        plain = [gymnasium.make("Reacher-v5") for _ in range(env_count)]
        now = [plain[index].reset(seed=7 + index)[0] for index in range(env_count)]
        rng = np.random.default_rng(0)
        for _ in range(segments):
            np.testing.assert_array_equal(out.next_observations, now)
            actions = rng.uniform(-1, 1, (env_count, 6, 2))
            env.step_segment(actions, out)
            for index in range(env_count):
                np.testing.assert_array_equal(out.observations[index, 0], now[index])
                for step in range(out.steps[index]):
                    action = actions[index, step].astype(np.float32)
                    now[index], reward, terminated, truncated, _ = plain[index].step(action)
                    np.testing.assert_array_equal(out.observations[index, step + 1], now[index])
                    self.assertEqual(out.rewards[index, step], reward)
                self.assertEqual(out.terminated[index], terminated)
                self.assertEqual(out.truncated[index], truncated)
                if terminated or truncated:
                    now[index], _ = plain[index].reset()
                else:
                    self.assertEqual(out.steps[index], 6)

    def test_a_segment_ends_with_its_episode_and_the_next_episode_starts(self):
        env, out = started("tiny_envs:Countdown-v0", env_count=2)
        draw = out.next_observations[:, 1].copy()
        out.observations[:], out.rewards[:] = 9, 9
        env.step_segment(np.array([[[1.0]] * 5, [[-1.0]] * 5]), out)
        self.assertEqual(out.steps.tolist(), [3, 3])
        self.assertEqual(out.observations[0, :, 0].tolist(), [0, 1, 2, 3, 0, 0])
        self.assertEqual(out.observations[0, :4, 1].tolist(), [draw[0]] * 4)
        self.assertEqual(out.rewards.tolist(), [[1, 1, 1, 0, 0], [-1, -1, -1, 0, 0]])
        self.assertEqual((out.terminated.tolist(), out.truncated.tolist()), ([1, 1], [0, 0]))
        self.assertEqual(out.success.tolist(), [SUCCESS_YES, SUCCESS_NO])
        self.assertEqual(out.next_observations[:, 0].tolist(), [0, 0])
        self.assertTrue((out.next_observations[:, 1] != draw).all(), "reset with the same seed")
        expected = out.next_observations.copy()
        env.step_segment(np.zeros((2, 5, 1)), out)
        np.testing.assert_array_equal(out.observations[:, 0], expected)

    def test_autoreset_continues_the_environments_own_generator(self):
        draws = []
        for _ in range(2):
            env, out = started("tiny_envs:Countdown-v0")
            for _ in range(3):
                env.step_segment(np.zeros((1, 5, 1)), out)
                draws.append(out.next_observations[0, 1])
        self.assertEqual(draws[:3], draws[3:])
        self.assertEqual(len(set(draws)), 3)

    def test_time_limit_is_truncation_and_not_termination(self):
        env, out = started("tiny_envs:Long-v0")
        env.step_segment(np.zeros((1, 5, 1)), out)
        self.assertEqual((out.truncated[0], out.steps[0]), (0, 5))
        env.step_segment(np.zeros((1, 5, 1)), out)
        self.assertEqual((out.terminated[0], out.truncated[0], out.steps[0]), (0, 1, 2))
        self.assertEqual(out.observations[0, 2, 0], 7)

    def test_an_environment_may_keep_its_last_action(self):
        env, out = started("tiny_envs:Remembering-v0", segment_steps=2)
        actions = np.array([[[0.5], [1.0]]])
        env.step_segment(actions, out)
        actions[:] = 0.0
        env.step_segment(actions, out)
        self.assertEqual(out.rewards.tolist(), [[1.0, 0.0]])

    def test_a_module_may_define_a_segment_env(self):
        env, out = started("tiny_envs:Batch", env_count=2)
        self.assertEqual(out.next_observations.tolist(), [[7], [8]])
        self.assertEqual(env.spec()["control_dt_s"], 0.5)

    def test_a_function_may_create_the_environment(self):
        env, out = started("tiny_envs:short_countdown", env_count=2)
        env.step_segment(np.zeros((2, 5, 1)), out)
        self.assertEqual((out.steps.tolist(), out.terminated.tolist()), ([2, 2], [1, 1]))

    def test_an_invalid_success_is_a_failure_of_its_environment(self):
        env, out = started("tiny_envs:StrangeInfo", env_count=1)
        env.step_segment(np.zeros((1, 5, 1)), out)
        self.assertEqual(out.failed.tolist(), [1])
        self.assertIn("only 0-dimensional", env.take_failures()[0])

    def test_a_success_of_nan_is_not_reported(self):
        for nan in (float("nan"), np.float32("nan")):
            self.assertEqual(success_of({"success": nan}), SUCCESS_NOT_REPORTED)
        self.assertEqual(success_of({"is_success": np.True_}), SUCCESS_YES)
        self.assertEqual(success_of({"is_success": np.float32(0)}), SUCCESS_NO)

    def test_a_module_may_define_a_mujoco_task(self):
        env, out = started("tiny_mujoco:SlowReacher", env_count=2)
        self.assertEqual(env.spec()["control_dt_s"], 0.04)
        env.step_segment(np.zeros((2, 5, 2)), out)
        self.assertTrue(out.observations.any())

    def test_the_batched_example_equals_the_plain_one(self):
        sys.path.append(str(EXAMPLES))
        plain, of_plain = started("point_reach:PointReach-v0", 3, 7)
        batch, of_batch = started("point_reach_batch:PointReachBatch", 3, 7)
        generator = np.random.default_rng(0)
        for _ in range(30):
            # Both draw from equal generators with equal seeds.
            np.testing.assert_allclose(of_batch.next_observations, of_plain.next_observations)
            actions = generator.uniform(-2, 2, (3, 7, 2))
            for env, out in ((plain, of_plain), (batch, of_batch)):
                env.step_segment(actions, out)
            for name in ("observations", "rewards", "terminated", "truncated", "success", "steps"):
                got, expected = getattr(of_batch, name), getattr(of_plain, name)
                np.testing.assert_allclose(got, expected, atol=1e-12, err_msg=name)


class SpecTest(unittest.TestCase):
    def test_spec_of_reacher(self):
        names = [f"observation[{entry}]" for entry in range(10)]
        ours = make("Reacher-v5", 1, 5).spec()
        self.assertEqual(ours["observation_names"][4:6], ["target_x", "target_y"])
        self.assertEqual(
            GymnasiumSegmentEnv("Reacher-v5", 1, 5).spec(),
            {**ours, "observation_names": names},
        )
        self.assertEqual(
            {**ours, "observation_names": names},
            {
                "id": "Reacher-v5",
                "observation_len": 10,
                "action_len": 2,
                "action_low": [-1.0, -1.0],
                "action_high": [1.0, 1.0],
                "control_dt_s": 0.02,
                "episode_steps": 50,
                "observation_names": names,
            },
        )

    def test_spec_without_time_limit_or_dt(self):
        spec = make("tiny_envs:Countdown-v0", 1, 5).spec()
        self.assertEqual((spec["control_dt_s"], spec["episode_steps"]), (0.0, 0))

    def test_dict_observation_is_flattened_by_key_and_keeps_its_names(self):
        env, out = started("tiny_envs:Goal-v0")
        self.assertEqual(
            env.spec()["observation_names"],
            ["desired_goal[0]", "desired_goal[1]", "observation[0]", "observation[1]"],
        )
        self.assertEqual(env.spec()["observation_len"], 4)
        self.assertEqual(out.next_observations.tolist(), [[0.5, 0.5, 0.25, 0.25]])
        env.step_segment(np.zeros((1, 5, 1)), out)
        self.assertEqual(out.success[0], SUCCESS_NOT_REPORTED)

    def test_names_follow_the_order_of_flattening(self):
        env, out = started("tiny_envs:Nested-v0", segment_steps=1)
        arm = ["arm.q[0]", "arm.q[1]", "arm.grip[0]", "arm.grip[1]"]
        parts = ["parts.0[0,0]", "parts.0[0,1]", "parts.1"]
        self.assertEqual(env.spec()["observation_names"], arm + parts)
        env.step_segment(np.zeros((1, 1, 1)), out)
        self.assertEqual(out.next_observations.tolist(), [[0.25, 0.25, 0, 1, 1, 1, 0.5]])

    def test_spaces_of_several_dimensions_are_flattened(self):
        env, out = started("tiny_envs:Grid-v0", segment_steps=1)
        spec = env.spec()
        self.assertEqual(spec["observation_names"][1], "observation[0,1]")
        self.assertEqual((spec["action_low"], spec["action_len"]), ([-1.0, -2.0, -3.0, -4.0], 4))
        env.step_segment(np.array([[[0.1, 0.2, 0.3, 0.4]]]), out)
        self.assertEqual(out.next_observations[0, :2].tolist(), [1.0, 1.0])
        self.assertEqual(out.rewards[0, 0], 0.4)

    def test_observations_of_any_number_type(self):
        for dtype in ("int8", "uint16", "int64", "float16", "float32"):
            with self.subTest(dtype):
                env, out = started(f"tiny_envs:Typed-{dtype}-v0")
                env.step_segment(np.zeros((1, 5, 1)), out)
                self.assertEqual(out.observations[0, :, 0].tolist(), [0, 1, 2, 3, 4, 5])

    def test_a_class_needs_no_registration_and_may_limit_its_episodes(self):
        spec = make("tiny_envs:Countdown", 1, 5).spec()
        self.assertEqual((spec["id"], spec["episode_steps"]), ("tiny_envs:Countdown", 0))
        env, out = started("tiny_envs:Limited", segment_steps=10)
        self.assertEqual(env.spec()["episode_steps"], 8)
        env.step_segment(np.ones((1, 10, 2)), out)
        self.assertEqual((out.steps[0], out.terminated[0], out.truncated[0]), (8, 0, 1))

    def test_action_bounds_differ_by_dimension(self):
        spec = make("tiny_envs:Limited", 1, 5).spec()
        self.assertEqual((spec["action_low"], spec["action_high"]), ([-15.0, 0.0], [5.0, 4.0]))

    def test_unsupported_spaces_are_rejected_and_named(self):
        for name, space in [
            ("Discrete", r"action space Discrete\(3\)"),
            ("Unbounded", r"action space Box\(-inf, inf, \(2,\), float32\)"),
            ("Image", r"the observation, Box\(0, 255, \(8, 8, 3\), uint8\), is an image"),
            ("Camera", r"observation\['front'\], Box\(0, 255, \(8, 8\), uint8\), is an image"),
            ("Words", r"observation space Text\(1, 9,"),
        ]:
            with self.subTest(name), self.assertRaisesRegex(UnsupportedSpaceError, space) as raised:
                make(f"tiny_envs:{name}-v0", 1, 5)
            self.assertIn("supported are Box", str(raised.exception))

    def test_unknown_names_are_rejected_with_advice(self):
        with self.assertRaisesRegex(gymnasium.error.Error, "Reacher"):
            make("Reachr-v5", 1, 5)
        with self.assertRaisesRegex(gymnasium.error.Error, "PACKAGE:FetchPush-v4, such as"):
            make("FetchPush-v4", 1, 5)
        with self.assertRaisesRegex(ModuleNotFoundError, "--python-path"):
            make("no_such_module:Task-v0", 1, 5)
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            Path("my_arms.py").touch()
            with self.assertRaisesRegex(ModuleNotFoundError, "my_arms.py is in the current folder"):
                make("my_arms:Arm", 1, 5)
        with self.assertRaisesRegex(gymnasium.error.Error, "the module tiny_envs exists, but"):
            make("tiny_envs:Missing", 1, 5)


if __name__ == "__main__":
    unittest.main()

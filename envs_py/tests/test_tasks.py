import gc
import os
import re
import tracemalloc
import unittest
import warnings

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils.env_checker import check_env

import dmprl  # noqa: F401 - registers the tasks
from dmprl.pictures import NoOpenGLError
from dmprl.segment_env import SUCCESS_NOT_REPORTED, SegmentBuffers, SegmentEnvError, make
from dmprl.tasks import SAME_AS_GYMNASIUM, TASKS


def started(task_id, env_count=1, segment_steps=5, seed=7):
    """Returns a task's environments, reset with seeds `seed`, `seed` + 1, …, and their buffers."""
    env = make(task_id, env_count, segment_steps)
    spec = env.spec()
    out = SegmentBuffers(env_count, segment_steps, spec["observation_len"], spec["action_len"])
    env.reset(np.ones(env_count, np.uint8), np.arange(seed, seed + env_count).astype("u8"), out)
    return env, out


def random_actions(rng, spec, env_count, segment_steps):
    low, high = np.array(spec["action_low"]), np.array(spec["action_high"])
    return rng.uniform(low, high, (env_count, segment_steps, low.size))


class GymnasiumTest(unittest.TestCase):
    """Reacher-v5 and Pusher-v5 must be bit-identical to Gymnasium's."""

    def assert_equal_over(self, task_id, episodes, env_count, segment_steps):
        env, out = started(task_id, env_count, segment_steps)
        self.assertEqual(type(env).__name__, "BatchSegmentEnv")
        plain = [gymnasium.make(task_id) for _ in range(env_count)]
        now = [plain[index].reset(seed=7 + index)[0] for index in range(env_count)]
        rng = np.random.default_rng(0)
        while episodes > 0:
            np.testing.assert_array_equal(out.next_observations, now)
            actions = random_actions(rng, env.spec(), env_count, segment_steps)
            env.step_segment(actions, out)
            self.assertFalse(out.failed.any())
            for index in range(env_count):
                steps = out.steps[index]
                np.testing.assert_array_equal(out.observations[index, 0], now[index])
                np.testing.assert_array_equal(out.observations[index, steps + 1 :], 0.0)
                np.testing.assert_array_equal(out.rewards[index, steps:], 0.0)
                for step in range(steps):
                    action = actions[index, step].astype(np.float32)
                    now[index], reward, terminated, truncated, _ = plain[index].step(action)
                    np.testing.assert_array_equal(out.observations[index, step + 1], now[index])
                    self.assertEqual(out.rewards[index, step], reward)
                self.assertEqual(out.terminated[index], terminated)
                self.assertEqual(out.truncated[index], truncated)
                if terminated or truncated:
                    now[index], _ = plain[index].reset()
                    episodes -= 1
                else:
                    self.assertEqual(steps, segment_steps)

    def test_reacher_over_100_episodes(self):
        self.assert_equal_over("Reacher-v5", 100, 1, 5)

    def test_pusher_over_100_episodes(self):
        self.assert_equal_over("Pusher-v5", 100, 1, 5)

    def test_several_environments_and_episodes_that_end_inside_a_segment(self):
        self.assert_equal_over("Reacher-v5", 100, 4, 7)
        self.assert_equal_over("Pusher-v5", 100, 5, 6)

    def test_environments_that_were_reset_at_different_times(self):
        env, out = started("Reacher-v5", 3, 4)
        plain = gymnasium.make("Reacher-v5")
        rng = np.random.default_rng(1)
        for _ in range(3):
            env.step_segment(random_actions(rng, env.spec(), 3, 4), out)
        before = out.next_observations.copy()
        env.reset(np.array([0, 1, 0], np.uint8), np.array([0, 99, 0], np.uint64), out)
        np.testing.assert_array_equal(out.next_observations[[0, 2]], before[[0, 2]])
        now, _ = plain.reset(seed=99)
        lengths = np.zeros(3, int)
        for _ in range(25):
            np.testing.assert_array_equal(out.next_observations[1], now)
            actions = random_actions(rng, env.spec(), 3, 4)
            env.step_segment(actions, out)
            lengths += out.steps
            for step in range(out.steps[1]):
                now, reward, _, truncated, _ = plain.step(actions[1, step].astype("f"))
                np.testing.assert_array_equal(out.observations[1, step + 1], now)
                self.assertEqual(out.rewards[1, step], reward)
            if truncated:
                now, _ = plain.reset()
            if out.truncated[0]:
                self.assertEqual(lengths[0] % 50, 38)
                break
        self.assertEqual(lengths.tolist(), [38, 40, 38])


class Contract:
    """Tests that every registered task must pass."""

    task_id: str

    def test_specification_and_buffers_fit(self):
        env, out = started(self.task_id, env_count=2)
        spec, entry = env.spec(), TASKS[self.task_id]
        self.assertEqual(len(spec["observation_names"]), spec["observation_len"])
        self.assertEqual(len(set(spec["observation_names"])), spec["observation_len"])
        self.assertEqual(spec["episode_steps"], entry.episode_steps)
        self.assertEqual(out.next_observations.shape, (2, spec["observation_len"]))
        self.assertTrue(np.all(np.array(spec["action_low"]) < spec["action_high"]))
        self.assertGreater(spec["control_dt_s"], 0.0)
        same = self.task_id.removeprefix("dmprl/") in SAME_AS_GYMNASIUM
        self.assertEqual(spec["id"], self.task_id.removeprefix("dmprl/") if same else self.task_id)

    def test_random_actions_give_finite_observations_and_no_positive_rewards(self):
        env, out = started(self.task_id, env_count=4)
        rng, truncated, steps = np.random.default_rng(0), np.zeros(4), np.zeros(4)
        # Nothing damps the joints of box pushing, and speeds cost.
        reward_min = -10_000.0 if "BoxPushing" in self.task_id else -100.0
        while not (truncated == 2).all():
            env.step_segment(random_actions(rng, env.spec(), 4, 5), out)
            self.assertTrue(np.isfinite(out.observations).all())
            self.assertTrue((out.rewards <= 0).all() and (out.rewards > reward_min).all())
            self.assertFalse(out.failed.any() or out.terminated.any())
            self.assertTrue(np.isin(out.success, (0, 1, SUCCESS_NOT_REPORTED)).all())
            truncated += out.truncated
            steps += out.steps
        self.assertEqual(steps.tolist(), [2 * TASKS[self.task_id].episode_steps] * 4)

    def test_segments_leak_no_memory_and_need_little(self):
        env, out = started(self.task_id, env_count=16)
        actions = np.zeros((16, 5, len(env.spec()["action_low"])))
        tracemalloc.start()
        env.step_segment(actions, out)
        gc.collect()
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        env.step_segment(actions, out)
        _, peak = tracemalloc.get_traced_memory()
        for _ in range(20):
            env.step_segment(actions, out)
        gc.collect()  # Python keeps cycles until there are many.
        after, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        self.assertLess(after - before, 1000)
        # NumPy's temporary buffers and, for end-effector actions, those of the inverse kinematics.
        self.assertLess(peak - before, 40_000)

    def test_the_same_seed_gives_bit_identical_results(self):
        runs = []
        for _ in range(2):
            env, out = started(self.task_id, env_count=3)
            rng, parts = np.random.default_rng(0), [out.next_observations.tobytes()]
            for _ in range(25):  # beyond the end of an episode
                env.step_segment(random_actions(rng, env.spec(), 3, 5), out)
                parts += [out.observations.tobytes(), out.rewards.tobytes()]
            runs.append(b"".join(parts))
        self.assertEqual(runs[0], runs[1])

    def test_an_environment_does_not_depend_on_its_neighbours(self):
        many, out_of_many = started(self.task_id, env_count=3)
        one, out_of_one = started(self.task_id, env_count=1, seed=8)
        rng = np.random.default_rng(0)
        for _ in range(25):
            actions = random_actions(rng, many.spec(), 3, 5)
            many.step_segment(actions, out_of_many)
            one.step_segment(actions[1:2], out_of_one)
            np.testing.assert_array_equal(out_of_many.observations[1], out_of_one.observations[0])
            np.testing.assert_array_equal(out_of_many.rewards[1], out_of_one.rewards[0])

    def test_distinct_seeds_give_distinct_starts(self):
        _, out = started(self.task_id, env_count=32)
        self.assertEqual(len({row.tobytes() for row in out.next_observations}), 32)

    def test_the_gymnasium_environment_equals_the_batch(self):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium warns that the paper's versions are old
            # A Dict is flattened, as a worker does; another observation remains the same.
            plain = gymnasium.wrappers.FlattenObservation(gymnasium.make(self.task_id))
        batch, out = started(self.task_id)
        now, _ = plain.reset(seed=7)
        rng = np.random.default_rng(0)
        for _ in range(45):
            np.testing.assert_array_equal(out.next_observations[0], now)
            actions = random_actions(rng, batch.spec(), 1, 5)
            batch.step_segment(actions, out)
            for step in range(5):
                now, reward, terminated, truncated, info = plain.step(actions[0, step].astype("f"))
                np.testing.assert_array_equal(out.observations[0, step + 1], now)
                self.assertEqual(out.rewards[0, step], reward)
                self.assertFalse(terminated)
            success = info.get("is_success", SUCCESS_NOT_REPORTED)
            self.assertEqual(out.success[0], success)
            self.assertEqual(out.truncated[0], truncated)
            if truncated:
                now, _ = plain.reset()

    def test_gymnasiums_checker_passes(self):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            check_env(gymnasium.make(self.task_id).unwrapped, skip_render_check=True)
        # Gymnasium's own tasks also have unbounded observations, and torques outside [-1, 1].
        expected = ("infinity", "symmetric and normalized", "out of date")
        others = [w for w in caught if not any(text in str(w.message) for text in expected)]
        self.assertEqual([str(warning.message) for warning in others], [])

    def test_pictures_show_the_movement(self):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            env = gymnasium.make(self.task_id, render_mode="rgb_array", width=160, height=120)
        env.reset(seed=1)
        try:
            first = env.render()
        except NoOpenGLError as error:
            if os.environ.get("TEST_OPENGL_REQUIRED"):
                raise
            self.skipTest(str(error))
        for _ in range(20):
            env.step(env.action_space.high)
        last = env.render()
        env.close()
        self.assertEqual((first.shape, first.dtype), ((120, 160, 3), np.uint8))
        self.assertGreater(first.std(), 5.0, "a picture of one colour")
        self.assertGreater((first != last).any(axis=2).mean(), 0.002)


for task_id in TASKS:
    # One class per task, so that its name is in the report of a failure.
    name = re.sub(r"\W", "", task_id) + "ContractTest"
    globals()[name] = type(name, (Contract, unittest.TestCase), {"task_id": task_id})


class ThrowerTest(unittest.TestCase):
    def returns(self, draw, env_count=100):
        env, out = started("dmprl/Thrower-v0", env_count)
        returns = np.zeros(env_count)
        for _ in range(20):
            env.step_segment(draw(env.spec(), env_count), out)
            returns += out.rewards.sum(axis=1)
        self.assertTrue(out.truncated.all())
        return returns

    def assert_agree(self, returns, mean, std, count):
        """Compares with a published mean, within two standard errors of the difference."""
        error = np.sqrt(std**2 / count + returns.var(ddof=1) / returns.size)
        self.assertLess(abs(returns.mean() - mean), 2 * error, f"{returns.mean()} ± {error}")

    def test_return_without_torque_agrees_with_the_original(self):
        # 20 episodes of gym 0.9.4's model and semantics in MuJoCo 4.0.0: -136 ± 16.
        self.assert_agree(self.returns(lambda _, envs: np.zeros((envs, 5, 7))), -136, 16, 20)

    def test_return_of_random_torques_agrees_with_the_original(self):
        rng = np.random.default_rng(0)  # from the same source: -185 ± 40
        self.assert_agree(
            self.returns(lambda spec, envs: random_actions(rng, spec, envs, 5)), -185, 40, 20
        )

    def test_the_model_has_the_published_dimensions(self):
        model = make("dmprl/Thrower-v0", 1, 5).task.model
        sizes = (model.nq, model.nv, model.nu, model.nbody, model.ngeom)
        self.assertEqual(sizes, (16, 15, 7, 19, 45))
        self.assertAlmostEqual(model.body("goal").mass[0], 0.0722, places=4)
        self.assertAlmostEqual(model.body("ball").mass[0], 0.002827, places=6)
        ranges = [(-0.4854, 1.214602), (-0.5236, 0.7963), (-1.5, 1.7), (-0.7, 0.7)]
        ranges += [(-1.5, 1.5), (-1.0, 1.0), (0.0, 2.25), (-10.3213, 10.3), (-10.3213, 10.3)]
        np.testing.assert_allclose(model.jnt_range[:9], ranges)
        np.testing.assert_array_equal(model.dof_armature, [0.75] * 9 + [0.0] * 6)
        np.testing.assert_array_equal(model.dof_damping, [1.0] * 9 + [0.0] * 6)
        np.testing.assert_array_equal(model.qpos0[9:], [0.5, -0.8, 0.275, 1, 0, 0, 0])
        self.assertEqual(model.opt.timestep, 0.01)
        self.assertEqual(list(model.opt.gravity), [0.0, 0.0, -9.81])

    def test_torque_bounds_differ_by_joint(self):
        spec = make("dmprl/Thrower-v0", 1, 5).spec()
        self.assertEqual(spec["action_high"], [10, 10, 10, 10, 15, 15, 15])
        self.assertEqual(spec["action_low"], [-10, -10, -10, -10, -15, -15, -15])

    def test_reward_depends_on_the_state_before_the_step(self):
        env, out = started("dmprl/Thrower-v0")
        actions = np.full((1, 5, 7), 2.0)
        env.step_segment(actions, out)
        row = out.observations[0]
        expected = -np.linalg.norm(row[:5, 17:19] - row[:5, 20:22], axis=1) - 0.002 * 28.0
        np.testing.assert_allclose(out.rewards[0], expected, rtol=1e-12)

    def test_after_the_ball_has_hit_the_ground_the_reward_depends_on_the_point_of_impact(self):
        env, out = started("dmprl/Thrower-v0", env_count=20)
        rng, hits = np.random.default_rng(3), {}
        for episode in range(2):
            for _ in range(20):
                env.step_segment(random_actions(rng, env.spec(), 20, 5), out)
                for index in range(20):
                    for step, row in enumerate(out.observations[index, :5]):
                        if row[19] < -0.25:
                            hits.setdefault(index, row[17:19].copy())
                        place = hits.get(index, row[17:19])
                        action = env._actions[index, step].astype(np.float64)
                        reward = -np.linalg.norm(place - row[20:22]) - 0.002 * (action**2).sum()
                        self.assertAlmostEqual(out.rewards[index, step], reward, places=6)
            self.assertGreater(len(hits), 10, f"episode {episode}")
            self.assertTrue(out.truncated.all())
            hits.clear()


class OlderVersionsTest(unittest.TestCase):
    def test_reacher_v1_has_targets_out_of_reach_and_a_third_coordinate(self):
        _, out = started("dmprl/Reacher-v1", env_count=1000)
        distances = np.linalg.norm(out.next_observations[:, 4:6], axis=1)
        # The part of a square of side 0.4 outside the circle of radius 0.2: 1 - pi/4.
        self.assertAlmostEqual((distances > 0.2).mean(), 1 - np.pi / 4, delta=0.04)
        np.testing.assert_array_equal(out.next_observations[:, 10], 0.0)
        _, out = started("Reacher-v5", env_count=1000)
        self.assertLess(np.linalg.norm(out.next_observations[:, 4:6], axis=1).max(), 0.2)

    def test_reacher_v1_rewards_the_state_before_the_step(self):
        env, out = started("dmprl/Reacher-v1")
        env.step_segment(np.full((1, 5, 2), 0.5), out)
        expected = -np.linalg.norm(out.observations[0, :5, 8:], axis=1) - 0.5
        np.testing.assert_allclose(out.rewards[0], expected, rtol=1e-12)

    def test_pusher_v0_observes_the_point_between_the_prongs_and_has_a_light_cylinder(self):
        old, out = started("dmprl/Pusher-v0")
        # Centre of mass of the prongs, 0.1 m ahead of the wrist.
        np.testing.assert_allclose(out.next_observations[0, 14:17], [0.921, -0.6, 0], atol=1e-3)
        new, out = started("Pusher-v5")
        np.testing.assert_allclose(out.next_observations[0, 14:17], [0.821, -0.6, 0], atol=1e-3)
        mass = [env.task.model.body("object").mass[0] for env in (old, new)]
        self.assertLess(mass[0], 0.01 * mass[1])

    def test_pusher_v0_pushes_as_with_mujoco_2(self):
        """If the armature is ignored, the cylinder stays at -0.45 and the arm passes through it."""
        env, _ = started("dmprl/Pusher-v0")
        model = env.task.model
        # Constants of MuJoCo 2.3.7: arm, cylinder and goal.
        bodies = [1.05485, 16.66666, 16.66667]
        np.testing.assert_allclose(model.body_invweight0[-3:, 0], bodies, 1e-5)
        np.testing.assert_allclose(model.dof_invweight0[-5:], [24.21685] + [25.0] * 4, 1e-5)
        data = mujoco.MjData(model)
        data.qpos[1] = 0.3
        mujoco.mj_forward(model, data)
        cylinder, prongs = model.body("object").id, model.body("tips_arm").id
        ahead = data.subtree_com[prongs] + [0, 0.15, 0] - data.xpos[cylinder]
        data.qpos[7:9] = ahead[1], ahead[0]
        data.ctrl[0] = 0.6
        for _ in range(60):
            data.qpos[1], data.qvel[1] = 0.3, 0.0
            mujoco.mj_step(model, data, nstep=5)
        pushed = data.xpos[cylinder, :2]
        # The final position with MuJoCo 2.3.7, whose collisions differ slightly.
        np.testing.assert_allclose(pushed, [0.923, -0.316], atol=0.05)

    def test_pusher_v0_rewards_the_state_before_the_step(self):
        env, out = started("dmprl/Pusher-v0")
        env.step_segment(np.full((1, 5, 7), 1.0), out)
        row = out.observations[0, :5]
        near = np.linalg.norm(row[:, 17:20] - row[:, 14:17], axis=1)
        distance = np.linalg.norm(row[:, 17:20] - row[:, 20:23], axis=1)
        np.testing.assert_allclose(out.rewards[0], -distance - 0.5 * near - 0.7, rtol=1e-6)


class BatchTest(unittest.TestCase):
    def test_step_before_reset_is_rejected(self):
        env = make("Reacher-v5", 2, 5)
        out = SegmentBuffers(2, 5, 10, 2)
        env.reset(np.array([1, 0], np.uint8), np.zeros(2, np.uint64), out)
        with self.assertRaisesRegex(SegmentEnvError, "environment 1: step before reset"):
            env.step_segment(np.zeros((2, 5, 2)), out)

    def test_actions_of_another_shape_are_rejected(self):
        env, out = started("Reacher-v5")
        with self.assertRaisesRegex(ValueError, r"expected \(E, K, A\) = \(1, 5, 2\)"):
            env.step_segment(np.zeros((1, 4, 2)), out)

    def test_a_simulation_that_diverges_is_reported_and_restarts(self):
        env, out = started("Pusher-v5", env_count=3)
        twin, out_of_twin = started("Pusher-v5", env_count=3)
        rng = np.random.default_rng(0)
        env.batch.bind("qvel")[1] = 1e12
        for step in range(25):
            actions = random_actions(rng, env.spec(), 3, 5)
            env.step_segment(actions, out)
            twin.step_segment(actions, out_of_twin)
            self.assertEqual(out.failed.tolist(), [0, int(step == 0), 0])
            self.assertTrue(np.isfinite(out.observations).all())
            for index in (0, 2):
                np.testing.assert_array_equal(
                    out.observations[index], out_of_twin.observations[index]
                )
            if step == 0:
                (message,) = env.take_failures()
                self.assertIn(
                    "Pusher-v5, environment 1, this segment: MuJoCo warning (mjWARN_BADQVEL)",
                    message,
                )
                self.assertEqual(out.steps.tolist(), [5, 0, 5])
                np.testing.assert_array_equal(out.observations[1], 0.0)
                self.assertTrue(out.next_observations[1].any())
        self.assertEqual(env.take_failures(), [])


class ImportTest(unittest.TestCase):
    def test_only_a_worker_replaces_mujocos_hooks(self):
        import subprocess
        import sys

        code = (
            "import gymnasium, dmprl; from dmprl.mujoco_batch import mujoco_hook; "
            "hooks = lambda: [mujoco_hook(n).value for n in ('mjcb_time', 'mju_user_warning')]; "
            "before = hooks(); gymnasium.make('dmprl/Reacher-v5'); print(hooks() == before); "
            "from dmprl.segment_env import make; make('Reacher-v5', 1, 5); print(hooks()[0])"
        )
        result = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        self.assertEqual(result.stdout.split(), ["True", "None"])

    def test_a_worker_runs_dmprls_tasks_without_gymnasium(self):
        import subprocess
        import sys

        code = (
            "import sys; sys.modules['gymnasium'] = None; "
            "from dmprl.segment_env import make; print(make('dmprl/Thrower-v0', 1, 5).spec()['id'])"
        )
        result = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        self.assertEqual(result.stdout.strip(), "dmprl/Thrower-v0")


if __name__ == "__main__":
    unittest.main()

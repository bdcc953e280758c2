"""The two Panda tasks, compared with MuJoCo's kinematics and with measurements of panda-gym."""

import unittest

import mujoco
import numpy as np

from dmprl.segment_env import SegmentBuffers, make
from dmprl.tasks.models import own_model
from dmprl.tasks.panda import GOAL_HIGH, GOAL_LOW, MODEL, NEUTRAL

REACH, REACH_JOINTS = "dmprl/PandaReach-v0", "dmprl/PandaReachJoints-v0"
EPISODE_STEPS = 50


def started(task_id, env_count=1, segment_steps=1, seed=7):
    """Returns a task's environments, reset with seeds `seed`, `seed` + 1, …, and their buffers."""
    env = make(task_id, env_count, segment_steps)
    out = SegmentBuffers(env_count, segment_steps, 20, env.spec()["action_len"])
    env.reset(np.ones(env_count, np.uint8), np.arange(seed, seed + env_count).astype("u8"), out)
    return env, out


def run_episodes(task_id, env_count, act):
    """Runs an episode in each environment.

    Returns observations (E, 51, 20), rewards (E, 50) and success at the end (E,).
    """
    env, out = started(task_id, env_count)
    observations, rewards = [out.next_observations.copy()], []
    for _ in range(EPISODE_STEPS):
        env.step_segment(act(observations[-1])[:, None], out)
        observations.append(out.observations[:, 1].copy())
        rewards.append(out.rewards[:, 0].copy())
    assert out.truncated.all() and not out.failed.any()
    return np.stack(observations, 1), np.stack(rewards, 1), out.success.copy()


def proportional(observation):
    """Moves straight to the goal, as fast as actions allow."""
    return np.clip(observation[:, 14:17] / 0.05, -1.0, 1.0)


def uniform(action_len):
    rng = np.random.default_rng(0)
    return lambda observation: rng.uniform(-1.0, 1.0, (len(observation), action_len))


def goals_of(env):
    return env.batch.bind("mocap_pos")[:, 0]


class StartTest(unittest.TestCase):
    def test_end_effector_starts_as_in_panda_gym(self):
        for task_id in (REACH, REACH_JOINTS):
            env, out = started(task_id, env_count=5)
            end_effector = goals_of(env) - out.next_observations[:, 14:17]
            np.testing.assert_allclose(
                end_effector, np.tile([0.0384, 0, 0.1974], (5, 1)), atol=1e-3
            )
            np.testing.assert_array_equal(out.next_observations[:, :7], [NEUTRAL] * 5)
            np.testing.assert_array_equal(out.next_observations[:, 7:14], 0.0)
            np.testing.assert_array_equal(out.next_observations[:, 17:], 0.0)

    def test_goals_fill_panda_gyms_box(self):
        env, _ = started(REACH, env_count=1000)
        low, high = np.array(GOAL_LOW), np.array(GOAL_HIGH)
        np.testing.assert_array_equal(low, [-0.15, -0.15, 0.0])
        np.testing.assert_array_equal(high, [0.15, 0.15, 0.3])
        goals = goals_of(env)
        self.assertTrue(((low <= goals) & (goals <= high)).all())
        # Means and extremes of 1000 uniform draws.
        np.testing.assert_allclose(goals.mean(0), (low + high) / 2, atol=0.012)
        np.testing.assert_allclose(goals.min(0), low, atol=0.003)
        np.testing.assert_allclose(goals.max(0), high, atol=0.003)


class ObservationTest(unittest.TestCase):
    def test_observation_describes_the_state_after_the_step(self):
        model = own_model(MODEL)
        data, jacobian = mujoco.MjData(model), np.zeros((3, 7))
        site = model.site("ee").id
        for task_id, action_len in ((REACH, 3), (REACH_JOINTS, 7)):
            env, out = started(task_id, env_count=4)
            act = uniform(action_len)
            for _ in range(20):
                env.step_segment(act(out.next_observations)[:, None], out)
                goals, observations = goals_of(env), out.observations[:, 1]
                for goal, row in zip(goals, observations, strict=True):
                    data.qpos[:], data.qvel[:] = row[:7], row[7:14]
                    mujoco.mj_forward(model, data)
                    mujoco.mj_jacSite(model, data, jacobian, None, site)
                    expected = goal - data.site_xpos[site]
                    np.testing.assert_allclose(row[14:17], expected, atol=1e-12)
                    np.testing.assert_allclose(row[17:], jacobian @ row[7:14], atol=1e-12)
                state = env.batch.bind("qpos"), env.batch.bind("qvel")
                np.testing.assert_array_equal(observations[:, :14], np.hstack(state))

    def test_observation_entries_have_names(self):
        names = make(REACH, 1, 5).spec()["observation_names"]
        self.assertEqual(names[0], "angle_joint1")
        self.assertEqual(names[7], "velocity_joint1")
        self.assertEqual(names[14:17], [f"end_effector_to_goal_{axis}" for axis in "xyz"])
        self.assertEqual(names[17:], [f"velocity_end_effector_{axis}" for axis in "xyz"])
        self.assertEqual(make(REACH_JOINTS, 1, 5).spec()["observation_names"], names)

    def test_reward_and_success_depend_on_the_state_after_the_step(self):
        observations, rewards, success = run_episodes(
            REACH, 40, lambda row: proportional(row) * (np.arange(len(row)) < 20)[:, None]
        )
        distances = np.linalg.norm(observations[:, 1:, 14:17], axis=2)
        np.testing.assert_allclose(rewards, -distances, rtol=1e-14)
        np.testing.assert_array_equal(success, distances[:, -1] < 0.05)
        self.assertTrue(20 <= success.sum() < 40, "not both outcomes")

    def test_success_depends_on_the_last_executed_step(self):
        """An episode may end within a segment, while other environments continue."""
        env, out = started(REACH, env_count=40, segment_steps=7)
        for segment in range(10):
            actions = np.repeat(proportional(out.next_observations)[:, None], 7, axis=1)
            env.step_segment(actions, out)
            if segment == 2:
                mask = np.arange(40) < 20
                env.reset(mask.astype("u1"), np.arange(40).astype("u8"), out)
            if out.truncated.any():
                break
        self.assertEqual(out.steps.tolist(), [7] * 20 + [1] * 20)
        last = out.observations[np.arange(40), out.steps, 14:17]
        np.testing.assert_array_equal(out.success, np.linalg.norm(last, axis=1) < 0.05)


class EndEffectorTest(unittest.TestCase):
    def test_proportional_controller_reaches_every_goal_as_fast_as_in_panda_gym(self):
        observations, rewards, success = run_episodes(REACH, 100, proportional)
        self.assertTrue(success.all())
        near = np.linalg.norm(observations[:, :, 14:17], axis=2) < 0.05
        # panda-gym 3.0.7 over 25 episodes: 2.4 steps, return -0.24 ± 0.09.
        steps = near.argmax(axis=1)
        self.assertTrue(2.0 <= steps.mean() <= 3.0, steps.mean())
        self.assertLess(steps.max(), 8)
        self.assertTrue(-0.35 < rewards.sum(1).mean() < -0.15, rewards.sum(1).mean())

    def test_zero_action_holds_the_pose(self):
        for task_id, action_len in ((REACH, 3), (REACH_JOINTS, 7)):
            observations, rewards, _ = run_episodes(
                task_id, 100, lambda row, width=action_len: np.zeros((len(row), width))
            )
            moved = observations[:, -1, 14:17] - observations[:, 0, 14:17]
            self.assertLess(np.abs(moved).max(), 1e-3)
            # panda-gym 3.0.7 over 25 episodes: -7.4, with a standard error of 0.4.
            self.assertAlmostEqual(rewards.sum(1).mean(), -7.4, delta=0.8)

    def test_kinematics_reach_the_point_with_the_gripper_pointing_down(self):
        env, _ = started(REACH, env_count=100)
        kinematics, data = env.task._kinematics, mujoco.MjData(env.task.model)
        angles, rng = np.tile(NEUTRAL, (100, 1)), np.random.default_rng(0)
        errors, tilts = [], []
        for _ in range(30):
            fields = self.fields_at(env.task.model, data, angles, kinematics.recorded)
            position = fields["site_xpos"][:, 0]
            # Not near the box's far corner, where the arm is fully stretched.
            target = position + 0.05 * rng.uniform(-1.0, 1.0, position.shape)
            target = np.clip(target, GOAL_LOW, np.array(GOAL_HIGH) - [0.03, 0.0, 0.03])
            target = position + np.clip(target - position, -0.05, 0.05)
            kinematics.solve(fields, target, angles)
            after = self.fields_at(env.task.model, data, angles, kinematics.recorded)
            errors.append(np.linalg.norm(after["site_xpos"][:, 0] - target, axis=1))
            tilts.append(after["site_xmat"][:, 0] - np.diag([1.0, -1.0, -1.0]).ravel())
        self.assertLess(np.max(errors), 5e-4)
        self.assertLess(np.abs(tilts).max(), 5e-3)

    def fields_at(self, model, data, angles, names):
        fields = {name: [] for name in names}
        for row in angles:
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            for name, values in fields.items():
                values.append(getattr(data, name).copy())
        return {"qpos": angles.copy()} | {name: np.array(rows) for name, rows in fields.items()}

    def test_targets_stay_above_the_table(self):
        observations, _, _ = run_episodes(
            REACH, 5, lambda row: np.tile([0.0, 0.0, -1.0], (len(row), 1))
        )
        descended = observations[:, 0, 16] - observations[:, -1, 16]
        np.testing.assert_allclose(-descended, 0.1974, atol=0.01)


class JointsTest(unittest.TestCase):
    def test_displacement_of_each_joint_is_reached_as_in_panda_gym(self):
        """From rest, a joint moves four fifths of the way in the first step."""
        env, out = started(REACH_JOINTS, env_count=14)
        signs = np.concatenate([np.eye(7), -np.eye(7)])
        env.step_segment(signs[:, None], out)
        moved = (out.observations[:, 1, :7] - NEUTRAL) @ signs.T / 0.05
        share = np.diag(moved)
        # Joint 1 is limited by its torque; PyBullet's servo leaves 12 % to the other joints.
        self.assertTrue((share > 0.55).all() and (share < 1.1).all(), share)
        self.assertGreater(np.median(share), 0.8)

    def test_random_displacements_are_followed_as_in_panda_gym(self):
        observations = np.zeros((50, 51, 20))
        actions, act = [], uniform(7)

        def record(row):
            actions.append(act(row))
            return actions[-1]

        observations, _, _ = run_episodes(REACH_JOINTS, 50, record)
        requested = 0.05 * np.stack(actions, 1)
        moved = np.diff(observations[:, :, :7], axis=1)
        slope = (requested * moved).sum((0, 1)) / np.square(requested).sum((0, 1))
        # panda-gym 3.0.7, 30 episodes. Gravity, which loads its joint 2, has no effect here.
        panda_gym = [0.594, 0.518, 0.844, 0.821, 0.853, 0.878, 0.878]
        np.testing.assert_allclose(slope, panda_gym, atol=0.13)


class PhysicsTest(unittest.TestCase):
    def test_random_full_actions_leave_the_arm_in_its_limits(self):
        for task_id, action_len in ((REACH, 3), (REACH_JOINTS, 7)):
            rng = np.random.default_rng(0)
            observations, _, _ = run_episodes(
                task_id,
                100,
                lambda row, width=action_len, rng=rng: rng.choice([-1.0, 1.0], (len(row), width)),
            )
            low, high = own_model(MODEL).jnt_range.T
            angles = observations[:, :, :7]
            self.assertTrue((angles > low - 0.1).all() and (angles < high + 0.1).all())
            self.assertLess(np.abs(observations[:, :, 7:14]).max(), 25.0)

    def test_hand_and_forearm_do_not_enter_the_table(self):
        model = own_model(MODEL)
        data = mujoco.MjData(model)
        env, out = started(REACH_JOINTS, env_count=16)
        # Bends shoulder and elbow down, with some noise.
        rng, touched = np.random.default_rng(0), 0
        for _ in range(40):
            actions = 0.5 * rng.uniform(-1.0, 1.0, (16, 1, 7))
            actions[:, 0, 1] = 1.0
            env.step_segment(actions, out)
            for row in out.observations[:, 1]:
                data.qpos[:] = row[:7]
                mujoco.mj_forward(model, data)
                touched += data.ncon > 0
                if data.ncon:
                    self.assertGreater(data.contact.dist.min(), -0.01)
        self.assertGreater(touched, 100)

    def test_the_model_for_pictures_has_the_dynamics_of_the_simulated_one(self):
        model = make(REACH, 1, 5).task.model
        shown = own_model(MODEL)
        self.assertLess(model.ngeom, shown.ngeom)
        for name in ("nq", "nv", "nu", "nmocap", "nbody", "nsite"):
            self.assertEqual(getattr(model, name), getattr(shown, name))
        for name in ("body_mass", "body_inertia", "body_ipos", "body_pos", "actuator_gainprm"):
            np.testing.assert_array_equal(getattr(model, name), getattr(shown, name))
        self.assertEqual((model.nq, model.nv), (7, 7))


if __name__ == "__main__":
    unittest.main()

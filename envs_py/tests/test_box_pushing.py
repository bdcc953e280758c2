"""Box pushing, compared with fancy-gym's rules, written here one state at a time."""

import unittest

import gymnasium
import mujoco
import numpy as np

import dmprl  # noqa: F401 - registers the tasks
from dmprl.segment_env import SegmentBuffers, make
from dmprl.tasks import make_task
from dmprl.tasks.box_pushing_scene import TABLE_HEIGHT

DENSE, SPARSE = "dmprl/BoxPushingDense-v0", "dmprl/BoxPushingTemporalSparse-v0"
HAND_DOWN = np.array([0.0, 1.0, 0.0, 0.0])


def started(task_id, env_count=1, segment_steps=5, seed=7):
    """Returns a task's environments, reset with seeds `seed`, `seed` + 1, …, and their buffers."""
    env = make(task_id, env_count, segment_steps)
    out = SegmentBuffers(env_count, segment_steps, 28, 7)
    env.reset(np.ones(env_count, np.uint8), np.arange(seed, seed + env_count).astype("u8"), out)
    return env, out


def angle_between(first, second):
    """Returns the rotation's angle by MuJoCo's difference of quaternions."""
    difference = np.zeros(3)
    mujoco.mju_subQuat(difference, first, second)
    return np.linalg.norm(difference)


class Rule:
    """fancy-gym's reward of one state, with MuJoCo's own kinematics."""

    def __init__(self):
        self.model = make_task(DENSE, 1).picture_model()
        self.data = mujoco.MjData(self.model)

    def reward(self, row, action, sparse, last):
        self.data.qpos[:7] = row[:7]
        mujoco.mj_kinematics(self.model, self.data)
        tip, rod = self.data.site("ee").xpos, np.zeros(4)
        mujoco.mju_mat2Quat(rod, self.data.site("ee").xmat)
        torque = 10 * np.clip(action, -1, 1)
        box, box_turn, goal, goal_turn = np.split(row[14:], [3, 7, 10])
        reward = -2 * max(np.linalg.norm(box - tip), 0.05)
        for angle, low, high in zip(row[:7], *LIMITS, strict=True):
            reward -= max(angle - high, 0) + max(low - angle, 0)
        for velocity, most in zip(row[7:14], [2.175] * 4 + [2.61] * 3, strict=True):
            reward -= max(abs(velocity) - most, 0)
        reward -= (0.02 if sparse else 0.0005) * sum(torque**2)
        tilt = angle_between(rod, HAND_DOWN)
        if tilt > np.pi / 4:
            reward -= tilt / np.pi
        to_goal = 3.5 * np.linalg.norm(box - goal) + angle_between(box_turn, goal_turn) / np.pi
        if not sparse:
            reward -= to_goal
        elif last:
            reward -= 100 * to_goal + 50 * np.linalg.norm(row[7:14])
        return reward


LIMITS = (
    [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973],
    [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973],
)


def random_states(count):
    """Returns states, some of them beyond the joints' limits, others at the goal."""
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(count, 28))
    rows[:, :7] = rng.uniform(-3.2, 3.8, (count, 7))
    rows[:, 7:14] *= 2.0
    rows[:, 14:17] *= 0.3
    for turn in (rows[:, 17:21], rows[:, 24:28]):
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    rows[:, 21:24] = rows[:, 14:17] + rng.normal(size=(count, 3)) * 0.05
    rows[::2, 24:28] = rows[::2, 17:21] + 0.2 * rng.normal(size=(len(rows[::2]), 4))
    rows[::2, 24:28] /= np.linalg.norm(rows[::2, 24:28], axis=1, keepdims=True)
    # Half a turn about x, the rod upright, and small deviations from it.
    upright = [0.387, 0.176, 0.25, -2.399, -0.08, 2.569, 1.48]
    rows[::3, :7] = upright + 0.3 * rng.normal(size=(len(rows[::3]), 7))
    return rows


class RewardTest(unittest.TestCase):
    def test_rewards_of_random_states_are_fancy_gyms(self):
        rows, rule = random_states(1000), Rule()
        actions = np.random.default_rng(1).uniform(-1.5, 1.5, (1000, 1, 7)).astype(np.float32)
        states = np.stack([np.zeros_like(rows), rows], axis=1)
        for task_id, elapsed in ((DENSE, 0), (DENSE, 99), (SPARSE, 0), (SPARSE, 99)):
            task, found = make_task(task_id, 1000), np.zeros((1000, 1))
            task.episodes_began(np.arange(1000))
            for _ in range(elapsed):
                task.rewards(states, actions, found)
            task.rewards(states, actions, found)
            expected = [
                rule.reward(row, action[0], task_id == SPARSE, elapsed == 99)
                for row, action in zip(rows, actions, strict=True)
            ]
            np.testing.assert_allclose(found[:, 0], expected, rtol=1e-6, atol=1e-6)

    def test_a_reward_worked_by_hand(self):
        # The hand as at the start; the box 1 m above the tip, 1 m beside its goal and turned by a
        # quarter; joint 2 at 3 rad/s; torques of 5 N m.
        env, out = started(DENSE)
        row = out.next_observations[0].copy()
        task = env.task
        tip = env.task._kinematics.pose(row[None, :7])[0, :, 3]
        row[7:14] = 0, 3, 0, 0, 0, 0, 0
        row[14:17], row[17:21] = tip, (1, 0, 0, 0)
        row[21:24], row[24:28] = tip, (np.sqrt(0.5), 0, 0, np.sqrt(0.5))
        row[[16, 21, 23]] += 1
        states, found = np.stack([row, row])[None], np.zeros((1, 1))
        actions = np.full((1, 1, 7), 0.5, np.float32)
        task.rewards(states, actions, found)
        # Distance to the box, velocity, energy, distance to the goal, angle.
        self.assertAlmostEqual(
            found[0, 0], -2.0 - (3 - 2.175) - 0.0005 * 7 * 25 - 3.5 - 0.5, places=9
        )
        sparse = make_task(SPARSE, 1)
        for _ in range(100):
            sparse.rewards(states, actions, found)
        self.assertAlmostEqual(
            found[0, 0], -2.0 - 0.825 - 0.02 * 7 * 25 - 350.0 - 50.0 - 150.0, places=9
        )

    def test_sparse_reward_is_paid_at_step_100_in_every_segmentation(self):
        returns = []
        for steps in (1, 5, 7):
            env, out = started(SPARSE, env_count=3, segment_steps=steps)
            rng, rewards = np.random.default_rng(0), [[], [], []]
            actions = 0.1 * rng.uniform(-1, 1, (3, 210, 7))
            for at in range(0, 200, steps):
                env.step_segment(actions[:, at : at + steps], out)
                for index, kept in enumerate(rewards):
                    kept += out.rewards[index, : out.steps[index]].tolist()
                if out.truncated.any():
                    break
            self.assertTrue(out.truncated.all())
            returns.append(rewards)
            self.assertEqual({len(kept) for kept in rewards}, {100})
            self.assertLess(max(kept[-1] for kept in rewards), min(min(k[:-1]) for k in rewards))
        np.testing.assert_array_equal(returns[0], returns[1])
        np.testing.assert_array_equal(returns[0], returns[2])

    def test_success_needs_5_cm_and_half_a_radian(self):
        rows, task = random_states(1000), make_task(DENSE, 1000)
        found = np.zeros(1000, np.uint8)
        task.successes(rows, found)
        expected = [
            np.linalg.norm(row[14:17] - row[21:24]) < 0.05
            and angle_between(row[17:21], row[24:28]) < 0.5
            for row in rows
        ]
        np.testing.assert_array_equal(found, expected)
        self.assertTrue(20 < found.sum() < 980, "not both outcomes")


class StartTest(unittest.TestCase):
    def test_starts_and_goals_of_each_seed_are_fancy_gyms(self):
        _, out = started(DENSE, env_count=200, seed=0)
        for seed, row in enumerate(out.next_observations):
            rng, place = np.random.default_rng(seed), [0.4, 0.3]
            while np.linalg.norm(np.subtract(place, [0.4, 0.3])) < 0.3:
                *place, height = rng.uniform([0.3, -0.45, -0.01], [0.6, 0.45, -0.01])
                half = rng.uniform(0, 2 * np.pi) / 2
            goal = [*place, height, np.sin(half), 0, 0, np.cos(half)]
            np.testing.assert_allclose(row[21:28], goal, atol=1e-12)
            np.testing.assert_array_equal(row[14:21], [0.4, 0.3, -0.01, 0, 0, 0, 1])
            np.testing.assert_array_equal(row[7:14], 0.0)

    def test_goals_fill_the_rectangle_outside_the_circle_around_the_box(self):
        _, out = started(DENSE, env_count=3000)
        goals = out.next_observations[:, 21:28]
        np.testing.assert_allclose(goals[:, :2].min(0), [0.3, -0.45], atol=2e-3)
        self.assertAlmostEqual(goals[:, 0].max(), 0.6, delta=2e-3)
        distances = np.linalg.norm(goals[:, :2] - [0.4, 0.3], axis=1)
        self.assertTrue(0.3 <= distances.min() < 0.31)
        turns = 2 * np.arctan2(goals[:, 6], goals[:, 3]) % (2 * np.pi)
        share = np.histogram(turns, 8, (0, 2 * np.pi))[0] / 3000
        np.testing.assert_allclose(share, 0.125, atol=0.025)

    def test_the_rod_starts_upright_inside_the_box(self):
        env, out = started(DENSE)
        pose = env.task._kinematics.pose(out.next_observations[:, :7])[0]
        # fancy-gym puts a point 9.5 cm above the tip 15 cm above the box, to within 3 mm.
        np.testing.assert_allclose(pose[:, 3], [0.4, 0.3, 0.045], atol=1e-3)
        np.testing.assert_allclose(pose[:, :3], np.diag([1, -1, -1]), atol=0.01)


class PhysicsTest(unittest.TestCase):
    def test_without_action_arm_and_box_stay(self):
        env, out = started(DENSE, env_count=3)
        first = out.next_observations.copy()
        for _ in range(19):
            env.step_segment(np.zeros(out.actions.shape), out)
        np.testing.assert_allclose(out.next_observations[:, :7], first[:, :7], atol=2e-3)
        np.testing.assert_allclose(out.next_observations[:, 14:16], first[:, 14:16], atol=1e-3)
        height = TABLE_HEIGHT + 0.01
        np.testing.assert_allclose(out.next_observations[:, 16], height, atol=1e-3)

    def test_an_action_is_a_torque_of_10_newton_metres_besides_the_bias(self):
        env, out = started(DENSE, env_count=14, segment_steps=1)
        env.step_segment(np.concatenate([np.eye(7), -9 * np.eye(7)])[:, None], out)
        model, data = env.task.model, mujoco.MjData(env.task.model)
        data.qpos[:] = env.batch.bind("qpos")[0]
        _, begin = started(DENSE)
        data.qpos[:7] = begin.next_observations[0, :7]
        mujoco.mj_forward(model, data)
        for index, controls in enumerate(env.batch.bind("ctrl")):
            torque = np.zeros(7)
            torque[index % 7] = 10 if index < 7 else -10
            np.testing.assert_allclose(
                controls, np.clip(data.qfrc_bias[:7] + torque, *FORCES), atol=1e-9
            )

    def test_a_sliding_box_slows_down_by_its_friction(self):
        env, out = started(DENSE, segment_steps=1)
        env.batch.bind("qpos")[0, 7:10] = 0.5, -0.4, TABLE_HEIGHT + 0.01
        env.batch.bind("qvel")[0, 7] = 0.8
        speeds = []
        for _ in range(10):
            env.step_segment(np.zeros((1, 1, 7)), out)
            speeds.append(env.batch.bind("qvel")[0, 7])
        # On average, because it rocks a little.
        self.assertAlmostEqual((speeds[0] - speeds[-1]) / 0.18, 0.3 * 9.81, delta=0.15)

    def test_the_arms_masses_are_fancy_gyms(self):
        model = make_task(DENSE, 1).model
        # Link 7 with flange, hand, fingers, tips and rod, a cylinder of 1000 kg/m³.
        rod = np.pi * 0.01**2 * 0.3 * 1000
        last = 0.417345 + 0.1 + 0.670782 + 2 * (0.0218754 + 0.01) + rod
        masses = [2.77281, 2.7996, 2.14603, 2.18807, 3.19545, 1.35761, last]
        np.testing.assert_allclose(model.body_mass[1:8], masses, atol=1e-6)
        self.assertAlmostEqual(model.body("box").mass[0], 2.004, places=9)
        self.assertEqual((model.opt.timestep, model.nq, model.nv, model.nu), (0.002, 14, 13, 7))

    def test_the_model_for_pictures_has_the_dynamics_of_the_simulated_one(self):
        task = make_task(DENSE, 1)
        model, shown = task.model, task.picture_model()
        self.assertLess(model.ngeom, shown.ngeom)
        for name in ("nq", "nv", "nu", "nmocap", "nbody", "nsite"):
            self.assertEqual(getattr(model, name), getattr(shown, name))
        for name in ("body_mass", "body_inertia", "body_ipos", "body_pos", "actuator_gainprm"):
            np.testing.assert_array_equal(getattr(model, name), getattr(shown, name))

    def test_a_controller_drags_the_box_close_to_its_goal(self):
        env, out = started(DENSE, env_count=10, segment_steps=1)
        model, data = env.task.model, mujoco.MjData(env.task.model)
        jacobian, turn = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        start = out.next_observations[:, 14:16].copy()
        goals = out.next_observations[:, 21:23].copy()
        for step in range(100):
            for index, row in enumerate(out.next_observations):
                data.qpos[:7], data.qvel[:7] = row[:7], row[7:14]
                mujoco.mj_forward(model, data)
                mujoco.mj_jacSite(model, data, jacobian, turn, 0)
                share = min(step / 80, 1.0)
                place = start[index] + share * (goals[index] - start[index])
                force = 300 * (np.append(place, 0.045) - data.site_xpos[0])
                axes = data.site_xmat[0].reshape(3, 3)
                tilt = np.cross(axes[:, 2], [0, 0, -1])
                force -= 30 * jacobian[:, :7] @ row[7:14]
                torque = 60 * tilt - 3 * turn[:, :7] @ row[7:14]
                torques = jacobian[:, :7].T @ force + turn[:, :7].T @ torque
                torques -= 3 * row[7:14]
                out.actions[index, 0] = np.clip(torques / 10, -1, 1)
            env.step_segment(out.actions, out)
        self.assertTrue(out.truncated.all())
        rest = np.linalg.norm(out.observations[:, 1, 14:16] - goals, axis=1)
        self.assertLess(np.median(rest), 0.15, rest)

    def test_the_gymnasium_environment_reports_success(self):
        env = gymnasium.make(DENSE)
        observation, _ = env.reset(seed=3)
        self.assertEqual((observation.shape, env.action_space.shape), ((28,), (7,)))
        self.assertIs(env.step(env.action_space.sample())[4]["is_success"], False)


FORCES = np.array([-87, -87, -87, -87, -12, -12, -12]), np.array([87, 87, 87, 87, 12, 12, 12])


if __name__ == "__main__":
    unittest.main()

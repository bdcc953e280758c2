"""The Panda's tasks with objects, compared with panda-gym."""

import json
import unittest
from pathlib import Path

import gymnasium
import mujoco
import numpy as np

import dmprl  # noqa: F401 - registers the tasks
from dmprl.segment_env import GoalRows, SegmentBuffers, make
from dmprl.tasks import TASKS, make_task
from dmprl.tasks.panda import NEUTRAL
from dmprl.tasks.panda_objects import euler_angles
from dmprl.tasks.scripted import CONTROLLERS, record

# Made by tests/golden/panda_gym/make_golden.py.
GOLDEN = json.loads(
    (Path(__file__).parents[2] / "tests/golden/panda_gym/golden.json").read_text("utf-8")
)
IDS = {name: f"dmprl/{name}-v0" for name in GOLDEN}
VARIANTS = "", "Dense", "Joints", "JointsDense"


def started(task_id, env_count=1, segment_steps=1, seed=7):
    """Returns a task's environments, reset with seeds `seed`, `seed` + 1, …, and their buffers."""
    env = make(task_id, env_count, segment_steps)
    spec = env.spec()
    out = SegmentBuffers(env_count, segment_steps, spec["observation_len"], spec["action_len"])
    env.reset(np.ones(env_count, np.uint8), np.arange(seed, seed + env_count).astype("u8"), out)
    return env, out


def column(env, name):
    return env.spec()["observation_names"].index(name)


class StartTest(unittest.TestCase):
    def test_starts_and_goals_of_each_seed_are_panda_gyms(self):
        for name, task_id in IDS.items():
            golden = GOLDEN[name]
            for variant in VARIANTS:
                env, out = started(task_id.replace("-", f"{variant}-"), len(golden["goal"]), seed=0)
                length = env.task.goal_len
                rows = out.next_observations
                np.testing.assert_allclose(
                    rows[:, :length], golden["objects"], atol=1e-6, err_msg=name
                )
                np.testing.assert_allclose(rows[:, length : 2 * length], golden["goal"], atol=1e-6)

    def test_starts_and_goals_fill_panda_gyms_ranges(self):
        goal_x, goal_height = {"PandaSlide": 0.4}, {"PandaPickAndPlace": 0.2}
        for name, task_id in IDS.items():
            env, out = started(task_id, env_count=2000)
            length = env.task.goal_len
            objects, goals = np.split(out.next_observations[:, : 2 * length], 2, axis=1)
            for values, middle in ((objects, 0.0), (goals, goal_x.get(name, 0.0))):
                np.testing.assert_allclose(values[:, :2].min(0), [middle - 0.15, -0.15], atol=2e-3)
                np.testing.assert_allclose(values[:, :2].max(0), [middle + 0.15, 0.15], atol=2e-3)
                # Mean and standard deviation of 2000 uniform draws.
                np.testing.assert_allclose(values[:, :2].mean(0), [middle, 0.0], atol=6e-3)
                np.testing.assert_allclose(values[:, :2].std(0), 0.3 / np.sqrt(12), atol=4e-3)
            heights = goals[:, 2] - goals[:, 2].min()
            self.assertAlmostEqual(heights.max(), goal_height.get(name, 0.0), delta=1e-3)
            if name in goal_height:
                self.assertAlmostEqual((heights == 0.0).mean(), 0.3, delta=0.04)

    def test_the_arm_starts_at_rest_in_panda_gyms_pose(self):
        for task_id in IDS.values():
            env, out = started(task_id.replace("-", "Joints-"), env_count=3)
            at = column(env, "angle_joint1")
            np.testing.assert_array_equal(out.next_observations[:, at : at + 7], [NEUTRAL] * 3)
            np.testing.assert_array_equal(out.next_observations[:, at + 7 : at + 14], 0.0)
            hand = out.next_observations[:, at + 14 : at + 17]
            np.testing.assert_allclose(hand, [[0.0384, 0, 0.1974]] * 3, atol=1e-3)


class RewardTest(unittest.TestCase):
    def test_rewards_and_successes_are_panda_gyms(self):
        for name, task_id in IDS.items():
            golden = {key: np.array(values) for key, values in GOLDEN[name]["rewards"].items()}
            achieved, desired = golden["achieved"], golden["desired"]
            for kind, suffix in (("sparse", ""), ("dense", "Dense")):
                env = gymnasium.make(task_id.replace("-", f"{suffix}-"))
                rewards = env.unwrapped.compute_reward(achieved, desired, {})
                np.testing.assert_allclose(rewards, golden[kind], atol=1e-6)
                one = env.unwrapped.compute_reward(achieved[0], desired[0], {})
                self.assertEqual((one.shape, one), ((), rewards[0]))
                task = env.unwrapped.task
                success = np.zeros(len(achieved), np.uint8)
                task.successes(np.hstack([achieved, desired]), success)
                np.testing.assert_array_equal(success, golden["success"])
                self.assertTrue(0 < success.sum() < success.size, "not both outcomes")

    def test_relabelling_with_the_same_goals_does_not_change_rewards(self):
        for task_id in TASKS:
            if not task_id.startswith(tuple(task.removesuffix("-v0") for task in IDS.values())):
                continue
            env, out = started(task_id, env_count=4, segment_steps=5)
            goals = env.goals()
            length = goals["length"]
            self.assertEqual((goals["achieved"], goals["desired"]), (0, length))
            self.assertEqual(goals["sparse"], "Dense" not in task_id)
            rows, rng = GoalRows(32, length), np.random.default_rng(0)
            rows.terminated[:] = 9
            env.step_segment(rng.uniform(-1, 1, out.actions.shape), out)
            after = out.observations[:, 1:].reshape(20, -1)
            rows.count[0] = 20
            rows.achieved[:20], rows.desired[:20] = after[:, :length], after[:, length : 2 * length]
            env.relabel(rows)
            np.testing.assert_array_equal(rows.rewards[:20], out.rewards.ravel())
            np.testing.assert_array_equal(rows.rewards[20:], 0.0)
            self.assertEqual(rows.terminated.tolist(), [0] * 20 + [9] * 12)

    def test_the_gymnasium_environments_hindsight_agrees(self):
        """The worker's own path for Gymnasium environments finds the same goals."""
        from dmprl.gymnasium_env import GymnasiumSegmentEnv

        for task_id in IDS.values():
            for suffix in ("", "Dense"):
                wrapped = task_id.replace("-", f"{suffix}-")
                self.assertEqual(
                    GymnasiumSegmentEnv(wrapped, 1, 5).goals(), make(wrapped, 1, 5).goals()
                )


class ObservationTest(unittest.TestCase):
    def test_observation_describes_the_state_after_the_step(self):
        for task_id in IDS.values():
            env, out = started(task_id, env_count=4)
            model, rng = env.task.model, np.random.default_rng(0)
            data = mujoco.MjData(model)
            names = ["object"] if env.task.goal_len == 3 else ["object1", "object2"]
            for _ in range(40):
                env.step_segment(rng.uniform(-1, 1, out.actions.shape), out)
                for index, row in enumerate(out.observations[:, 1]):
                    mujoco.mj_setState(
                        model, data, env.batch.state[index], mujoco.mjtState.mjSTATE_INTEGRATION
                    )
                    mujoco.mj_forward(model, data)
                    at = column(env, "end_effector_x")
                    np.testing.assert_allclose(row[at : at + 3], data.site("ee").xpos, atol=1e-12)
                    for place, name in enumerate(names):
                        at = column(env, f"{name}_x")
                        position = data.body(name).xpos
                        np.testing.assert_allclose(row[3 * place : 3 * place + 3], position)
                        np.testing.assert_allclose(row[at : at + 3], position)
                        velocity = np.zeros(6)
                        kind = mujoco.mjtObj.mjOBJ_XBODY
                        mujoco.mj_objectVelocity(
                            model, data, kind, model.body(name).id, velocity, False
                        )
                        np.testing.assert_allclose(row[at + 6 : at + 9], velocity[3:], atol=1e-9)
                        np.testing.assert_allclose(row[at + 9 : at + 12], velocity[:3], atol=1e-9)

    def test_slide_observes_the_remaining_time(self):
        env, out = started(IDS["PandaSlide"], env_count=2)
        at = column(env, "remaining_time")
        np.testing.assert_array_equal(out.next_observations[:, at], 1.0)
        steps = env.task.episode_steps
        for done in range(1, steps + 1):
            env.step_segment(np.zeros(out.actions.shape), out)
            np.testing.assert_allclose(out.observations[:, 1, at], 1.0 - done / steps, atol=1e-6)
        np.testing.assert_array_equal(out.next_observations[:, at], 1.0, "a new episode")

    def test_euler_angles_are_rotations_about_fixed_axes(self):
        rng = np.random.default_rng(0)
        angles = rng.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (200, 3))
        quaternions, found = np.zeros((200, 4)), np.zeros((200, 3))
        for row, target in zip(angles, quaternions, strict=True):
            mujoco.mju_euler2Quat(target, row, "XYZ")
        euler_angles(quaternions, found)
        np.testing.assert_allclose(found, angles, atol=1e-9)

    def test_an_environment_does_not_depend_on_the_number_of_its_neighbours(self):
        """Vectorised functions must not round the last elements of an array differently."""
        for task_id in IDS.values():
            runs = []
            for env_count in (1, 2, 7, 9):
                env, out = started(task_id, env_count, segment_steps=5)
                rng, parts = np.random.default_rng(0), []
                for _ in range(10):
                    actions = np.repeat(
                        rng.uniform(-1, 1, (1, *out.actions.shape[1:])), env_count, 0
                    )
                    env.step_segment(actions, out)
                    parts += [out.observations[0].tobytes(), out.rewards[0].tobytes()]
                runs.append(parts)
            self.assertTrue(all(run == runs[0] for run in runs), task_id)


class PhysicsTest(unittest.TestCase):
    def test_objects_rest_where_they_start(self):
        for task_id in IDS.values():
            env, out = started(task_id, env_count=20, segment_steps=5)
            first = out.next_observations.copy()
            for _ in range(4):
                env.step_segment(np.zeros(out.actions.shape), out)
            now = out.next_observations
            np.testing.assert_allclose(now[:, :2], first[:, :2], atol=1e-3)
            height = 0.015 if "Slide" in task_id else 0.02
            if "Stack" not in task_id:  # there, the second cube may fall on the first
                np.testing.assert_allclose(now[:, 2], height, atol=1e-3)
            hand = column(env, "end_effector_x")
            moved = out.next_observations[:, hand : hand + 3] - first[:, hand : hand + 3]
            self.assertLess(np.abs(moved).max(), 1e-3, "the arm sags")

    def test_a_sliding_object_slows_down_as_in_panda_gym(self):
        # panda-gym 3.0.7 [m/s²]: a cube that starts with 0.5 m/s, a puck at 0.4 m/s.
        for name, speed, expected in (("PandaPush", 0.5, 2.46), ("PandaSlide", 0.4, 0.22)):
            env, out = started(IDS[name])
            height = env.task.scene.objects[0].size[1]
            env.batch.bind("qpos")[0, 7:10] = -0.1, 0.1, height
            env.batch.bind("qvel")[0, 7] = speed
            at = column(env, "velocity_object_x")
            env.step_segment(np.zeros((1, 1, 3)), out)
            before = out.observations[0, 1, at]
            env.step_segment(np.zeros((1, 1, 3)), out)
            self.assertAlmostEqual(
                (before - out.observations[0, 1, at]) / 0.04, expected, delta=0.06 * expected
            )

    def test_the_model_for_pictures_has_the_dynamics_of_the_simulated_one(self):
        for task_id in IDS.values():
            task = make_task(task_id, 1)
            model, shown = task.model, task.picture_model()
            self.assertLess(model.ngeom, shown.ngeom)
            for name in ("nq", "nv", "nu", "nmocap", "nbody", "nsite"):
                self.assertEqual(getattr(model, name), getattr(shown, name))
            for name in ("body_mass", "body_inertia", "body_ipos", "body_pos", "actuator_gainprm"):
                np.testing.assert_array_equal(getattr(model, name), getattr(shown, name))


class ScriptedTest(unittest.TestCase):
    def test_scripted_controllers_solve_every_task(self):
        self.assertEqual(set(CONTROLLERS), set(IDS.values()))
        for task_id in CONTROLLERS:
            recording = record(task_id, 40, seed=1000)
            # At least 95 % of 200 episodes; of 40 a few less may succeed by chance.
            self.assertGreaterEqual(recording.success.mean(), 0.9, task_id)
            steps, length = recording.steps, TASKS[task_id].episode_steps
            self.assertEqual({len(rows) for rows in steps.values()}, {40 * length})
            inner = ~steps["truncated"][:-1].astype(bool)
            np.testing.assert_array_equal(
                steps["next_observations"][:-1][inner], steps["observations"][1:][inner]
            )
            self.assertLessEqual(np.abs(steps["actions"]).max(), CONTROLLERS[task_id].action_max)
            kept = recording.successful()
            self.assertEqual(len(kept["rewards"]), length * recording.success.sum())
            self.assertTrue((kept["rewards"][length - 1 :: length] == 0.0).all())


if __name__ == "__main__":
    unittest.main()

"""Physics, start and delays that are drawn for each episode."""

import copy
import sys
import unittest
from pathlib import Path

import gymnasium
import mujoco
import numpy as np

import dmprl  # noqa: F401 - registers the tasks
from dmprl import goal_rule, recording
from dmprl.env_options import NO_OPTIONS, EnvOptions, Randomise, RandomiseError
from dmprl.randomise import CHANGED, ModelRandomiser, objects_of
from dmprl.segment_env import SegmentBuffers, make
from dmprl.tasks import TASKS, make_task

sys.path.append(str(Path(__file__).parent))  # for the tiny environments' module

STEPS = 5
PHYSICS = Randomise(mass=(0.5, 2.0), friction=(0.5, 2.0), damping=(0.5, 2.0))
OBJECTS = PHYSICS._replace(object_size=(0.7, 1.3), start_pose=(-0.02, 0.02))
DELAYS = Randomise(action_delay_steps=(0, 2), observation_delay_steps=(0, 3))


def options(randomise, **kwargs):
    return EnvOptions(kwargs, (), randomise)


def segments(env, count, seed=7):
    """Returns copies of the results of segments of random actions, and these actions."""
    spec, envs = env.spec(), env.env_count
    out = SegmentBuffers(envs, STEPS, spec["observation_len"], spec["action_len"])
    env.reset(np.ones(envs, np.uint8), np.arange(seed, seed + envs).astype("u8"), out)
    rng, shape = np.random.default_rng(0), (envs, STEPS, spec["action_len"])
    results = []
    for _ in range(count):
        started = out.next_observations.copy()
        actions = rng.uniform(spec["action_low"], spec["action_high"], shape)
        env.step_segment(actions, out)
        assert not out.failed.any(), env.take_failures()
        results.append((started, out.observations.copy(), out.rewards.copy(), actions))
    return results


def assert_equal(left, right):
    for arrays in zip(left, right, strict=True):
        for pair in zip(*arrays, strict=True):
            np.testing.assert_array_equal(*pair)


def same(left, right):
    try:
        assert_equal(left, right)
    except AssertionError:
        return False
    return True


def cube_model():
    """Returns a cube and an arm of a damped and a servoed joint."""
    return mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="1 1 1" friction="0.4 0.01 0.001"/>
        <body name="cube" pos="0 0 0.02"><freejoint/>
          <geom type="box" size="0.02 0.02 0.02" mass="1"/></body>
        <body pos="0 1 1"><joint name="a" axis="0 1 0" damping="2"/><geom size="0.1" mass="3"/>
          <body><joint name="b" axis="0 1 0"/><geom size="0.1" mass="3"/></body></body>
        </worldbody>
        <actuator><position joint="b" kp="10" kv="4"/></actuator></mujoco>"""
    )


class ModelTest(unittest.TestCase):
    def test_each_episode_draws_from_the_ranges(self):
        nominal, model = cube_model(), cube_model()
        randomiser = ModelRandomiser("cube", OBJECTS, model)
        randomiser.seed(3)
        drawn = []
        for _ in range(200):
            randomiser.draw()
            mass = model.body_mass[1:] / nominal.body_mass[1:]
            size = model.geom_size[1] / nominal.geom_size[1]
            inertia = model.body_inertia[1] / nominal.body_inertia[1]
            np.testing.assert_allclose(size, size[0])
            np.testing.assert_allclose(inertia, mass[0] * size[0] ** 2)
            friction = model.geom_friction / nominal.geom_friction
            np.testing.assert_allclose(friction, friction[0, 0])
            damping = model.dof_damping[6] / 2.0, model.actuator_biasprm[0, 2] / -4.0
            qpos = nominal.qpos0.copy()
            randomiser.place(qpos)
            self.assertAlmostEqual(qpos[2], model.geom_size[1, 2], places=12)
            drawn.append([*mass, friction[0, 0], *damping, size[0], *qpos[:2]])
        low, high = np.min(drawn, axis=0), np.max(drawn, axis=0)
        expected = [[0.5] * 6 + [0.7] + [-0.02] * 2, [2.0] * 6 + [1.3] + [0.02] * 2]
        widths = np.subtract(expected[1], expected[0])
        self.assertTrue(np.all(low >= expected[0]) and np.all(high <= expected[1]))
        self.assertTrue(np.all(high - low > 0.9 * widths))
        self.assertLess(np.abs(np.corrcoef(np.transpose(drawn)) - np.eye(9)).max(), 0.4)

    def test_factors_of_one_leave_the_model_unchanged(self):
        model = cube_model()
        mujoco.mj_setConst(model, mujoco.MjData(model))
        nominal = copy.copy(model)
        randomiser = ModelRandomiser("cube", Randomise(), model)
        randomiser.draw()
        for field in (*CHANGED, "body_invweight0", "dof_invweight0", "body_subtreemass"):
            np.testing.assert_array_equal(getattr(model, field), getattr(nominal, field))

    def test_a_resized_cube_collides_like_one_of_that_size(self):
        model = cube_model()
        randomiser = ModelRandomiser("cube", Randomise(object_size=(1.5, 1.5)), model)
        randomiser.draw()
        data = mujoco.MjData(model)
        randomiser.place(data.qpos)
        mujoco.mj_step(model, data, 1_000)
        self.assertAlmostEqual(data.qpos[2], 0.03, delta=0.001)

    def test_objects_are_free_bodies_without_joints(self):
        names = {}
        for task_id in TASKS:
            model = make_task(task_id, 1).model
            names[task_id] = [model.body(body).name for body in objects_of(model)]
        self.assertEqual(names["dmprl/PandaStack-v0"], ["object1", "object2"])
        self.assertEqual(names["dmprl/Thrower-v0"], ["ball"])
        self.assertEqual(names["dmprl/PandaReach-v0"], [])
        ant = gymnasium.make("Ant-v5").unwrapped
        self.assertEqual(objects_of(ant.model).size, 0)


class EnvironmentsTest(unittest.TestCase):
    CASES = (
        ("dmprl/PandaPush-v0", OBJECTS),
        ("dmprl/PandaStack-v0", OBJECTS),
        ("dmprl/Thrower-v0", OBJECTS),
        ("dmprl/Pusher-v0", PHYSICS),
        ("Reacher-v5", Randomise(mass=(0.5, 2.0), damping=(0.5, 2.0))),
        ("Ant-v5", PHYSICS),
    )

    def test_episodes_are_reproducible_and_equal_those_of_a_recording(self):
        delays = {key: getattr(DELAYS, key) for key in Randomise._fields[-2:]}
        for task_id, ranges in self.CASES:
            with self.subTest(task_id):
                drawn = options(ranges._replace(**delays), max_episode_steps=8)
                once = segments(make(task_id, 2, STEPS, drawn), 6)
                assert_equal(once, segments(make(task_id, 2, STEPS, drawn), 6))
                self.assertFalse(same(once, segments(make(task_id, 2, STEPS, drawn), 6, seed=8)))
                alone = segments(make(task_id, 1, STEPS, drawn), 6)
                assert_equal(alone, segments(recording.make(task_id, STEPS, None, drawn), 6))

    def test_environments_have_models_of_their_own_and_the_same_starts(self):
        ranges = PHYSICS._replace(object_size=(0.7, 1.3))
        env = make("dmprl/PandaPush-v0", 2, STEPS, options(ranges, max_episode_steps=STEPS))
        plain = make("dmprl/PandaPush-v0", 2, STEPS, options(Randomise(), max_episode_steps=STEPS))
        self.assertIsNone(plain.batch.models)
        for drawn, nominal in zip(segments(env, 4), segments(plain, 4), strict=True):
            difference = drawn[0] - nominal[0]
            heights = [2, 14, 26]  # of the object, as a goal and twice in the observation
            self.assertTrue(np.all(np.abs(difference[:, heights]) < 0.3 * 0.02))
            self.assertTrue(np.all(np.delete(difference, heights, axis=1) == 0.0))
        first, second = (model.body_mass[-1] for model in env.batch.models)
        self.assertNotEqual(first, second)
        np.testing.assert_array_equal(env.task.model.body_mass, plain.task.model.body_mass)

    def test_a_recreated_stiffness_follows_the_mass(self):
        # With a mass factor of 1, Pusher-v0's contacts keep the stiffness of MuJoCo 2.
        env = make("dmprl/Pusher-v0", 1, STEPS, options(Randomise(damping=(1.0, 1.0 + 1e-9))))
        segments(env, 1)
        expected = env.task.model.body_invweight0
        np.testing.assert_allclose(env.batch.models[0].body_invweight0, expected, rtol=1e-6)

    def test_what_an_environment_lacks_is_named_with_the_key(self):
        for task_id, key, reason in (
            ("dmprl/PandaReach-v0", "object_size", "its model has no object"),
            ("dmprl/PandaReach-v0", "start_pose", "its model has no object"),
            ("Reacher-v5", "friction", "its model has no contacts"),
            ("InvertedDoublePendulum-v5", "object_size", "its model has no object"),
            ("tiny_envs:Countdown", "mass", "it has no MuJoCo model"),
            ("tiny_envs:Batch", "damping", "it is a SegmentEnv"),
        ):
            words = f"task.randomise.{key} cannot be applied to .*: {reason}"
            with self.subTest(task_id), self.assertRaisesRegex(RandomiseError, words):
                make(task_id, 1, STEPS, options(Randomise(**{key: (0.5, 0.6)})))

    def test_the_programs_toml_is_read(self):
        text = (
            "wrappers = []\n[kwargs]\n[randomise]\nmass = [0.5, 2.0]\naction_delay_steps = [0, 1]"
        )
        ranges = EnvOptions.parse(text).randomise
        self.assertEqual((ranges.of_model(), ranges.delays()), ("mass", True))
        self.assertEqual(EnvOptions.parse("wrappers = []\n[kwargs]"), NO_OPTIONS)
        self.assertIsNone(NO_OPTIONS.randomise.of_model())


class DelayTest(unittest.TestCase):
    """The reward of ``Countdown`` is the action, and its observation the number of steps."""

    def test_the_action_of_n_steps_ago_takes_effect(self):
        for delay in (0, 2, 7):
            ranges = Randomise(action_delay_steps=(delay, delay))
            env = make("tiny_envs:Countdown", 1, STEPS, options(ranges, length=15))
            given, rewards = [], []
            for _, _, reward, actions in segments(env, 3):
                given += actions[0, :, 0].tolist()
                rewards += reward[0].tolist()
            self.assertEqual(rewards, ([0.0] * delay + given)[:15])

    def test_the_observation_of_n_steps_ago_arrives(self):
        for delay in (0, 2, 7):
            ranges = Randomise(observation_delay_steps=(delay, delay))
            # The second episode ends within a segment.
            env = make("tiny_envs:Countdown", 1, STEPS, options(ranges, length=13))
            expected = [max(0, step - delay) for step in range(14)]
            results = segments(env, 6)
            for first in (0, 3):
                rows = [result[1][0, :, 0] for result in results[first : first + 3]]
                seen = [*rows[0], *rows[1][1:], *rows[2][1:4]]
                self.assertEqual(seen, expected)
                self.assertEqual(rows[2][4:].tolist(), [0.0, 0.0])
                self.assertEqual(results[first + 1][0][0, 0], rows[0][-1])

    def test_delays_are_drawn_for_each_episode(self):
        env = make("tiny_envs:Countdown", 2, STEPS, options(DELAYS, length=5))
        delays = []
        for _, observations, rewards, actions in segments(env, 40):
            for index in range(2):
                drawn = 5.0 - observations[index, -1, 0], (rewards[index] == 0.0).sum()
                delays.append(drawn)
                late = int(drawn[1])
                np.testing.assert_array_equal(
                    rewards[index, late:], actions[index, : STEPS - late, 0]
                )
        self.assertEqual(set(delays), {(o, a) for o in range(4) for a in range(3)})

    def test_goals_and_their_rule_are_those_of_the_environment(self):
        env = make("dmprl/PandaPush-v0", 1, STEPS, options(DELAYS))
        plain = make("dmprl/PandaPush-v0", 1, STEPS)
        self.assertEqual(goal_rule.proven(env), goal_rule.proven(plain))
        self.assertEqual(env.goals(), plain.goals())

    def test_a_failed_environment_starts_an_episode_without_its_past(self):
        ranges = Randomise(action_delay_steps=(1, 1), observation_delay_steps=(1, 1))
        env = make("tiny_envs:Countdown", 1, STEPS, options(ranges, length=9, fault="raise"))
        out = SegmentBuffers(1, STEPS, 2, 1)
        env.reset(np.ones(1, np.uint8), np.array([7], np.uint64), out)
        env.step_segment(np.full((1, STEPS, 1), 2.0), out)
        self.assertEqual((out.failed[0], out.observations.any()), (1, False))
        env.step_segment(np.ones((1, STEPS, 1)), out)
        self.assertEqual(out.rewards[0].tolist(), [0.0, 1.0, 1.0, 1.0, 1.0])
        self.assertEqual(out.observations[0, :, 0].tolist(), [0.0, 0.0, 1.0, 2.0, 3.0, 4.0])


if __name__ == "__main__":
    unittest.main()

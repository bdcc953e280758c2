"""Arguments of environments, and wrappers by name."""

import sys
import unittest
from datetime import date
from math import inf
from pathlib import Path

import gymnasium
import numpy as np

import dmprl
from dmprl import recording
from dmprl.bench_peers import AbsentError, EnvPoolLoop, gymnasium_env
from dmprl.bench_physics import Ceiling, PlainMujoco
from dmprl.env_options import NO_OPTIONS, EnvOptions, OptionsError
from dmprl.play import Shown
from dmprl.program import flags
from dmprl.segment_env import SegmentBuffers, make

sys.path.append(str(Path(__file__).parent))  # for the tiny environments' module

DOUBLED, INCREMENTED = "tiny_envs:doubled", "tiny_envs:incremented"
STEPS = 5


def episode(env, action=0.5):
    """Returns the rewards and the observations of the first segment."""
    spec = env.spec()
    out = SegmentBuffers(1, STEPS, spec["observation_len"], spec["action_len"])
    env.reset(np.ones(1, np.uint8), np.array([7], np.uint64), out)
    env.step_segment(np.full((1, STEPS, spec["action_len"]), action), out)
    steps = out.steps[0]
    return out.rewards[0, :steps].tolist(), out.observations[0, : steps + 1].tolist()


def rewards(task_id, *wrappers, **kwargs):
    """Returns the rewards of a segment, which a recording has too."""
    options = EnvOptions(kwargs, wrappers)
    env, recorder = make(task_id, 1, STEPS, options), recording.make(task_id, STEPS, None, options)
    assert recorder.spec()["id"] == env.spec()["id"]
    assert recorder.spec()["episode_steps"] == env.spec()["episode_steps"]
    result = episode(env)
    assert episode(recorder) == result
    return result[0]


class ArgumentsTest(unittest.TestCase):
    def test_toml_of_the_program_becomes_python_values(self):
        text = 'wrappers = ["a:b"]\n[kwargs]\nx = 1\ny = 2.0\nz = [true, inf]\nd = 2020-01-02\n'
        kwargs = {"x": 1, "y": 2.0, "z": [True, inf], "d": date(2020, 1, 2)}
        self.assertEqual(EnvOptions.parse(text), EnvOptions(kwargs, ("a:b",)))
        self.assertIs(type(EnvOptions.parse(text).kwargs["y"]), float)
        self.assertFalse(NO_OPTIONS)

    def test_ids_classes_and_functions_take_arguments(self):
        for task_id in ("tiny_envs:Countdown-v0", "tiny_envs:Countdown"):
            self.assertEqual(len(rewards(task_id)), 3)
            self.assertEqual(len(rewards(task_id, length=2)), 2)
            self.assertEqual(len(rewards(task_id, length=4, max_episode_steps=1)), 1)
        self.assertEqual(len(rewards("tiny_envs:short_countdown", max_episode_steps=1)), 1)
        self.assertEqual(rewards("tiny_envs:ScaledBatch", scale=3.0), [1.5] * STEPS)

    def test_a_mujoco_task_takes_arguments_and_a_time_limit(self):
        once = rewards("tiny_mujoco:ScaledReacher", scale=1.0)
        twice = rewards("tiny_mujoco:ScaledReacher", scale=2.0, max_episode_steps=3)
        self.assertEqual(twice, [2.0 * reward for reward in once[:3]])

    def test_dmprls_tasks_take_a_time_limit_and_reject_other_arguments_by_name(self):
        self.assertEqual(len(rewards("dmprl/PandaReach-v0", max_episode_steps=2)), 2)
        options = EnvOptions({"max_episode_steps": -1})
        self.assertEqual(make("Reacher-v5", 1, STEPS, options).spec()["episode_steps"], 0)
        words = "dmprl/PandaReach-v0 has no argument reward_type, gain; expected max_episode_steps"
        kwargs = {"reward_type": "dense", "gain": 1}
        with self.assertRaisesRegex(OptionsError, words):
            make("dmprl/PandaReach-v0", 1, STEPS, EnvOptions(kwargs))
        with self.assertRaisesRegex(TypeError, words):
            dmprl.make("panda-reach", **kwargs)
        for limit in (0, 1.5, True):
            with self.assertRaisesRegex(OptionsError, f"max_episode_steps is {limit}; expected 1"):
                make("Reacher-v5", 1, STEPS, EnvOptions({"max_episode_steps": limit}))

    def test_gymnasiums_ids_with_arguments_are_gymnasiums_environments(self):
        plain = gymnasium.make("Reacher-v5", reward_dist_weight=0.0)
        plain.reset(seed=7)
        expected = [float(plain.step(np.full(2, 0.5, "f"))[1]) for _ in range(STEPS)]
        self.assertEqual(rewards("Reacher-v5", reward_dist_weight=0.0), expected)

    def test_a_wrong_argument_is_rejected_with_the_environments_message(self):
        for task_id, kwargs, words in [
            ("tiny_envs:Countdown", {"lenght": 2}, "unexpected keyword argument 'lenght'"),
            ("tiny_envs:Countdown-v0", {"length": -1}, "ValueError: length is -1; expected 1"),
            ("tiny_envs:ScaledBatch", {"scales": 2}, "unexpected keyword argument 'scales'"),
            ("tiny_mujoco:ScaledReacher", {"gain": 1}, "unexpected keyword argument 'gain'"),
            ("tiny_envs:Batch", {"env_count": 1}, "multiple values for argument 'env_count'"),
        ]:
            with self.subTest(task_id), self.assertRaisesRegex(OptionsError, words) as raised:
                make(task_id, 1, STEPS, EnvOptions(kwargs))
            name, value = next(iter(kwargs.items()))
            message = str(raised.exception)
            start = f"{task_id} cannot be created with {name}={value!r}: "
            self.assertTrue(message.startswith(start), message)
            self.assertTrue(message.endswith("; change task.kwargs (--env-kwargs)"), message)

    def test_a_recreated_environment_has_its_arguments_and_wrappers(self):
        options = EnvOptions({"failing_step": 2, "max_episode_steps": 4}, (DOUBLED,))
        env = make("tiny_envs:FaultyRaise-v0", 1, STEPS, options)
        episode(env)
        self.assertEqual(len(env.take_failures()), 1)
        out = SegmentBuffers(1, STEPS, 2, 1)
        env.step_segment(np.full((1, STEPS, 1), 0.5), out)
        self.assertEqual((out.failed[0], len(env.take_failures())), (1, 1))

    def test_arguments_of_train_become_flags(self):
        kwargs = {"reward_type": "dense", "text": "true", "gains": [1.0, 2], "on": False}
        words = flags({"env_kwargs": kwargs})
        self.assertEqual(words[::2], ["--env-kwargs"] * 4)
        pairs = ['reward_type="dense"', 'text="true"', "gains=[1.0, 2]", "on=false"]
        self.assertEqual(words[1::2], pairs)


class WrappersTest(unittest.TestCase):
    def test_wrappers_are_applied_in_order(self):
        self.assertEqual(rewards("tiny_envs:Countdown", DOUBLED, INCREMENTED), [2.0] * 3)
        self.assertEqual(rewards("tiny_envs:Countdown", INCREMENTED, DOUBLED), [3.0] * 3)

    def test_a_wrapper_is_outside_the_time_limit(self):
        limits = []

        def limit(env):
            limits.append(env.spec.max_episode_steps)
            return env

        sys.modules["tiny_envs"].limit = limit
        self.addCleanup(delattr, sys.modules["tiny_envs"], "limit")
        make("tiny_envs:Long-v0", 1, STEPS, EnvOptions(wrappers=("tiny_envs:limit",)))
        self.assertEqual(limits, [7])

    def test_a_wrapper_may_change_the_observation(self):
        options = EnvOptions(wrappers=("tiny_envs:Clocked",))
        env = make("tiny_envs:Long-v0", 1, STEPS, options)
        self.assertEqual(env.spec()["observation_len"], 3)
        self.assertEqual([row[2] for row in episode(env)[1]], [0, 1, 2, 3, 4, 5])

    def test_dmprls_tasks_are_wrapped_one_by_one_with_the_same_episodes(self):
        for task_id in ("Reacher-v5", "dmprl/PandaReach-v0", "tiny_mujoco:SlowReacher"):
            with self.subTest(task_id):
                plain = episode(make(task_id, 1, STEPS), 0.25)
                options = EnvOptions(wrappers=(INCREMENTED,))
                wrapped = episode(make(task_id, 1, STEPS, options), 0.25)
                self.assertEqual(wrapped[0], [reward + 1.0 for reward in plain[0]])
                self.assertEqual(wrapped[1], plain[1])
                self.assertEqual(len(rewards(task_id, INCREMENTED)), STEPS)

    def test_mistakes_are_named(self):
        for wrapper, task_id, words in [
            ("tiny_envs:missing", "tiny_envs:Countdown", "has no class or function missing"),
            ("no_such:name", "tiny_envs:Countdown", "no module 'no_such' .*--python-path"),
            ("tiny_envs:unwrapping", "tiny_envs:Countdown", "returned Box; expected a gymnasium"),
            (DOUBLED, "tiny_envs:Batch", "a SegmentEnv cannot be wrapped"),
        ]:
            with self.subTest(wrapper), self.assertRaisesRegex(OptionsError, words) as raised:
                make(task_id, 1, STEPS, EnvOptions(wrappers=(wrapper,)))
            message = str(raised.exception)
            self.assertIn(f"created with wrapped by {wrapper}: ", message)
            self.assertTrue(message.endswith("; change task.wrappers"), message)


class ReadersTest(unittest.TestCase):
    def test_the_player_shows_the_environment_with_its_arguments(self):
        options = EnvOptions({"max_episode_steps": 2, "width": 32, "height": 32}, (DOUBLED,))
        shown = Shown("Reacher-v5", "rgb_array", options).environment
        self.assertEqual(shown.spec.max_episode_steps, 2)
        self.assertEqual(type(shown), gymnasium.wrappers.TransformReward)

    def test_peers_of_a_benchmark_have_the_arguments_or_are_absent(self):
        plan = {
            "task": {"id": "tiny_envs:Countdown-v0", "kwargs": {"length": 2}},
            "options": "wrappers = ['tiny_envs:doubled']\n[kwargs]\nlength = 2\n",
            "env_count": 1,
        }
        env = gymnasium_env(plan)
        env.reset(seed=1)
        self.assertEqual(env.step(np.ones(1))[1], 2.0)
        self.assertTrue(env.step(np.ones(1))[2])
        for peer in (EnvPoolLoop, Ceiling, PlainMujoco):
            with self.assertRaises(AbsentError):
                peer(plan, 1)


if __name__ == "__main__":
    unittest.main()

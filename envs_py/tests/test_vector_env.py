"""Vector environments: equality with loops over the same single environments, and refusals."""

import contextlib
import io
import multiprocessing
import unittest

import numpy as np
import tiny_vectors
from gymnasium import spaces

from dmprl import play, recording
from dmprl.env_options import EnvOptions, OptionsError, Randomise, RandomiseError
from dmprl.gymnasium_env import success_of
from dmprl.segment_env import (
    SUCCESS_NOT_REPORTED,
    GoalRows,
    SegmentBuffers,
    SegmentEnvError,
    make,
    seed_after_failure,
    seed_of_episode,
)
from dmprl.vector_env import UnsupportedVectorEnvError

ENVS, STEPS, SEED = 4, 5, 7
MODES = ("Disabled", "SameStep", "NextStep")
RESULTS = (
    "observations",
    "rewards",
    "terminated",
    "truncated",
    "success",
    "steps",
    "failed",
    "next_observations",
)


def made(case, name, kwargs, env_count=ENVS, **options):
    options = EnvOptions(kwargs=kwargs, **options)
    env = make(f"tiny_vectors:{name}", env_count, STEPS, options)
    case.addCleanup(env.close)
    return env


def reset_all(env, seed=SEED):
    spec, count = env.spec(), env.env_count
    out = SegmentBuffers(count, STEPS, spec["observation_len"], spec["action_len"])
    env.reset(np.ones(count, np.uint8), np.arange(seed, seed + count, dtype=np.uint64), out)
    return out


def some_actions(segments, action_len=1, env_count=ENVS):
    generator = np.random.default_rng(0)
    return generator.uniform(-1.0, 1.0, (segments, env_count, STEPS, action_len))


class Loop:
    """One single environment, run in segments by a plain loop."""

    def __init__(self, env, seed):
        self.env, self.seed, self.episodes = env, seed, 0
        self.observation, _ = env.reset(seed=seed)

    def flat(self):
        return spaces.flatten(self.env.observation_space, self.observation)

    def run(self, index, actions, out):
        """Writes row ``index`` of ``out``, which is zero before."""
        out.observations[index, 0] = self.flat()
        for step, action in enumerate(actions):
            shaped = action.reshape(self.env.action_space.shape)
            self.observation, reward, terminated, truncated, info = self.env.step(shaped)
            out.observations[index, step + 1] = self.flat()
            out.rewards[index, step] = reward
            out.steps[index] = step + 1
            if terminated or truncated:
                break
        out.terminated[index], out.truncated[index] = terminated, truncated
        out.success[index] = success_of(info)
        if terminated or truncated:
            self.episodes += 1
            self.observation, _ = self.env.reset(seed=seed_of_episode(self.seed, self.episodes))
        out.next_observations[index] = self.flat()


class EqualityTest(unittest.TestCase):
    """Episodes of 1 to 11 steps end anywhere in segments of 5 steps, and each in its own."""

    def check(self, name, kwargs, single=tiny_vectors.Wandering, env_count=ENVS, segments=40):
        env = made(self, name, kwargs, env_count)
        out = reset_all(env)
        loops = [Loop(single(), SEED + index) for index in range(env_count)]
        first = np.stack([loop.flat() for loop in loops])
        np.testing.assert_array_equal(out.next_observations, first)
        steps = set()
        for actions in some_actions(segments, env.spec()["action_len"], env_count):
            expected = SegmentBuffers(env_count, STEPS, first.shape[1], actions.shape[2])
            for index, loop in enumerate(loops):
                loop.run(index, actions[index], expected)
            env.step_segment(actions, out)
            for result in RESULTS:
                got, wanted = getattr(out, result), getattr(expected, result)
                np.testing.assert_array_equal(got, wanted, result)
            steps |= {(int(n), bool(end)) for n, end in zip(out.steps, out.terminated, strict=True)}
        self.assertEqual(env.take_failures(), [])
        every = {(steps, end) for steps in range(1, STEPS + 1) for end in (False, True)}
        if segments >= 40:
            self.assertEqual(steps, every, "no episode has ended there")

    def test_environments_in_one_process_equal_single_ones(self):
        for mode in MODES:
            with self.subTest(mode):
                self.check("sync", {"mode": mode})

    def test_environments_in_processes_equal_single_ones(self):
        for mode in MODES:
            with self.subTest(mode):
                self.check("in_processes", {"mode": mode}, segments=15)
        for mode in MODES[:2]:
            with self.subTest(mode, shared_memory=False):
                self.check("in_processes", {"mode": mode, "shared_memory": False}, segments=15)

    def test_spaces_of_any_supported_kind_are_flattened(self):
        for mode in MODES:
            with self.subTest(mode):
                kwargs = {"mode": mode, "single": "Shaped"}
                self.check("sync", kwargs, tiny_vectors.Shaped, segments=15)

    def test_wrappers_for_vector_environments_work(self):
        self.check("counted", {"mode": "NextStep"}, segments=15)

    def test_one_environment_is_a_vector_too(self):
        self.check("sync", {"mode": "NextStep"}, env_count=1, segments=15)


class SimulatorTest(unittest.TestCase):
    """A simulator of its own gives the same results in all modes, and one at a time."""

    def results(self, mode, rows=slice(None)):
        env = made(self, "Simulator", {"mode": mode}, len(range(ENVS)[rows]))
        out, results = reset_all(env, SEED + (rows.start or 0)), []
        for actions in some_actions(40):
            env.step_segment(actions[rows], out)
            results.append([getattr(out, name).copy() for name in RESULTS])
        return results

    def compare(self, ours, theirs, rows=slice(None)):
        for segment, (got, wanted) in enumerate(zip(ours, theirs, strict=True)):
            for name, ours_now, theirs_now in zip(RESULTS, got, wanted, strict=True):
                np.testing.assert_array_equal(ours_now, theirs_now[rows], f"{name} in {segment}")

    def test_all_modes_give_the_same_results(self):
        disabled = self.results("Disabled")
        for mode in MODES[1:]:
            self.compare(self.results(mode), disabled)

    def test_environments_are_independent_of_each_other(self):
        for mode in MODES:
            for index in range(ENVS):
                alone = slice(index, index + 1)
                self.compare(self.results(mode, alone), self.results(mode), alone)


class ResetTest(unittest.TestCase):
    def test_only_masked_environments_are_reset_and_count_their_episodes_anew(self):
        for mode in MODES:
            env = made(self, "sync", {"mode": mode, "longest": 1})
            out = reset_all(env)
            first = out.next_observations.copy()
            for _ in range(2):
                env.step_segment(some_actions(1)[0], out)
            others = out.next_observations[[0, 2, 3]].copy()
            env.reset(np.array([0, 1, 0, 0], np.uint8), np.full(ENVS, SEED + 1, np.uint64), out)
            np.testing.assert_array_equal(out.next_observations[1], first[1])
            np.testing.assert_array_equal(out.next_observations[[0, 2, 3]], others)
            env.step_segment(some_actions(1)[0], out)
            np.testing.assert_array_equal(out.observations[[0, 2, 3], 0], others)
            other = Loop(tiny_vectors.Wandering(longest=1), seed_of_episode(SEED + 1, 1))
            np.testing.assert_array_equal(out.next_observations[1], other.flat())

    def test_step_before_reset_is_rejected(self):
        env = made(self, "sync", {})
        out = SegmentBuffers(ENVS, STEPS, 3, 1)
        with self.assertRaisesRegex(SegmentEnvError, "environment 0: step before reset"):
            env.step_segment(np.zeros((ENVS, STEPS, 1)), out)

    def test_seeds_differ_by_episode(self):
        seeds = {seed_of_episode(first, episode) for first in range(20) for episode in range(1, 20)}
        seeds |= {seed_after_failure(first, count) for first in range(20) for count in range(1, 20)}
        self.assertEqual(len(seeds), 2 * 20 * 19)


class SpecTest(unittest.TestCase):
    def test_the_spec_is_that_of_a_single_environment(self):
        for name in ("sync", "in_processes", "Simulator", "counted"):
            self.assertEqual(
                made(self, name, {}).spec(),
                {
                    "id": f"tiny_vectors:{name}",
                    "observation_len": 3,
                    "action_len": 1,
                    "action_low": [-2.0],
                    "action_high": [2.0],
                    "control_dt_s": 0.25,
                    "episode_steps": 11,
                    "observation_names": [f"observation[{entry}]" for entry in range(3)],
                },
            )

    def test_make_vec_needs_no_module_of_ones_own(self):
        kwargs = {"id": "Reacher-v5", "vectorization_mode": "async"}
        env = make("gymnasium:make_vec", 2, STEPS, EnvOptions(kwargs=kwargs))
        self.addCleanup(env.close)
        theirs, ours = env.spec(), make("Reacher-v5", 2, STEPS).spec()
        for key in ("action_low", "control_dt_s", "episode_steps", "observation_len"):
            self.assertEqual(theirs[key], ours[key], key)

    def test_several_dimensions_keep_their_names(self):
        spec = made(self, "sync", {"single": "Shaped"}).spec()
        self.assertEqual((spec["action_low"], spec["action_high"]), ([-2.0, -2.0], [1.0, 2.0]))
        names = ["grid[1,1]", "mode[0]", "mode[1]", "mode[2]", "pair.0[0]", "pair.1"]
        self.assertEqual(spec["observation_names"][3:], names)


class FailureTest(unittest.TestCase):
    """Environment 2 fails in its first step."""

    def after_failure(self, name="sync", action=2.0, **kwargs):
        env = made(self, name, kwargs)
        out = reset_all(env)
        actions = np.zeros((ENVS, STEPS, 1))
        actions[2, 0] = action
        with contextlib.redirect_stderr(io.StringIO()):
            env.step_segment(actions, out)
        return env, out

    def test_values_that_are_not_finite_cost_one_segment(self):
        whole = made(self, "sync", {})
        wanted = reset_all(whole)
        whole.step_segment(np.zeros((ENVS, STEPS, 1)), wanted)
        for mode in MODES:
            for fault, cause in (("observation", r"observation\[1\] is nan"), ("reward", "is inf")):
                with self.subTest(mode, fault=fault):
                    env, out = self.after_failure(mode=mode, fault=fault)
                    self.assertEqual(out.failed.tolist(), [0, 0, 1, 0])
                    (message,) = env.take_failures()
                    self.assertRegex(message, f"environment 2, step 0 of the segment: .*{cause}$")
                    for result in RESULTS:
                        got, rows = getattr(out, result), [0, 1, 3]
                        np.testing.assert_array_equal(got[rows], getattr(wanted, result)[rows])
                    self.assertFalse(out.observations[2].any() or out.rewards[2].any())
                    self.assertEqual((out.steps[2], out.success[2]), (0, SUCCESS_NOT_REPORTED))
                    again = Loop(tiny_vectors.Wandering(), seed_after_failure(SEED + 2, 1))
                    np.testing.assert_array_equal(out.next_observations[2], again.flat())

    def test_an_exception_costs_the_segments_of_all_environments(self):
        for name in ("sync", "in_processes"):
            for fault in ("raise", "own", "exit"):
                with self.subTest(name, fault=fault):
                    env, out = self.after_failure(name, fault=fault)
                    self.assertEqual(out.failed.tolist(), [1] * ENVS)
                    messages = env.take_failures()
                    self.assertEqual(len(messages), ENVS)
                    for index, message in enumerate(messages):
                        self.assertIn(f"environment {index}, step 0 of the segment: ", message)
                    loops = [
                        Loop(tiny_vectors.Wandering(), seed_after_failure(SEED + index, 1))
                        for index in range(ENVS)
                    ]
                    first = np.stack([loop.flat() for loop in loops])
                    np.testing.assert_array_equal(out.next_observations, first)
                    env.step_segment(np.zeros((ENVS, STEPS, 1)), out)
                    self.assertFalse(out.failed.any() or env.take_failures())

    def test_idle_environments_do_not_get_the_actions_of_the_segment(self):
        for mode in MODES:
            env, seed = made(self, "sync", {"mode": mode, "fault": "raise"}), 36
            out = reset_all(env, seed)
            actions = np.zeros((ENVS, STEPS, 1))
            env.step_segment(actions, out)
            steps = out.steps.tolist()
            self.assertEqual(steps, [5, 2, 3, 5])
            for index, after in enumerate(steps):
                actions[index, after:] = 2.0
            env.reset(np.ones(ENVS, np.uint8), np.arange(seed, seed + ENVS, dtype=np.uint64), out)
            env.step_segment(actions, out)
            self.assertEqual((out.steps.tolist(), env.take_failures()), (steps, []))

    def test_processes_of_a_failed_vector_environment_end(self):
        before = set(multiprocessing.active_children())
        env, _ = self.after_failure("in_processes", fault="raise")
        self.assertEqual(len(set(multiprocessing.active_children()) - before), ENVS)
        env.close()
        self.assertEqual(set(multiprocessing.active_children()) - before, set())

    def test_resets_that_raise_are_repeated_in_new_environments(self):
        env = made(self, "sync", {"fault": "reset", "longest": 1})
        with contextlib.redirect_stderr(io.StringIO()):
            # Environment 0 has been reset twice before, when the vector environment was tried.
            out = reset_all(env)
            self.assertRegex(env.take_failures()[0], "environment 0, reset: ValueError: no way")
            first = Loop(tiny_vectors.Wandering(longest=1), SEED)
            np.testing.assert_array_equal(out.next_observations[0], first.flat())
            failed = []
            for actions in some_actions(3):
                env.step_segment(actions, out)
                failed.append(out.failed.tolist())
        self.assertEqual(failed, [[0] * ENVS, [1] * ENVS, [0] * ENVS])
        self.assertIn("environment 3, reset: ValueError: no way back", env.take_failures()[3])
        env = made(self, "sync", {"fault": "reset"})
        with self.assertRaisesRegex(SegmentEnvError, "environment 0, reset: ValueError: no way"):
            env.reset(np.array([1, 0, 0, 0], np.uint8), np.zeros(ENVS, np.uint64), out)

    def test_a_start_that_is_not_finite_discards_the_segment_before_it(self):
        kwargs = {"longest": 1}
        env, out = self.after_failure(action=1.5, mode="NextStep", **kwargs)
        self.assertEqual(out.failed.tolist(), [0, 0, 1, 0])
        self.assertRegex(env.take_failures()[0], r"environment 2, reset: observation\[2\] is nan")
        again = Loop(tiny_vectors.Wandering(longest=1), seed_after_failure(SEED + 2, 1))
        np.testing.assert_array_equal(out.next_observations[2], again.flat())


class GoalTest(unittest.TestCase):
    def test_goals_and_rewards_are_those_of_a_single_environment(self):
        for asynchronous in (False, True):
            env = made(self, "reach", {"asynchronous": asynchronous})
            goals = env.goals()
            self.assertEqual(goals, {"achieved": 0, "desired": 1, "length": 1, "sparse": True})
            rows = GoalRows(2, 1)
            rows.count[0] = 2
            rows.achieved[:, 0], rows.desired[:, 0] = [0.0, 1.0], [0.4, 1.6]
            env.relabel(rows)
            self.assertEqual(rows.rewards.tolist(), [0.0, -1.0])
            rule = env.goal_rule()
            self.assertEqual((rule["threshold"], rule["missed"]), (0.5, -1.0))
            self.assertEqual(env.spec()["episode_steps"], 12)


class OptionsTest(unittest.TestCase):
    def test_delays_work(self):
        ranges = Randomise(action_delay_steps=(1, 1))
        delayed = made(self, "sync", {}, randomise=ranges)
        plain = made(self, "sync", {})
        outs = reset_all(delayed), reset_all(plain)
        ones, late = np.ones((ENVS, STEPS, 1)), np.ones((ENVS, STEPS, 1))
        late[:, 0] = 0.0
        delayed.step_segment(ones, outs[0])
        plain.step_segment(late, outs[1])
        np.testing.assert_array_equal(outs[0].rewards, outs[1].rewards)

    def test_physics_wrappers_and_a_number_of_environments_are_refused(self):
        with self.assertRaisesRegex(RandomiseError, "stepped together, with models of their own"):
            made(self, "sync", {}, randomise=Randomise(mass=(0.5, 2.0)))
        with self.assertRaisesRegex(OptionsError, "a vector environment cannot be wrapped"):
            made(self, "sync", {}, wrappers=("tiny_envs:doubled",))
        with self.assertRaisesRegex(OptionsError, "'num_envs'.*; change task.kwargs"):
            made(self, "sync", {"num_envs": 3})

    def test_recordings_have_rewards_and_pictures_are_refused(self):
        env = recording.make("tiny_vectors:sync", STEPS)
        self.addCleanup(env.close)
        out = reset_all(env)
        env.step_segment(some_actions(1, env_count=1)[0], out)
        self.assertTrue(out.rewards.any())
        self.assertIn("runs a whole segment at once", env.why_no_joints())
        words = "is a vector environment, which cannot be drawn"
        with self.assertRaisesRegex(recording.NoPicturesError, words):
            recording.make("tiny_vectors:sync", STEPS, "pictures")
        with self.assertRaisesRegex(SystemExit, "is a vector environment, which cannot be shown"):
            play.Shown("tiny_vectors:Simulator", "rgb_array")


class RefusalTest(unittest.TestCase):
    def test_unsuitable_vector_environments_are_refused_with_a_reason(self):
        for defect, reason in (
            ("mode", r"metadata\['autoreset_mode'\] is None; expected an AutoresetMode"),
            ("count", "it has 5 environments; expected num_envs = 4"),
            ("mask", "a reset of environment 0 changed the observation of another one"),
            ("seed", "two resets with the same seed differ"),
            ("one seed", "it failed when it was tried: TypeError: seed must be an integer"),
        ):
            with self.subTest(defect), self.assertRaisesRegex(OptionsError, reason):
                made(self, "Simulator", {"defect": defect})

    def test_a_function_with_num_envs_must_return_a_vector_environment(self):
        words = "has a parameter num_envs, but returned Wandering"
        with self.assertRaisesRegex(UnsupportedVectorEnvError, words):
            made(self, "single", {})

    def test_next_step_without_shared_memory_is_refused(self):
        with self.assertRaisesRegex(OptionsError, "pass autoreset_mode=AutoresetMode.DISABLED"):
            made(self, "in_processes", {"mode": "NextStep", "shared_memory": False})

    def test_a_missing_final_observation_ends_the_worker_with_a_remedy(self):
        env = made(self, "Simulator", {"mode": "SameStep", "defect": "final"})
        out = reset_all(env)
        with self.assertRaisesRegex(UnsupportedVectorEnvError, "no 'final_obs'; add it, or"):
            for actions in some_actions(3):
                env.step_segment(actions, out)


if __name__ == "__main__":
    unittest.main()

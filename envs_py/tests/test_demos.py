"""Demonstrations of any format: order, lengths, rates, rewards and refusals."""

import json
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import numpy as np
import tiny_envs  # noqa: F401 - registers environments

from dmprl.demos import summary
from dmprl.demos.__main__ import main
from dmprl.demos.converting import Conversion, Wishes, convert
from dmprl.demos.opening import open_source
from dmprl.demos.resampling import Rates, resampled
from dmprl.demos.source import DemosError, Episode, Source, entry_names
from dmprl.demos.task import Task

REACH = "tiny_envs:Reach-v0"
"""Observes achieved_goal (1), desired_goal (1), observation (2); its reward is 0 at the goal."""


def episode(steps=4, observation_len=4, **changes):
    """Observations are their number in every entry, actions a tenth of it, rewards the step."""
    rows = np.repeat(np.arange(steps + 1.0)[:, None], observation_len, axis=1)
    whole = Episode(rows, rows[:-1, :1] / 10, np.arange(float(steps)), False, None)
    return whole._replace(**changes)


class FakeSource(Source):
    """Episodes in memory, with a column of length 4 and one of length 1."""

    name, format, rate_hz, others = "fake", "fake", 0.0, {"camera": "image"}
    observation, action, reward = ("state",), "action", "reward"

    def __init__(self, *episodes, columns=None, rate_hz=0.0, reward="reward"):
        self._episodes, self.rate_hz, self.reward = episodes, rate_hz, reward
        lengths = columns or {"state": 4, "action": 1, "grip": 1}
        self.columns = {name: entry_names(name, length) for name, length in lengths.items()}
        self.episode_count = len(episodes)

    def episodes(self, columns):
        for it in self._episodes:
            yield it if columns.reward else it._replace(rewards=None)


class DictSource(FakeSource):
    """Columns with the names of the task's entries, in another order."""

    observation = ("observation", "extra", "desired_goal", "achieved_goal")

    def __init__(self, *episodes):
        lengths = {"observation": 2, "extra": 3, "desired_goal": 1, "achieved_goal": 1}
        super().__init__(*episodes, columns={**lengths, "action": 1})


class DemosTest(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def convert(self, source, task=None, **wishes):
        path = self.folder / "demos.npz"
        task = Task(task) if task else None
        result = convert(Conversion(source, task, Wishes(**wishes)), path)
        with np.load(path) as file:
            arrays = dict(file)
        self.assertTrue(all(array.flags.c_contiguous for array in arrays.values()), "C order")
        return result, arrays

    def refused(self, *words, source=None, task=None, **wishes):
        with self.assertRaises(DemosError) as caught:
            self.convert(source or FakeSource(episode()), task, **wishes)
        for word in words:
            self.assertIn(word, str(caught.exception))

    def test_a_file_has_a_row_per_step_and_ends_at_each_episode(self):
        first = episode(3, terminated=True, success=True)
        result, file = self.convert(FakeSource(first, episode(2, success=False), rate_hz=25.0))
        np.testing.assert_array_equal(file["observations"][:, 0], [0, 1, 2, 0, 1])
        np.testing.assert_array_equal(file["next_observations"][:, 3], [1, 2, 3, 1, 2])
        np.testing.assert_array_equal(file["rewards"], [0, 1, 2, 0, 1])
        np.testing.assert_array_equal(file["terminated"], [0, 0, 1, 0, 0])
        np.testing.assert_array_equal(file["truncated"], [0, 0, 0, 0, 1])
        np.testing.assert_array_equal(file["success"], [0, 0, 1, 0, 0])
        self.assertEqual((result["episodes"], result["steps"], result["successes"]), (2, 5, 1))
        self.assertEqual(len(result["notes"]), 1)
        self.assertIn("no --task", result["notes"][0])

        again = open_source(str(self.folder / "demos.npz"))
        self.assertEqual((again.rate_hz, again.episode_count), (25.0, 2))
        _, copied = self.convert(again)
        for name, rows in file.items():
            np.testing.assert_array_equal(copied[name], rows)

    def test_names_decide_the_order_of_an_observation(self):
        rows = np.arange(2 * 7.0).reshape(2, 7)
        recorded = Episode(np.asfortranarray(rows), np.zeros((1, 1)), np.zeros(1), False, None)
        _, file = self.convert(DictSource(recorded), REACH)
        # observation (2), extra (3), desired_goal, achieved_goal
        np.testing.assert_array_equal(file["observations"], [[6, 5, 0, 1]])

    def test_other_columns_keep_their_order(self):
        source = FakeSource(episode(observation_len=5))
        result, file = self.convert(source, observation=("state", "grip"))
        self.assertEqual((file["observations"].shape, result["rewards"]), ((4, 5), "recorded"))

    def test_a_task_with_goals_gives_the_rewards_that_are_missing(self):
        # Goals are reached within 0.5.
        rows = np.array([[0, 2, 0, 0], [1, 2, 0, 0], [1.6, 2, 0, 0], [4, 2, 0, 0]], float)
        recorded = Episode(rows, np.zeros((3, 1)), None, False, None)
        result, file = self.convert(FakeSource(recorded, reward=None), REACH)
        np.testing.assert_array_equal(file["rewards"], [-1, 0, -1])
        self.assertEqual(result["rewards"], "task")
        self.assertIn("rewards computed by", result["notes"][-1])
        _, file = self.convert(FakeSource(recorded, reward=None), REACH, reward="-2.5")
        np.testing.assert_array_equal(file["rewards"], [-2.5] * 3)

    def test_only_the_first_episodes_are_read(self):
        broken = episode(actions=np.full((4, 1), np.nan))
        result, _ = self.convert(FakeSource(episode(), broken), episodes=1)
        self.assertEqual(result["episodes"], 1)

    def test_a_lower_rate_takes_values_between_the_recorded_ones(self):
        # 5 steps of 20 Hz are 250 ms, which are 3 steps of 15 Hz and a rest.
        result, file = self.convert(FakeSource(episode(5), rate_hz=20.0), rate_hz=15.0)
        self.assertIn("from 20 to 15 Hz", result["notes"][0])
        np.testing.assert_allclose(file["observations"][:, 0], [0, 4 / 3, 8 / 3], rtol=1e-6)
        np.testing.assert_allclose(file["next_observations"][-1], 4.0, rtol=1e-6)
        np.testing.assert_allclose(file["actions"][:, 0], [0, 0.4 / 3, 0.8 / 3], rtol=1e-6)
        # The steps end in the recorded steps 1, 2 and 3.
        np.testing.assert_array_equal(file["rewards"], [1, 2, 3])
        np.testing.assert_array_equal(file["rate_hz"], [15.0])

    def test_a_higher_rate_keeps_the_last_action(self):
        finer = resampled(episode(2, terminated=True), Rates(10.0, 20.0))
        np.testing.assert_allclose(finer.observations[:, 0], [0, 0.5, 1, 1.5, 2])
        np.testing.assert_allclose(finer.actions[:, 0], [0, 0.05, 0.1, 0.1])
        np.testing.assert_array_equal(finer.rewards, [0, 0, 1, 1])
        self.assertTrue(finer.terminated)

    def test_an_episode_whose_end_falls_into_a_step_is_truncated(self):
        shorter = resampled(episode(5, terminated=True), Rates(20.0, 15.0))
        self.assertFalse(shorter.terminated)
        whole = resampled(episode(4, terminated=True), Rates(20.0, 10.0))
        self.assertEqual((len(whole.actions), whole.terminated), (2, True))

    def test_the_same_rate_changes_nothing(self):
        values = np.random.default_rng(0).normal(size=(5, 4))
        source = FakeSource(episode(observations=values), rate_hz=25.0)
        result, file = self.convert(source, rate_hz=25.01)
        np.testing.assert_array_equal(file["observations"], values[:-1].astype(np.float32))
        self.assertFalse(result["resampled"])

    def test_the_control_rate_is_that_of_the_task(self):
        source = FakeSource(
            episode(observation_len=10, actions=np.zeros((4, 2))),
            columns={"state": 10, "action": 2},
            rate_hz=100.0,
        )
        result, _ = self.convert(source, "dmprl/Reacher-v5")
        self.assertEqual((result["rate_hz"], result["steps"]), (50.0, 2))
        source.rate_hz = 0.0
        result, _ = self.convert(source, "dmprl/Reacher-v5")
        self.assertEqual(result["steps"], 4)
        self.assertIn("rate of the recording is unknown", result["notes"][0])
        rate = {"task": "dmprl/Reacher-v5", "rate_hz": 10.0}
        self.refused("--rate 10", "is 50 Hz", source=source, **rate)

    def test_episodes_that_are_too_short_are_counted(self):
        source = FakeSource(episode(1), episode(8), rate_hz=40.0)
        result, _ = self.convert(source, rate_hz=10.0)
        self.assertEqual((result["episodes"], result["steps"]), (1, 2))
        self.assertIn("1 episodes without a whole step", result["notes"][-1])
        self.refused("no episode", source=FakeSource(episode(1), rate_hz=40.0), rate_hz=10.0)
        self.refused("no episode", source=FakeSource())

    def test_columns_and_lengths_that_do_not_fit_are_named(self):
        there_are = "there are: state (4), action (1), grip (1), camera (image, cannot be read)"
        self.refused("no column pose", there_are, observation=("pose",))
        self.refused("no column torque", there_are, action="torque")
        self.refused("--reward state", "a column of length 1", reward="state")
        self.refused("--reward 1e39", "a finite 32-bit number", reward="1e39")
        lengths = "expects 4 entries, got 5 from state, grip", "choose columns with --observation"
        five = FakeSource(episode(observation_len=5))
        self.refused(*lengths, source=five, task=REACH, observation=("state", "grip"))
        self.refused("action", "expects 1 entries, got 4 from state", task=REACH, action="state")
        self.refused("no rewards", "--reward", source=FakeSource(episode(), reward=None))

    def test_numbers_that_cannot_be_used_are_named(self):
        rows = episode().observations.copy()
        rows[2, 1] = np.nan
        broken = FakeSource(episode(), episode(observations=rows))
        self.refused("episode 1, step 2: observation state[1]", "finite", "nan", source=broken)
        huge = FakeSource(episode(rewards=np.array([0, 1e39, 0, 0])))
        self.refused("episode 0, step 1: reward", "got 1e+39", source=huge)
        wide = FakeSource(episode(actions=np.array([[0], [-2.5], [0], [0]])))
        bounds = "step 1: action action[0]", "expected -2 to 2", "got -2.5"
        self.refused(*bounds, source=wide, task=REACH)

    def test_actions_beyond_the_share_that_a_policy_uses_are_refused(self):
        source = FakeSource(episode(actions=np.array([[0], [1.0], [1.5], [0]])))
        whole, half = Task(REACH), Task(REACH, action_range=0.5)
        list(Conversion(source, whole, Wishes()).checked())
        with self.assertRaisesRegex(DemosError, "step 2: .* expected -1 to 1, .*action_range"):
            list(Conversion(source, half, Wishes()).checked())

    def test_rates_that_make_no_sense_are_refused(self):
        source = FakeSource(episode(), rate_hz=20.0)
        for rate in (0.0, -1.0, float("nan"), float("inf"), 20_000.0):
            self.refused("--rate", "expected more than 0", source=source, rate_hz=rate)
        self.refused("cannot be resampled to 5000 Hz", source=source, rate_hz=5_000.0)
        self.refused("does not state its rate", "--recorded-rate", rate_hz=10.0)
        self.refused("its rate is -3 Hz", source=FakeSource(episode(), rate_hz=-3.0))

    def test_a_summary_says_everything_that_a_task_needs(self):
        source = FakeSource(episode(3), episode(5, success=True), rate_hz=20.0, reward=None)
        found = summary.summarise(source, Task("dmprl/Reacher-v5"), Wishes())
        self.assertEqual(
            (found["episodes"], found["steps"], found["episode_steps"]), (2, 8, [3, 5])
        )
        self.assertEqual(found["observation"]["high"], [5.0] * 4)
        self.assertEqual((found["return"], found["successes"]), (None, None))
        words = "expects 10 entries", "expects 2 entries", "there are no rewards"
        self.assertEqual(len(found["missing"]), 3, found["missing"])
        for word, reason in zip(words, found["missing"], strict=True):
            self.assertIn(word, reason)
        text = summary.text_of(found)
        self.assertIn("2, 8 steps (3 to 5 each)", text)
        self.assertIn("missing     observation: Reacher-v5", text)
        complete = summary.summarise(FakeSource(episode(success=True)), Task(REACH), Wishes())
        self.assertEqual((complete["missing"], complete["successes"]), ([], 1))
        self.assertEqual(complete["return"], {"mean": 6.0, "low": 6.0, "high": 6.0})
        self.assertTrue(summary.text_of(complete).endswith("missing     nothing"))

    def test_a_package_that_is_missing_is_named_with_the_command_that_installs_it(self):
        (self.folder / "meta").mkdir()
        (self.folder / "meta" / "info.json").write_text("{}")
        with mock.patch.dict(sys.modules, {"pyarrow": None, "minari": None}):
            for name in (str(self.folder), "minari:reach-v0"):
                with self.assertRaisesRegex(DemosError, r"dmprl env add 'dmprl\[demos\]'"):
                    open_source(name)

    def test_a_data_set_that_would_choose_the_code_to_run_is_refused(self):
        spec = json.dumps({"id": "X-v0", "entry_point": "antigravity:X"})
        text = json.dumps({"env_spec": spec, "total_episodes": 1, "data_format": "hdf5"})
        (self.folder / "metadata.json").write_text(text)
        with self.assertRaisesRegex(DemosError, "has no observation_space"):
            open_source(str(self.folder))

    def test_what_is_no_source_is_refused(self):
        for name, words in [(self.folder, "without either"), (self.folder / "no", "no such file")]:
            with self.assertRaisesRegex(DemosError, words):
                open_source(str(name))
        (self.folder / "text.npz").write_text("no archive")
        with self.assertRaisesRegex(DemosError, "cannot be read as npz"):
            open_source(str(self.folder / "text.npz"))
        np.savez(self.folder / "few.npz", rewards=np.zeros(3))
        with self.assertRaisesRegex(DemosError, "observations, actions, .* is missing"):
            open_source(str(self.folder / "few.npz"))

    def test_the_command_ends_with_2_and_the_reason(self):
        with mock.patch("sys.stderr") as stderr:
            self.assertEqual(main(["show", str(self.folder / "no")]), 2)
        self.assertIn("no such file", stderr.write.call_args_list[0].args[0])
        for name, words in [("demos.h5", "ends with .npz"), ("no/demos.npz", "does not exist")]:
            with self.assertRaisesRegex(DemosError, words):
                conversion = Conversion(FakeSource(episode()), None, Wishes())
                convert(conversion, self.folder / name)


if __name__ == "__main__":
    unittest.main()

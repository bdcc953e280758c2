"""Stable-Baselines3's ``predict`` (``dmprl/predict.py``)."""

import unittest

import numpy as np

from dmprl.predict import Predictor


class TwoSteps:
    """Decides two steps from the observation before the first: (x, 0), then (x, 1)."""

    def __init__(self):
        self.reset()

    def reset(self):
        self.step, self.decided = 2, None

    def action(self, observation=None):
        if self.step == 2:
            self.step, self.decided = 0, observation[0]
        self.step += 1
        return np.array([self.decided, self.step - 1.0])


class PredictTest(unittest.TestCase):
    def setUp(self):
        self.predictor = Predictor(TwoSteps(), 2)

    def predict(self, observation, starts=None):
        return self.predictor.predict(observation, starts).tolist()

    def test_one_observation_gives_one_action_and_segments_go_on_between_calls(self):
        self.assertEqual(self.predict([5, 0]), [5, 0])
        self.assertEqual(self.predict([6, 0]), [5, 1])
        self.assertEqual(self.predict([7, 0]), [7, 0])

    def test_the_first_observation_of_an_episode_starts_a_segment(self):
        self.predict([5, 0])
        self.assertEqual(self.predict([6, 0], True), [6, 0])

    def test_each_environment_is_at_its_own_step(self):
        self.assertEqual(self.predict([[1, 0], [2, 0]], [True, True]), [[1, 0], [2, 0]])
        self.assertEqual(self.predict([[3, 0], [4, 0]], [False, True]), [[1, 1], [4, 0]])
        self.assertEqual(self.predict([[5, 0], [6, 0]], [False, False]), [[5, 0], [4, 1]])
        self.predictor.reset()
        self.assertEqual(self.predict([[7, 0], [8, 0]]), [[5, 1], [8, 0]])

    def test_entries_of_a_mapping_are_joined_by_name(self):
        self.assertEqual(self.predict({"b": [9.0], "a": [3.0]}), [3, 0])
        self.predictor = Predictor(TwoSteps(), 2)
        batch = {"b": [[9.0], [8.0]], "a": [[3.0], [4.0]]}
        self.assertEqual(self.predict(batch), [[3, 0], [4, 0]])

    def test_a_batch_of_one_keeps_its_dimension(self):
        self.assertEqual(self.predict([[5, 0]]), [[5, 0]])

    def test_other_shapes_are_rejected(self):
        with self.assertRaisesRegex(ValueError, r"shape \(3,\), expected \(2,\) or"):
            self.predict([1, 2, 3])
        with self.assertRaisesRegex(ValueError, r"episode_start has shape \(1,\), expected \(2,\)"):
            self.predict([[1, 0], [2, 0]], [True])


if __name__ == "__main__":
    unittest.main()

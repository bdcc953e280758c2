"""Observations as Stable-Baselines3 passes them (``dmprl/predict.py``).

``predict`` itself is compared with single policies in tests/tests/runtimes.rs.
"""

import unittest

from dmprl.predict import observation_rows, start_flags


class PredictTest(unittest.TestCase):
    def rows(self, observation):
        rows, is_batch = observation_rows(observation, 2)
        return rows.tolist(), is_batch

    def test_one_observation_is_a_row_and_several_are_a_batch(self):
        self.assertEqual(self.rows([5, 6]), ([[5, 6]], False))
        self.assertEqual(self.rows([[5, 6]]), ([[5, 6]], True))
        self.assertEqual(self.rows([[5, 6], [7, 8]]), ([[5, 6], [7, 8]], True))

    def test_entries_of_a_mapping_are_joined_by_name(self):
        self.assertEqual(self.rows({"b": [9.0], "a": [3.0]}), ([[3, 9]], False))
        batch = {"b": [[9.0], [8.0]], "a": [[3.0], [4.0]]}
        self.assertEqual(self.rows(batch), ([[3, 9], [4, 8]], True))

    def test_other_shapes_are_rejected(self):
        wrong = ([1, 2, 3], [[1], [2]], [[[1, 2]]], [], {"a": [[3.0]], "b": [1.0]}, {})
        for observation in wrong:
            with self.subTest(observation=observation), self.assertRaises(ValueError):
                self.rows(observation)
        with self.assertRaisesRegex(ValueError, r"shape \(3,\), expected \(2,\) or"):
            self.rows([1, 2, 3])

    def test_there_is_a_start_flag_for_each_environment(self):
        self.assertEqual(start_flags(None, 2).tolist(), [False, False])
        self.assertEqual(start_flags(True, 1).tolist(), [True])
        with self.assertRaisesRegex(ValueError, r"shape \(1,\), expected \(2,\)"):
            start_flags([True], 2)


if __name__ == "__main__":
    unittest.main()

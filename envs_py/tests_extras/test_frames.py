"""A run's rows as data frames.

``tests/tests/python_extras.rs`` trains the run and sets ``TEST_RUN`` to its directory.
"""

import os
import unittest

import dmprl


class Frames(unittest.TestCase):
    def setUp(self) -> None:
        self.run_directory = dmprl.Run(os.environ["TEST_RUN"])

    def test_pandas_and_polars_return_the_same_rows(self) -> None:
        for name in ("metrics", "evaluations"):
            with self.subTest(name):
                pandas = getattr(self.run_directory, name)()
                polars = getattr(self.run_directory, name)("polars")
                self.assertEqual(list(pandas.columns), polars.columns)
                self.assertEqual(pandas["env_steps"].tolist(), polars["env_steps"].to_list())
                self.assertTrue(pandas["env_steps"].is_monotonic_increasing)
                self.assertGreater(len(pandas), 1)

    def test_nested_objects_become_numeric_columns(self) -> None:
        metrics = self.run_directory.metrics()
        self.assertEqual(metrics["rejected/duplicate"].sum(), 0)
        self.assertGreater(metrics["critic_loss"].mean(), 0.0)
        evaluations = self.run_directory.evaluations("polars")
        self.assertEqual(evaluations["returns"].list.len().to_list(), [2] * len(evaluations))

    def test_the_best_policy_is_loaded_and_invalid_names_are_rejected(self) -> None:
        policy = self.run_directory.policy()
        actions = policy.segment([0.1] * policy.spec["observation_len"])
        self.assertEqual(actions.shape, (5, 2))
        self.assertEqual(self.run_directory.config["policy"]["hidden"], [32])
        with self.assertRaisesRegex(ValueError, "expected best, latest"):
            self.run_directory.policy("worst")
        with self.assertRaisesRegex(ValueError, "expected one of pandas"):
            self.run_directory.metrics("csv")


if __name__ == "__main__":
    unittest.main()

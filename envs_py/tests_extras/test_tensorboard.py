"""A run's event file in TensorBoard's own reader, compared with the run's JSON lines.

``tests/tests/python_extras.rs`` trains the run and sets ``TEST_RUN`` to its directory.
"""

import json
import os
import pathlib
import unittest

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator


def lines(path: pathlib.Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


class EventFile(unittest.TestCase):
    def setUp(self) -> None:
        self.run_directory = pathlib.Path(os.environ["TEST_RUN"])
        self.events = EventAccumulator(str(self.run_directory / "tensorboard"))
        self.events.Reload()

    def assert_same(self, tag: str, rows: list[dict], value) -> None:
        scalars = self.events.Scalars(tag)
        expected = [(row["env_steps"], value(row)) for row in rows if value(row) is not None]
        self.assertEqual([scalar.step for scalar in scalars], [step for step, _ in expected])
        for scalar, (_, number) in zip(scalars, expected, strict=True):
            self.assertAlmostEqual(scalar.value, number, places=3)

    def test_it_has_all_rows_of_the_run_and_none_that_a_resume_removed(self) -> None:
        metrics = lines(self.run_directory / "metrics.jsonl")
        evaluations = lines(self.run_directory / "evaluations.jsonl")
        self.assertGreater(len(metrics), 1)
        self.assertGreater(len(evaluations), 1)
        self.assert_same("evaluation/return_mean", evaluations, lambda row: row["return_mean"])
        self.assert_same("training/critic_loss", metrics, lambda row: row["critic_loss"])
        self.assert_same("training/updates", metrics, lambda row: row["updates"])
        nested = "training/rejected/duplicate"
        self.assert_same(nested, metrics, lambda row: row["rejected"]["duplicate"])

    def test_wall_times_are_those_of_the_run(self) -> None:
        rows = lines(self.run_directory / "evaluations.jsonl")
        scalars = self.events.Scalars("evaluation/return_mean")
        passed = scalars[-1].wall_time - scalars[0].wall_time
        self.assertAlmostEqual(passed, rows[-1]["wall_s"] - rows[0]["wall_s"], places=2)


if __name__ == "__main__":
    unittest.main()

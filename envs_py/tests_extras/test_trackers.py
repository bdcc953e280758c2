"""The callbacks of ``docs/examples/trackers.py`` with the real packages, without a network."""

import os
import pathlib
import sys
import tempfile
import unittest

import mlflow

import dmprl
from dmprl.callbacks import Watch

EXAMPLES = pathlib.Path(__file__).resolve().parents[2] / "docs" / "examples"
sys.path.insert(0, str(EXAMPLES))
import trackers  # noqa: E402 - found in the folder added above

RUN = pathlib.Path(os.environ["TEST_RUN"])


def replay(callback: dmprl.Callback) -> None:
    """Tells the callback of all lines of the run, as if they were new."""
    watch = Watch(RUN, [callback])
    assert watch.poll()
    watch.end()


class TrackersTest(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self.addCleanup(folder.cleanup)
        self.folder = pathlib.Path(folder.name)
        self.rows = dmprl.Run(RUN).evaluations().to_dict("records")
        self.assertGreater(len(self.rows), 2)

    def test_mlflow_has_every_evaluation_with_its_step(self):
        mlflow.set_tracking_uri(f"sqlite:///{self.folder}/mlflow.db")
        replay(trackers.Mlflow("arm"))
        client = mlflow.MlflowClient()
        (experiment,) = client.search_experiments(filter_string="name = 'arm'")
        (run,) = client.search_runs([experiment.experiment_id])
        got = client.get_metric_history(run.info.run_id, "evaluation/return_mean")
        wanted = [(row["env_steps"], row["return_mean"]) for row in self.rows]
        self.assertEqual([(metric.step, metric.value) for metric in got], wanted)
        self.assertEqual(run.data.params["algorithm.name"], "td3")
        self.assertEqual(run.info.status, "FINISHED")

    def test_weights_and_biases_writes_an_offline_run(self):
        replay(trackers.Wandb(project="arm", mode="offline", dir=self.folder))
        (file,) = self.folder.glob("wandb/offline-run-*/*.wandb")
        written = file.read_bytes()
        for words in (b"evaluation/return_mean", b"training/critic_loss", b"actor_learning_rate"):
            self.assertIn(words, written)


if __name__ == "__main__":
    unittest.main()

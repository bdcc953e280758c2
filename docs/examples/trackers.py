"""Sends a run's lines to an experiment tracker while it trains.

::

    dmprl.train("reacher", callbacks=[Wandb(project="arm")])
    dmprl.train("reacher", callbacks=[Mlflow("arm")])

Trackio has the same functions as Weights & Biases: ``Wandb(trackio, project="arm")``.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import dmprl


def numbers(prefix: str, row: dict[str, Any]) -> dict[str, float]:
    """Returns the numbers of a line, named ``prefix/key``."""
    return {f"{prefix}/{key}": it for key, it in row.items() if isinstance(it, (int, float))}


class Wandb(dmprl.Callback):
    """Weights & Biases, or a module with the same functions."""

    def __init__(self, module: ModuleType | None = None, **init: Any) -> None:
        """:param init: arguments of ``wandb.init``, such as ``project``, ``name`` and ``mode``."""
        if module is None:
            import wandb as module
        self._module, self._init, self._started = module, init, False

    def _log(self, run: dmprl.Run, row: dict[str, float]) -> None:
        if not self._started:
            name = self._init.pop("name", run.path.name)
            self._module.init(name=name, config=run.config, **self._init)
            self._started = True
        self._module.log(row)

    def on_metrics(self, run: dmprl.Run, row: dict[str, Any]) -> None:
        """Logs a line of ``metrics.jsonl``."""
        self._log(run, numbers("training", row))

    def on_evaluation(self, run: dmprl.Run, row: dict[str, Any]) -> None:
        """Logs an evaluation."""
        self._log(run, numbers("evaluation", row))

    def on_end(self, run: dmprl.Run) -> None:
        """Ends the tracker's run."""
        if self._started:
            self._module.finish()


class Mlflow(dmprl.Callback):
    """MLflow, at the server that ``mlflow.set_tracking_uri`` or ``MLFLOW_TRACKING_URI`` names."""

    def __init__(self, experiment: str) -> None:
        import mlflow

        self._mlflow, self._experiment = mlflow, experiment

    def _log(self, run: dmprl.Run, row: dict[str, float], step: int) -> None:
        if self._mlflow.active_run() is None:
            self._mlflow.set_experiment(self._experiment)
            self._mlflow.start_run(run_name=run.path.name)
            for section, values in run.config.items():
                self._mlflow.log_params({f"{section}.{key}": it for key, it in values.items()})
        self._mlflow.log_metrics(row, step=step)

    def on_metrics(self, run: dmprl.Run, row: dict[str, Any]) -> None:
        """Logs a line of ``metrics.jsonl``."""
        self._log(run, numbers("training", row), row["env_steps"])

    def on_evaluation(self, run: dmprl.Run, row: dict[str, Any]) -> None:
        """Logs an evaluation."""
        self._log(run, numbers("evaluation", row), row["env_steps"])

    def on_end(self, run: dmprl.Run) -> None:
        """Ends the tracker's run."""
        self._mlflow.end_run()

"""What a program does while ``dmprl.train`` runs.

::

    class Stop(dmprl.Callback):
        def on_evaluation(self, run, row):
            return row["return_mean"] < -4.0  # False stops the training


    dmprl.train("reacher", callbacks=[Stop()])
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dmprl.run import Run, flat_row


class Callback:
    """Override what you need. The calls come from the thread that called ``dmprl.train``.

    Training continues during a call. If a method raises, training stops with a checkpoint, and
    ``dmprl.train`` raises the same exception.
    """

    def on_evaluation(self, run: Run, row: dict[str, Any]) -> bool | None:
        """Called after each evaluation; False stops the training with a checkpoint.

        :param row: the line of ``evaluations.jsonl``.
        """

    def on_metrics(self, run: Run, row: dict[str, Any]) -> bool | None:
        """Called after each line of ``metrics.jsonl``; False stops the training with a checkpoint.

        :param row: the line; keys of nested objects are joined by ``/``.
        """

    def on_checkpoint(self, run: Run, path: Path) -> bool | None:
        """Called after a checkpoint; False stops the training.

        :param path: the folder of the checkpoint. It is deleted once ``checkpoint.keep`` newer ones
            exist.
        """

    def on_end(self, run: Run) -> None:
        """Called once at the end, also after a stop or an interrupt."""


class Watch:
    """Tells callbacks what is new in a run directory."""

    def __init__(self, directory: Path, callbacks: Sequence[Callback]) -> None:
        self._directory, self._callbacks = directory, callbacks
        # Bytes read of each file.
        self._read = {"metrics.jsonl": 0, "evaluations.jsonl": 0}
        self._checkpoint: Path | None = None

    def poll(self) -> bool:
        """Makes the calls that are due; returns False if one of them stops the training."""
        if not self._callbacks or not (self._directory / "manifest.json").is_file():
            return True
        run, goes_on = Run(self._directory), True
        for row in self._new_rows("metrics.jsonl"):
            goes_on &= self._call("on_metrics", run, row)
        for row in self._new_rows("evaluations.jsonl"):
            goes_on &= self._call("on_evaluation", run, row)
        latest = self._directory / "checkpoints" / "latest"
        if latest.exists() and latest.resolve() != self._checkpoint:
            self._checkpoint = latest.resolve()
            goes_on &= self._call("on_checkpoint", run, self._checkpoint)
        return goes_on

    def end(self) -> None:
        """Makes the last calls."""
        self.poll()
        self._call("on_end", Run(self._directory))

    def _new_rows(self, name: str) -> list[dict[str, Any]]:
        """Returns the lines since the last call that are complete."""
        file = self._directory / name
        if not file.is_file():
            return []
        # A learner that was replaced cuts its files back to the checkpoint.
        self._read[name] = min(self._read[name], file.stat().st_size)
        with file.open("rb") as opened:
            opened.seek(self._read[name])
            lines = [line for line in opened.read().splitlines(True) if line.endswith(b"\n")]
        self._read[name] += sum(map(len, lines))
        return [flat_row(json.loads(line)) for line in lines]

    def _call(self, method: str, *arguments: Any) -> bool:
        answers = [getattr(callback, method)(*arguments) for callback in self._callbacks]
        return all(answer is not False for answer in answers)

"""``dmprl.train``: a policy is trained, from Python."""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any

from dmprl import program
from dmprl.run import Run

NAME_MAX = 60
"""Letters of a task in the name of a run."""


class TrainingError(program.ProgramError):
    """Training failed; the message is the program's own."""


def train(
    task: str,
    *,
    run_dir: str | Path | None = None,
    python_path: str | Path | None = None,
    deterministic: bool = False,
    quiet: bool = False,
    **overrides: Any,
) -> Run:
    """Trains a policy and returns its run; an interrupt stops it with a checkpoint.

    :param task: a task of ``dmprl tasks``, a Gymnasium id, or ``module:Class``.
    :param run_dir: where the results go; new or empty. By default a new folder in ``runs/``.
    :param python_path: directory of your own environment modules.
    :param deterministic: one worker, in one process with the learner and in lock-step with it:
        the same seed gives the same bytes.
    :param quiet: says nothing while it trains.
    :param overrides: flags of ``dmprl train`` (``steps=20_000``, ``algo="sac"``, ``seed=2``) and
        configuration keys with two underscores for the dot (``algorithm__batch_size=64``). None is
        left out.
    :raises TrainingError: the run failed, or a value was refused; the message says why, except in
        a terminal, where the program has said so itself.
    :raises KeyboardInterrupt: it was interrupted, and has written a checkpoint.
    :raises FileNotFoundError: the program ``dmprl`` is not installed.
    """
    directory = Path(run_dir or Path("runs") / f"{_safe(task)}-{uuid.uuid4().hex[:8]}").absolute()
    arguments = [task, "--run-dir", str(directory), *program.flags(overrides)]
    if python_path is not None:
        arguments += ["--python-path", str(python_path)]
    if deterministic:
        arguments.append("--deterministic")
    program.call("train", *arguments, quiet=quiet, error=TrainingError)
    return Run(directory)


def _safe(task: str) -> str:
    """A name that every file system takes."""
    letters = (it if it.isascii() and it.isalnum() else "-" for it in task)
    return "".join(letters).strip("-").lower()[:NAME_MAX] or "run"

"""Defines ``dmprl.train``, which trains a policy from Python."""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dmprl import program
from dmprl.callbacks import Callback, Watch
from dmprl.run import Run

NAME_MAX = 60
"""Maximum length of the task's part of a run's name."""


class TrainingError(program.ProgramError):
    """Raised if training failed, with the program's message."""


def train(
    task: str,
    *,
    run_dir: str | Path | None = None,
    python_path: str | Path | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    deterministic: bool = False,
    quiet: bool = False,
    callbacks: Sequence[Callback] = (),
    **overrides: Any,
) -> Run:
    """Trains a policy and returns its run; an interrupt stops it with a checkpoint.

    :param task: a task of ``dmprl tasks``, a Gymnasium id, or ``module:Class``.
    :param run_dir: directory for the results, new or empty. By default a new folder in ``runs/``.
    :param python_path: directory of your own environment modules.
    :param deterministic: runs one worker in the learner's process and in lock-step with it, so that
        the same seed gives bit-identical results.
    :param quiet: suppresses progress.
    :param callbacks: called after evaluations, metrics and checkpoints, and at the end; they may
        stop the training, which then returns the run as if it had ended by itself.
    :param env_kwargs: arguments of the environment and of ``gymnasium.make``.
    :param overrides: flags of ``dmprl train`` (``steps=20_000``, ``algo="sac"``, ``seed=2``) and
        configuration keys with two underscores for the dot (``algorithm__batch_size=64``). A flag
        that is None is omitted.
    :raises TrainingError: if the run failed, or a value was rejected. The message gives the reason;
        in a terminal the program has already printed it.
    :raises KeyboardInterrupt: if it was interrupted, after writing a checkpoint.
    :raises FileNotFoundError: if the program ``dmprl`` is not installed.
    """
    directory = Path(run_dir or Path("runs") / f"{_safe(task)}-{uuid.uuid4().hex[:8]}").absolute()
    arguments = [task, "--run-dir", str(directory), *program.flags(overrides)]
    arguments += program.flags({"env_kwargs": dict(env_kwargs or {})})
    if python_path is not None:
        arguments += ["--python-path", str(python_path)]
    if deterministic:
        arguments.append("--deterministic")
    watch = Watch(directory, callbacks)
    try:
        program.call("train", *arguments, quiet=quiet, error=TrainingError, watch=watch.poll)
    except KeyboardInterrupt:
        watch.end()
        raise
    watch.end()
    return Run(directory)


def _safe(task: str) -> str:
    """Converts a task's id to a name that all file systems accept."""
    letters = (it if it.isascii() and it.isalnum() else "-" for it in task)
    return "".join(letters).strip("-").lower()[:NAME_MAX] or "run"

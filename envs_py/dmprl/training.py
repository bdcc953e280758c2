"""``dmprl.train``: the program ``dmprl`` from Python, in a process of its own."""

from __future__ import annotations

import collections
import ctypes
import json
import shutil
import signal
import subprocess
import sys
import uuid
from pathlib import Path
from typing import Any

from dmprl.run import Run

INTERRUPTED = 130
"""Exit status of a program that was interrupted and has saved."""
LAST_LINES = 20
"""Of what it said, for an error."""
STOP_S = 30.0
"""For its last checkpoint, when something else than an interrupt ends the call [s]."""
NAME_MAX = 60
"""Letters of a task in the name of a run."""
PARENT_DEATH_SIGNAL = 1
"""``PR_SET_PDEATHSIG``."""


class TrainingError(RuntimeError):
    """Training failed; the message is the program's own."""

    def __init__(self, status: int, said: str) -> None:
        super().__init__(f"dmprl train ended with status {status}:\n{said}")
        self.status = status


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
    :param deterministic: one process in lock-step: the same seed gives the same bytes.
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
    command = [str(program()), "train", task, "--run-dir", str(directory)]
    if python_path is not None:
        command += ["--python-path", str(python_path)]
    if deterministic:
        command.append("--deterministic")
    for name, value in overrides.items():
        flag = f"--{name.replace('_', '-')}"
        if value is None or (value is False and "__" not in name):
            continue  # as if it were not there
        if "__" in name:
            command += ["--set", f"{name.replace('__', '.')}={_toml(value)}"]
        elif value is True:
            command.append(flag)
        elif isinstance(value, (list, tuple)):  # a flag that may come several times
            command += [word for entry in value for word in (flag, str(entry))]
        else:
            command += [flag, str(value)]
    status, said = _run(command, quiet)
    if status == INTERRUPTED:
        raise KeyboardInterrupt
    if status != 0:
        raise TrainingError(status, said)
    return Run(directory)


def program() -> Path:
    """The program: beside this Python, on the search path, or built in the repository.

    :raises FileNotFoundError: it is nowhere; the message says how to get it.
    """
    beside = Path(sys.executable).with_name("dmprl")
    if beside.is_file():
        return beside
    if found := shutil.which("dmprl"):
        return Path(found)
    built = Path(__file__).resolve().parents[2] / "target" / "release" / "dmprl"
    if built.is_file():
        return built
    raise FileNotFoundError(
        f"no program dmprl beside {sys.executable}, on PATH or at {built}; build it: "
        "cargo build --release"
    )


def _run(command: list[str], quiet: bool) -> tuple[int, str]:
    """Runs the program to its end; its status, and the last of what it said."""
    # In a terminal it draws by itself; a notebook gets its lines.
    live = not quiet and sys.stderr.isatty()
    child = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=None if live else subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
        # The terminal's interrupt comes to this process alone, which passes it on, once.
        start_new_session=True,
        preexec_fn=_end_with_parent,
    )
    said: collections.deque[str] = collections.deque(maxlen=LAST_LINES)
    try:
        while True:
            try:
                for line in child.stderr or ():
                    said.append(line)
                    if not quiet:
                        print(line, end="", file=sys.stderr)
                status = child.wait()
                return status, "what it said is above" if live else "".join(said)
            except KeyboardInterrupt:
                child.send_signal(signal.SIGINT)
    finally:
        # Whatever else came up here: nobody trains on unseen.
        if child.poll() is None:
            _stop(child)


def _stop(child: subprocess.Popen[str]) -> None:
    """Lets it write its checkpoint, and ends it if that takes too long."""
    child.send_signal(signal.SIGINT)
    if child.stderr is not None:
        # Or it would wait for somebody to read.
        child.stderr.close()
    try:
        child.wait(STOP_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def _end_with_parent() -> None:
    """A Python that is killed takes the training with it, which writes a checkpoint."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PARENT_DEATH_SIGNAL, signal.SIGTERM)


def _toml(value: Any) -> str:
    """A value as ``--set`` takes it."""
    if isinstance(value, (list, tuple)):
        # Strings of TOML are written as those of JSON.
        entries = (json.dumps(it) if isinstance(it, str) else _toml(it) for it in value)
        return f"[{', '.join(entries)}]"
    if isinstance(value, dict):
        entries = (f"{json.dumps(key)} = {_toml([entry])[1:-1]}" for key, entry in value.items())
        return f"{{{', '.join(entries)}}}"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _safe(task: str) -> str:
    """A name that every file system takes."""
    letters = (it if it.isascii() and it.isalnum() else "-" for it in task)
    return "".join(letters).strip("-").lower()[:NAME_MAX] or "run"

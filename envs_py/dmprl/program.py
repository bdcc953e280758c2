"""Runs the program ``dmprl`` from Python, in a separate process."""

from __future__ import annotations

import collections
import contextlib
import ctypes
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

INTERRUPTED = 130
"""Exit status of a program that saved after an interrupt."""
LAST_LINES = 20
"""Number of output lines in an error message."""
POLL_S = 0.2
"""Time between two calls of ``watch`` [s]."""
STOP_S = 30.0
"""Time limit for the last checkpoint if an exception other than an interrupt ends the call [s]."""
PARENT_DEATH_SIGNAL = 1
"""``PR_SET_PDEATHSIG``."""


class ProgramError(RuntimeError):
    """Raised if a command of the program fails, with the program's message."""

    def __init__(self, command: str, status: int, output: str) -> None:
        super().__init__(f"dmprl {command} ended with status {status}:\n{output}")
        self.status = status


def call(
    command: str,
    *arguments: str,
    quiet: bool = False,
    error: type[ProgramError] = ProgramError,
    watch: Callable[[], bool] | None = None,
) -> str:
    """Runs a command of the program and returns its standard output.

    Its progress is drawn in a terminal, and printed as lines elsewhere, for example in a notebook;
    ``quiet`` suppresses it.

    :param error: the exception to raise on failure.
    :param watch: called regularly while the program runs; after False it is interrupted, and the
        call returns as if it had ended by itself.
    :raises ProgramError: if it failed.
    :raises KeyboardInterrupt: if it was interrupted.
    :raises FileNotFoundError: if the program is not installed.
    """
    with tempfile.TemporaryFile() as printed:
        words = [str(find()), command, *arguments]
        status, output, stopped = _run(words, quiet, printed, watch or (lambda: True))
        if status == INTERRUPTED and not stopped:
            raise KeyboardInterrupt
        if status not in (0, INTERRUPTED):
            raise error(command, status, output)
        printed.seek(0)
        return printed.read().decode()


def flags(values: dict[str, Any]) -> list[str]:
    """Converts keyword arguments to command-line flags.

    ``steps=20_000`` becomes ``--steps 20000``, ``algorithm__batch_size=64`` becomes
    ``--set algorithm.batch_size=64``, and True becomes the flag without a value. None and False are
    omitted. A list repeats the flag for each entry. A dictionary does too, with ``key=value``.
    """
    words: list[str] = []
    for name, value in values.items():
        flag = f"--{name.replace('_', '-')}"
        if value is None or (value is False and "__" not in name):
            continue  # omitted
        if "__" in name:
            words += ["--set", f"{name.replace('__', '.')}={_toml(value)}"]
        elif value is True:
            words.append(flag)
        elif isinstance(value, dict):
            pairs = (f"{key}={_toml([entry])[1:-1]}" for key, entry in value.items())
            words += [word for pair in pairs for word in (flag, pair)]
        elif isinstance(value, (list, tuple)):
            words += [word for entry in value for word in (flag, str(entry))]
        else:
            words += [flag, str(value)]
    return words


def find() -> Path:
    """Finds the program: beside this Python, on ``PATH``, or built in the repository.

    :raises FileNotFoundError: if it is not found; the message explains how to build it.
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
        f"the program dmprl is not beside {sys.executable}, on PATH or at {built}; build it with: "
        "cargo build --release"
    )


def _run(
    command: list[str], quiet: bool, printed: IO[bytes], watch: Callable[[], bool]
) -> tuple[int, str, bool]:
    """Runs the program; returns its exit status, its last lines, and whether ``watch`` ended it."""
    # In a terminal the program draws its own progress; a notebook shows its lines.
    live = not quiet and sys.stderr.isatty()
    child = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=printed,
        stderr=None if live else subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
        # So that only this process receives the terminal's interrupt, and forwards it once.
        start_new_session=True,
        preexec_fn=_end_with_parent,
    )
    last: collections.deque[str] = collections.deque(maxlen=LAST_LINES)
    reader = threading.Thread(target=_read, args=(child, last, quiet), daemon=True)
    reader.start()
    stopped = interrupted = False
    try:
        while child.poll() is None:
            try:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.wait(POLL_S)
                if not stopped and not watch():
                    stopped = True
                    child.send_signal(signal.SIGINT)
            except KeyboardInterrupt:
                interrupted = True
                child.send_signal(signal.SIGINT)
        reader.join()
        output = "see its output above" if live else "".join(last)
        return child.returncode, output, stopped and not interrupted
    finally:
        # After any other exception, training must not continue unnoticed.
        if child.poll() is None:
            _stop(child)


def _read(child: subprocess.Popen[str], last: collections.deque[str], quiet: bool) -> None:
    """Reads the program's log, so that its pipe does not fill, and prints it unless ``quiet``."""
    for line in child.stderr or ():
        last.append(line)
        if not quiet:
            print(line, end="", file=sys.stderr)


def _stop(child: subprocess.Popen[str]) -> None:
    """Interrupts the program, which then writes a checkpoint; kills it after a time limit."""
    child.send_signal(signal.SIGINT)
    try:
        child.wait(STOP_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def _end_with_parent() -> None:
    """Makes the kernel stop the program, which then writes a checkpoint, if this process dies."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PARENT_DEATH_SIGNAL, signal.SIGTERM)


def _toml(value: Any) -> str:
    """Formats a value for ``--set``."""
    if isinstance(value, (list, tuple)):
        # JSON strings are valid TOML strings.
        entries = (json.dumps(it) if isinstance(it, str) else _toml(it) for it in value)
        return f"[{', '.join(entries)}]"
    if isinstance(value, dict):
        entries = (f"{json.dumps(key)} = {_toml([entry])[1:-1]}" for key, entry in value.items())
        return f"{{{', '.join(entries)}}}"
    return str(value).lower() if isinstance(value, bool) else str(value)

"""Runs the program ``dmprl`` from Python, in a separate process."""

from __future__ import annotations

import collections
import ctypes
import json
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO, Any

INTERRUPTED = 130
"""Exit status of a program that saved after an interrupt."""
LAST_LINES = 20
"""Output lines kept for an error message."""
STOP_S = 30.0
"""Time for the last checkpoint, if anything but an interrupt ends the call [s]."""
PARENT_DEATH_SIGNAL = 1
"""``PR_SET_PDEATHSIG``."""


class ProgramError(RuntimeError):
    """Raised if a command of the program fails; the message is the program's own."""

    def __init__(self, command: str, status: int, said: str) -> None:
        super().__init__(f"dmprl {command} ended with status {status}:\n{said}")
        self.status = status


def call(
    command: str, *arguments: str, quiet: bool = False, error: type[ProgramError] = ProgramError
) -> str:
    """Runs a command of the program to its end; returns its standard output.

    Its progress is drawn in a terminal, and printed as lines elsewhere, for example in a notebook;
    ``quiet`` suppresses it.

    :raises ProgramError: if it failed, as an ``error``.
    :raises KeyboardInterrupt: if it was interrupted.
    :raises FileNotFoundError: if the program is not installed.
    """
    with tempfile.TemporaryFile() as printed:
        status, said = _run([str(find()), command, *arguments], quiet, printed)
        if status == INTERRUPTED:
            raise KeyboardInterrupt
        if status != 0:
            raise error(command, status, said)
        printed.seek(0)
        return printed.read().decode()


def flags(values: dict[str, Any]) -> list[str]:
    """Converts keyword arguments to command-line flags.

    ``steps=20_000`` becomes ``--steps 20000``, ``algorithm__batch_size=64`` becomes
    ``--set algorithm.batch_size=64``, and True gives the flag alone. None and False are omitted. A
    list repeats the flag for each entry.
    """
    typed: list[str] = []
    for name, value in values.items():
        flag = f"--{name.replace('_', '-')}"
        if value is None or (value is False and "__" not in name):
            continue  # omitted
        if "__" in name:
            typed += ["--set", f"{name.replace('__', '.')}={_toml(value)}"]
        elif value is True:
            typed.append(flag)
        elif isinstance(value, (list, tuple)):
            typed += [word for entry in value for word in (flag, str(entry))]
        else:
            typed += [flag, str(value)]
    return typed


def find() -> Path:
    """Finds the program: beside this Python, on the search path, or built in the repository.

    :raises FileNotFoundError: if it is not found; the message says how to get it.
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


def _run(command: list[str], quiet: bool, printed: IO[bytes]) -> tuple[int, str]:
    """Runs the program to its end; returns its status and the last lines of its output."""
    # In a terminal the program draws its own progress; a notebook gets its lines.
    live = not quiet and sys.stderr.isatty()
    child = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=printed,
        stderr=None if live else subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
        # Only this process gets the terminal's interrupt, and forwards it once.
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
        # No training continues unnoticed after any other exception.
        if child.poll() is None:
            _stop(child)


def _stop(child: subprocess.Popen[str]) -> None:
    """Interrupts the program so that it writes its checkpoint; kills it on a timeout."""
    child.send_signal(signal.SIGINT)
    if child.stderr is not None:
        # Otherwise it could block on a full pipe.
        child.stderr.close()
    try:
        child.wait(STOP_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def _end_with_parent() -> None:
    """Stops the program, which writes a checkpoint, when this Python process is killed."""
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

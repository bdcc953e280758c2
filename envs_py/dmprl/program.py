"""The program ``dmprl`` from Python, in a process of its own."""

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
"""Exit status of a program that was interrupted and has saved."""
LAST_LINES = 20
"""Of what it said, for an error."""
STOP_S = 30.0
"""For its last checkpoint, when something else than an interrupt ends the call [s]."""
PARENT_DEATH_SIGNAL = 1
"""``PR_SET_PDEATHSIG``."""


class ProgramError(RuntimeError):
    """A command of the program failed; the message is the program's own."""

    def __init__(self, command: str, status: int, said: str) -> None:
        super().__init__(f"dmprl {command} ended with status {status}:\n{said}")
        self.status = status


def call(
    command: str, *arguments: str, quiet: bool = False, error: type[ProgramError] = ProgramError
) -> str:
    """Runs a command of the program to its end; what it printed.

    What it says on the way is drawn in a terminal, and printed as lines elsewhere, in a notebook
    for instance; ``quiet`` keeps it.

    :raises ProgramError: it failed, as an ``error``.
    :raises KeyboardInterrupt: it was interrupted.
    :raises FileNotFoundError: the program is not installed.
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
    """Keyword arguments as they would be typed.

    ``steps=20_000`` becomes ``--steps 20000``, ``algorithm__batch_size=64`` becomes
    ``--set algorithm.batch_size=64``, True the flag alone; None and False are left out, and a list
    of a flag that may come several times is written as often.
    """
    typed: list[str] = []
    for name, value in values.items():
        flag = f"--{name.replace('_', '-')}"
        if value is None or (value is False and "__" not in name):
            continue  # as if it were not there
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


def _run(command: list[str], quiet: bool, printed: IO[bytes]) -> tuple[int, str]:
    """Runs the program to its end; its status, and the last of what it said."""
    # In a terminal it draws by itself; a notebook gets its lines.
    live = not quiet and sys.stderr.isatty()
    child = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=printed,
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

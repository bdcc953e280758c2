"""The command ``dmprl`` of a wheel, which runs the program in this Python.

It is not a part of the package ``dmprl``, because that imports NumPy and Gymnasium, which most
commands do not need. In a clone the program is an executable that embeds Python.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

ROLES = ("actor", "evaluator", "learner", "observer")
"""Commands of the processes in which environments run."""
ISOLATION = {
    "PYTHONHASHSEED": "0",  # the order of a set is the same in every run
    "PYTHONSAFEPATH": "1",  # imports nothing from the script's folder
    "PYTHONUTF8": "1",  # a model file with "°" can be read in every locale
}
"""Settings of a Python in which environments run."""
REMOVED = ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP")
"""Variables that such a Python must not see, because packages of another Python may crash it."""


def main() -> NoReturn:
    """Runs the program with the arguments of this process."""
    from dmprl_command import _program

    words = [str(script()), *sys.argv[1:]]
    environment = isolated(os.environ)
    if words[1:2] and words[1] in ROLES and environment != dict(os.environ):
        os.execve(sys.executable, [sys.executable, *words], environment)
    # The program has its own handlers, and Python's would ignore an interrupt while it runs.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    _program.run(words)


def isolated(environment: Mapping[str, str]) -> dict[str, str]:
    """Returns the environment variables of a process in which environments run."""
    kept = {name: value for name, value in environment.items() if name not in REMOVED}
    return kept | ISOLATION


def script() -> Path:
    """Finds the script ``dmprl``, with which the program starts its other processes."""
    called = Path(sys.argv[0]).absolute()
    beside = Path(sys.executable).with_name("dmprl")
    on_path = shutil.which("dmprl")
    # ``python -m dmprl_command`` is called as a module, which is no command.
    for found in (called, beside, Path(on_path) if on_path else None):
        if found is not None and found.suffix != ".py" and os.access(found, os.X_OK):
            return found
    sys.exit(f"error: the command dmprl is neither {beside} nor on PATH; install dmprl with pip")

"""The command ``dmprl`` of a wheel, which runs the program in this Python.

It is not a part of the package ``dmprl``, because that imports NumPy and Gymnasium, which most
commands do not need. In a clone the program is an executable that embeds Python.
"""

from __future__ import annotations

import os
import shutil
import signal
import site
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

ISOLATION = {
    "PYTHONHASHSEED": "0",  # the order of a set is the same in every run
    "PYTHONNOUSERSITE": "1",  # packages of the environment only
    "PYTHONSAFEPATH": "1",  # imports nothing from the script's folder
    "PYTHONUTF8": "1",  # a model file with "°" can be read in every locale
}
"""Settings of a Python in which environments run. It has no other variables ``PYTHON…``."""
ISOLATED = "_DMPRL_ISOLATED"
"""Variable of a process that has these settings already."""


def main() -> NoReturn:
    """Runs the program with the arguments of this process."""
    # The program has its own handlers, and Python's would ignore an interrupt while it runs.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    words = [str(script()), *sys.argv[1:]]
    if ISOLATED not in os.environ:
        _check_place()
        os.execve(sys.executable, [sys.executable, *words], isolated(os.environ))
    from dmprl_command import _program

    _program.run(words)


def isolated(environment: Mapping[str, str]) -> dict[str, str]:
    """Returns the environment variables of an isolated Python."""
    kept = {name: value for name, value in environment.items() if not name.startswith("PYTHON")}
    return kept | ISOLATION | {ISOLATED: "1"}


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


def _check_place() -> None:
    """Ends the process if an isolated Python could not import this package."""
    if site.ENABLE_USER_SITE and __file__.startswith(site.getusersitepackages()):
        sys.exit(
            f"error: dmprl is in {site.getusersitepackages()}, the packages of one user, which it "
            "does not use; install it into a virtual environment"
        )

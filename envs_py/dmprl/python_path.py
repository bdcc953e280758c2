"""The user's own module folders (``--python-path``), in the same order in every process.

Worker, evaluator, observer, ``dmprl play`` and the benchmarks call :func:`extend`, so that a module
name means the same in training and afterwards.
"""

from __future__ import annotations

import pkgutil
import sys
from collections.abc import Sequence
from pathlib import Path


def extend(folders: Sequence[str]) -> None:
    """Appends folders to ``sys.path``, after the standard library and the installed packages.

    :raises ImportError: if a module in them has the name of a standard module; it would never be
        imported, or replace the standard one in other packages.
    """
    for folder in folders:
        names = {module.name for module in pkgutil.iter_modules([folder])}
        if shadowing := sorted(names & sys.stdlib_module_names):
            raise ImportError(
                f"{Path(folder) / shadowing[0]}: a module of this name is in Python's standard "
                "library; rename yours, or move it out of --python-path"
            )
    sys.path.extend(folders)

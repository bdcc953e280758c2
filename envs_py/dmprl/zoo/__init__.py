"""Trained policies that come with the package, one folder for each task.

A folder has the files of a run directory that a policy needs: the configuration, one evaluation of
100 episodes, the manifest with command and commit, the specification of the environment, and the
policy. ``deploy/zoo.py`` makes it from a run.
"""

from __future__ import annotations

from pathlib import Path

from dmprl.policy_file import PolicyFileError

PREFIX = "zoo:"
"""Begins the name of one of these policies, in place of a path."""
FOLDER = Path(__file__).parent


def names() -> list[str]:
    """Lists the names of the policies."""
    return sorted(path.parent.name for path in FOLDER.glob("*/manifest.json"))


def path(name: str | Path) -> Path | None:
    """Returns the file of the policy ``zoo:NAME``, or None if this is the path of another file.

    :raises dmprl.PolicyFileError: if the name is unknown.
    """
    if not str(name).startswith(PREFIX):
        return None
    task, known = str(name).removeprefix(PREFIX), names()
    if task not in known:
        expected = f"{PREFIX} and one of {', '.join(known)}"
        raise PolicyFileError(f"there is no policy {name}; expected {expected}")
    return next((FOLDER / task).glob("policies/*.safetensors"))

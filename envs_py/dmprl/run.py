"""Reads a run directory: its configuration, metrics as data frames, and policies.

::

    run = dmprl.Run("runs/mine")
    frame = run.evaluations()  # pandas; run.evaluations("polars")
    frame.plot(x="env_steps", y="return_mean")
    policy = run.policy()
    video = run.record(episodes=3)
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from dmprl import program
from dmprl.policy import Policy
from dmprl.policy_file import PolicyFileError

LIBRARIES = ("pandas", "polars")


class Run:
    """A run of ``dmprl train``. Each call reads the files again, because training may continue."""

    def __init__(self, path: str | Path) -> None:
        """:raises FileNotFoundError: if there is no run at ``path``."""
        self.path = Path(path)
        if not (self.path / "manifest.json").is_file():
            raise FileNotFoundError(f"{self.path} is not a run directory: it has no manifest.json")

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    @property
    def config(self) -> dict[str, Any]:
        """The resolved configuration, by section."""
        import tomllib  # since Python 3.11

        return tomllib.loads((self.path / "config.toml").read_text())

    @property
    def manifest(self) -> dict[str, Any]:
        """Versions, machine and commands of the run."""
        return json.loads((self.path / "manifest.json").read_text())

    def metrics(self, library: str = "pandas") -> Any:
        """Returns ``metrics.jsonl`` as a data frame of ``pandas`` or ``polars``.

        Each number has a column; those of a nested object are ``object/key``.

        :raises ImportError: if the library is not installed.
        """
        return _frame(self._lines("metrics.jsonl"), library)

    def evaluations(self, library: str = "pandas") -> Any:
        """Returns ``evaluations.jsonl`` as a data frame, like :meth:`metrics`.

        The column ``returns`` contains lists, with the return of each episode.
        """
        return _frame(self._lines("evaluations.jsonl"), library)

    def policy(self, which: str | int = "best") -> Policy:
        """Loads a saved policy: ``best``, ``latest`` or a version.

        The best one has the highest success rate, and of equal ones the highest return.

        :raises dmprl.PolicyFileError: if it does not exist, or cannot be read.
        """
        rows = self._lines("evaluations.jsonl")
        if not rows and isinstance(which, str):
            raise PolicyFileError(f"{self.path}: no evaluation yet, so no {which} policy")
        if which == "best":
            return Policy.load(self.path)
        if which == "latest":
            version = rows[-1]["policy_version"]
        elif isinstance(which, int):
            version = which
        else:
            raise ValueError(f"policy {which!r}: expected best, latest or a version")
        file = self.path / "policies" / f"{version}.safetensors"
        if not file.is_file():
            raise PolicyFileError(f"{self.path} has no saved policy {version}")
        return Policy.load(file)

    def record(self, *, quiet: bool = True, **flags: Any) -> Path:
        """Makes a video of a policy's episodes and returns the path of the MP4; needs no display.

        A GIF and a strip of frames are written beside it.

        :param quiet: suppresses progress.
        :param flags: flags of ``dmprl record``: ``episodes=3``, ``seed=7``, ``policy="latest"``,
            ``compare=...`` another run, ``output=...`` a folder instead of ``videos`` in the run,
            ``rerun=True`` to write a Rerun log (``.rrd``) beside the video,
            ``trust_code=True`` to import the modules of a run that you did not make.
        :raises dmprl.ProgramError: if it cannot be made; the message gives the reason.
        """
        arguments = [str(self.path), "--json", *program.flags(flags)]
        return Path(json.loads(program.call("record", *arguments, quiet=quiet))["mp4"])

    def push(self, repo: str, *, quiet: bool = True, **flags: Any) -> str:
        """Uploads a policy to the Hugging Face hub, and returns the address of its repository.

        :param repo: ``OWNER/NAME``; it is created if it does not exist.
        :param quiet: suppresses progress.
        :param flags: flags of ``dmprl push``: ``private=True``, ``policy="latest"``, ``film=...`` a
            file, ``message=...``.
        :raises dmprl.ProgramError: if it cannot be uploaded; the message gives the reason.
        """
        arguments = [str(self.path), repo, "--json", *program.flags(flags)]
        return json.loads(program.call("push", *arguments, quiet=quiet))["url"]

    def _lines(self, name: str) -> list[dict[str, Any]]:
        """Reads the complete lines of a file; training may still be writing the last one."""
        file = self.path / name
        text = file.read_text() if file.is_file() else ""
        return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def pull(repo: str, *, quiet: bool = True, **flags: Any) -> Run:
    """Downloads a policy from the Hugging Face hub, and returns its run directory.

    :param repo: ``OWNER/NAME``, which ``dmprl push`` uploaded.
    :param quiet: suppresses progress.
    :param flags: flags of ``dmprl pull``: ``revision=...``, ``output=...`` another run directory.
    :raises dmprl.ProgramError: if it cannot be downloaded; the message gives the reason.
    :raises ValueError: if the output is a policy file; ``dmprl pull`` writes that.
    """
    if str(flags.get("output", "")).endswith(".safetensors"):
        raise ValueError(f"output {flags['output']}: expected a run directory, not a policy file")
    arguments = [repo, "--json", *program.flags(flags)]
    return Run(json.loads(program.call("pull", *arguments, quiet=quiet))["path"])


def _frame(rows: list[dict[str, Any]], library: str) -> Any:
    if library not in LIBRARIES:
        raise ValueError(f"library {library!r}: expected one of {', '.join(LIBRARIES)}")
    flat = [flat_row(row) for row in rows]
    try:
        if library == "pandas":
            import pandas

            return pandas.DataFrame.from_records(flat)
        import polars

        # From all rows, because a key's first values may be null.
        return polars.from_dicts(flat, infer_schema_length=None) if flat else polars.DataFrame()
    except ModuleNotFoundError as error:
        raise ImportError(f"{error}; dmprl env add {library}") from error


def flat_row(row: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns the row with the keys of nested objects as ``object/key``."""
    flat: dict[str, Any] = {}
    for key, value in row.items():
        if isinstance(value, dict):
            flat |= flat_row(value, f"{prefix}{key}/")
        else:
            flat[prefix + key] = value
    return flat

"""Converts recorded episodes to the file that the learner reads (docs/demonstrations.md)."""

from __future__ import annotations

import itertools
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmprl.demos.resampling import Rates, rates_of, resampled
from dmprl.demos.source import DemosError, Episode, Source
from dmprl.demos.task import ColumnMapping, Task, check, columns_of, mapped

SUFFIX = ".npz"


class Wishes(NamedTuple):
    """Choices of the user; None, or empty, for the default."""

    observation: tuple[str, ...] = ()
    action: str | None = None
    reward: str | None = None
    """A column or a number."""
    rate_hz: float | None = None
    recorded_hz: float | None = None
    episodes: int | None = None
    """Maximum number of episodes."""

    def reward_number(self, source: Source) -> float | None:
        """Returns the reward of every step, if it is a number.

        :raises DemosError: if it is NaN or infinite in 32 bits.
        """
        if self.reward is None or self.reward in source.columns:
            return None
        try:
            number = float(self.reward)
        except ValueError:
            return None
        with np.errstate(over="ignore"):
            if not np.isfinite(np.float32(number)):
                raise DemosError(f"--reward {self.reward}: expected a finite 32-bit number")
        return number


class Conversion:
    """Episodes of a source as a task sees them."""

    def __init__(self, source: Source, task: Task | None, wishes: Wishes) -> None:
        self.source, self.task, self.wishes = source, task, wishes
        self._reward_number = wishes.reward_number(source)
        column = None if self._reward_number is not None else wishes.reward
        columns = columns_of(source, wishes.observation, wishes.action, column)
        self.mapping: ColumnMapping = mapped(source, columns, task)
        self.rates: Rates = rates_of(source, task, wishes.rate_hz, wishes.recorded_hz)
        self.too_short = 0
        """Number of episodes that were left out, because they have no whole step."""
        self.rewards_from = self._rewards_from()

    def _rewards_from(self) -> str:
        if self._reward_number is not None:
            return "constant"
        if self.mapping.columns.reward:
            return "recorded"
        return "task" if self.task is not None and self.task.goals is not None else "none"

    def missing_rewards(self) -> DemosError:
        """Creates the error of a source without rewards."""
        return DemosError(
            f"{self.source.name}: there are no rewards; name their column or give one number for "
            "all steps with --reward, or name a task with goals with --task, whose rewards are "
            f"computed; there are: {self.source.listing()}"
        )

    def checked(self) -> Iterator[Episode]:
        """Yields the first of the recorded episodes, in the order of the task's observation.

        :raises DemosError: if a number of theirs cannot be used.
        """
        recorded = self.source.episodes(self.mapping.columns)
        for number, episode in enumerate(itertools.islice(recorded, self.wishes.episodes)):
            ordered = self.mapping.apply(episode)
            check(self.source, number, ordered, self.mapping, self.task)
            yield ordered

    def episodes(self) -> Iterator[Episode]:
        """Yields the episodes of the result.

        :raises DemosError: if a number of theirs cannot be used.
        """
        for recorded in self.checked():
            episode = recorded
            if self.rates.differ:
                episode = resampled(recorded, self.rates)
            if episode is None or not len(episode.actions):
                self.too_short += 1
                continue
            if self.rewards_from == "constant":
                rewards = np.full(len(episode.actions), self._reward_number)
                episode = episode._replace(rewards=rewards)
            elif self.rewards_from == "task":
                episode = episode._replace(rewards=self.task.rewards(episode.observations[1:]))
            yield episode

    def notes(self) -> list[str]:
        """Describes decisions that the user may want to change. Call it after the episodes."""
        notes = self.rates.notes()
        if self.task is None:
            notes.append("no --task: order, lengths, bounds and rate are those of the data set")
        if self.rewards_from == "task":
            notes.append(f"rewards computed by {self.task.id}")
        if self.too_short:
            notes.append(f"{self.too_short} episodes without a whole step were left out")
        return notes


def convert(conversion: Conversion, output: Path) -> dict[str, Any]:
    """Writes the file and returns figures of it.

    The file appears under its name only when it is complete.

    :raises DemosError: if the source cannot be used.
    """
    if output.suffix != SUFFIX:
        raise DemosError(f"{output}: expected a name that ends with {SUFFIX}")
    if not output.absolute().parent.is_dir():
        raise DemosError(f"{output}: the folder does not exist; create it first")
    if conversion.rewards_from == "none":
        raise conversion.missing_rewards()
    parts = [arrays_of(episode) for episode in conversion.episodes()]
    if not parts:
        left_out = "; ".join(conversion.notes())
        raise DemosError(f"{conversion.source.name}: no episode to convert; {left_out}")
    successes = [part.pop("success") for part in parts]
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    arrays = {key: np.ascontiguousarray(rows) for key, rows in joined.items()}  # C order
    if all(success is not None for success in successes):
        ends = (arrays["terminated"] | arrays["truncated"]).astype(bool)
        arrays["success"] = np.zeros(len(ends), np.uint8)
        arrays["success"][ends] = successes
    if conversion.rates.result_hz:
        arrays["rate_hz"] = np.array([conversion.rates.result_hz])
    write(output, arrays)
    return {
        "source": conversion.source.name,
        "output": str(output),
        "episodes": len(parts),
        "steps": len(arrays["rewards"]),
        "return_mean": float(arrays["rewards"].sum(dtype=np.float64) / len(parts)),
        "successes": int(arrays["success"].sum()) if "success" in arrays else None,
        "rate_hz": conversion.rates.result_hz or None,
        "resampled": conversion.rates.differ,
        "rewards": conversion.rewards_from,
        "notes": conversion.notes(),
    }


def arrays_of(episode: Episode) -> dict[str, Any]:
    """Returns the rows of the file for one episode, and its success."""
    steps = len(episode.actions)
    last = np.zeros(steps, np.uint8)
    last[-1] = 1
    observations = episode.observations.astype(np.float32)
    return {
        "observations": observations[:-1],
        "actions": episode.actions.astype(np.float32),
        "rewards": episode.rewards.astype(np.float32),
        "next_observations": observations[1:],
        "terminated": last * np.uint8(episode.terminated),
        "truncated": last * np.uint8(not episode.terminated),
        "success": episode.success,
    }


def write(output: Path, arrays: dict[str, NDArray]) -> None:
    """Writes an archive under a temporary name and renames it."""
    folder = output.absolute().parent
    with tempfile.NamedTemporaryFile(dir=folder, suffix=SUFFIX, delete=False) as file:
        try:
            np.savez(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
            os.chmod(file.name, 0o666 & ~umask())
            os.replace(file.name, output)
        except BaseException:
            os.unlink(file.name)
            raise


def umask() -> int:
    """Returns the process's file mode creation mask."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def text_of(result: dict[str, Any]) -> str:
    """Describes a conversion for people."""
    known = result["successes"] is not None
    success = f", {result['successes']} successful" if known else ""
    rate = f" of {result['rate_hz']:g} Hz" if result["rate_hz"] else ""
    first = (
        f"{result['output']}: {result['episodes']} episodes{success}, {result['steps']} "
        f"steps{rate}, mean return {result['return_mean']:.2f}"
    )
    return "\n".join([first, *(f"  {note}" for note in result["notes"])])

"""The interface of recorded episodes, independent of their format."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

EXTRA = "dmprl[demos]"
"""Part of the package that reads other formats."""


class DemosError(Exception):
    """Raised if demonstrations cannot be read or used. The message is for the user."""


class Episode(NamedTuple):
    """An episode of T steps."""

    observations: NDArray[np.float64]
    """(T+1, O): before the first step and after each."""
    actions: NDArray[np.float64]
    """(T, A)."""
    rewards: NDArray[np.float64] | None
    """(T,); None if they were not recorded."""
    terminated: bool
    """Whether the task ended the episode. Otherwise a time limit or the recording ended it."""
    success: bool | None
    """Whether it ended successfully; None if unknown."""


class Columns(NamedTuple):
    """The columns from which episodes are read."""

    observation: tuple[str, ...]
    """Columns whose entries, in this order, are an observation."""
    action: str
    reward: str | None
    """None if there are no rewards, or if they are not read."""


class Source(ABC):
    """A data set with recorded episodes."""

    name: str
    """As the user wrote it."""
    format: str
    rate_hz: float
    """Steps per second; 0.0 if the data set does not state it."""
    episode_count: int
    columns: dict[str, list[str]]
    """Names of the entries of each column that holds numbers."""
    others: dict[str, str]
    """Kind of each column that cannot be read, such as an image."""
    observation: tuple[str, ...]
    """Columns of the observation by the conventions of the format; empty if there are none."""
    action: str
    """Column of the action by the conventions of the format; empty if there is none."""
    reward: str | None
    """Column of the rewards by the conventions of the format."""

    @abstractmethod
    def episodes(self, columns: Columns) -> Iterator[Episode]:
        """Reads the episodes in order.

        :raises DemosError: if the data set is damaged.
        """

    def choices(self, part: str) -> list[str]:
        """Returns the columns of which ``part``, observation or action, can be made."""
        return list(self.columns)

    def listing(self, part: str = "") -> str:
        """Returns names and lengths of the columns, all or those for ``part``, for messages."""
        columns = self.choices(part) if part else list(self.columns)
        parts = [f"{name} ({len(self.columns[name])})" for name in columns]
        parts += [f"{name} ({kind}, cannot be read)" for name, kind in self.others.items()]
        return ", ".join(parts) or "none"

    @contextlib.contextmanager
    def explained(self) -> Iterator[None]:
        """Turns any exception of a reader into a :class:`DemosError` with the source's name."""
        try:
            yield
        except DemosError:
            raise
        except Exception as error:
            raise DemosError(
                f"{self.name}: cannot be read as {self.format}: {type(error).__name__}: {error}"
            ) from error


def missing_package(name: str, package: str) -> DemosError:
    """Creates the error of a source that needs a package that is not installed."""
    return DemosError(
        f"{name}: the package {package} is not installed; install it with: dmprl env add '{EXTRA}'"
    )


def entry_names(column: str, length: int) -> list[str]:
    """Returns the names of the entries of a column without names of its own."""
    return [f"{column}[{index}]" for index in range(length)]

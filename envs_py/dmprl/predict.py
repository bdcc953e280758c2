"""Stable-Baselines3's ``predict`` for a policy that decides K steps at once.

The policy itself acts in the first environment, and a copy in each other one, because each is at
its own step of a segment.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Acting(Protocol):
    """The part of :class:`dmprl.Policy` that is used."""

    def action(self, observation: ArrayLike | None = None) -> NDArray[np.float64]:
        """Returns the next control step's action, (A,)."""

    def reset(self) -> None:
        """Starts an episode."""


class Predictor:
    """Acts in one or several environments, one control step at a time."""

    def __init__(self, policy: Acting, observation_len: int) -> None:
        """Acts with ``policy``, whose observations have ``observation_len`` entries."""
        self._policies = [policy]
        self._observation_len = observation_len

    def predict(
        self, observation: ArrayLike | Mapping[str, ArrayLike], episode_start: ArrayLike | None
    ) -> NDArray[np.float64]:
        """Returns the next action of each environment, (E, A), or (A,) without their dimension.

        :param observation: (O,), (E, O), or a mapping with such entries, which are joined in the
            order of their names.
        :param episode_start: (E,), whether each observation is the first of an episode.
        :raises ValueError: if the shapes differ from these.
        """
        rows, is_batch = self._rows(observation)
        starts = np.zeros(len(rows), bool)
        if episode_start is not None:
            starts = np.atleast_1d(np.asarray(episode_start, bool))
        if starts.shape != (len(rows),):
            raise ValueError(f"episode_start has shape {starts.shape}, expected ({len(rows)},)")
        while len(self._policies) < len(rows):
            other = copy.deepcopy(self._policies[0])
            other.reset()
            self._policies.append(other)
        actions = []
        for policy, row, start in zip(self._policies, rows, starts, strict=False):
            if start:
                policy.reset()
            actions.append(policy.action(row))
        return np.stack(actions) if is_batch else actions[0]

    def reset(self) -> None:
        """Starts an episode in every environment but the first, whose policy the caller resets."""
        for policy in self._policies[1:]:
            policy.reset()

    def _rows(
        self, observation: ArrayLike | Mapping[str, ArrayLike]
    ) -> tuple[NDArray[np.float64], bool]:
        """Returns observations (E, O), and whether there is a dimension of environments."""
        parts = [observation]
        if isinstance(observation, Mapping):
            parts = [observation[name] for name in sorted(observation)]
        arrays = [np.asarray(part, np.float64) for part in parts]
        if sum(array.size for array in arrays) == self._observation_len:
            is_batch = all(array.ndim > 1 and array.shape[0] == 1 for array in arrays)
            return np.concatenate([array.reshape(1, -1) for array in arrays], axis=1), is_batch
        counts = {array.shape[0] if array.ndim > 1 else None for array in arrays}
        rows = counts.pop()
        if counts or not rows:
            shapes = [array.shape for array in arrays]
            raise ValueError(
                f"observation has shape {shapes[0] if len(shapes) == 1 else shapes}, expected "
                f"({self._observation_len},) or (environments, {self._observation_len})"
            )
        return np.concatenate([array.reshape(rows, -1) for array in arrays], axis=1), True

"""The actions that a policy has planned, as ``shared/runtime/src/policy/plan.rs`` in Rust."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


class Plan:
    """Planned actions u of up to K steps. Segments are added; actions are taken.

    If a segment is added before the plan is empty, each step gets the mean of both. If one is added
    at every step, an action has the weight 1/2 for the newest segment, 1/4 for the one before, and
    so on: a temporal ensemble (Zhao et al. 2023, "Learning Fine-Grained Bimanual Manipulation with
    Low-Cost Hardware").
    """

    def __init__(self, segment_steps: int, action_len: int) -> None:
        self._actions = np.zeros((segment_steps, action_len), np.float32)
        self._taken = segment_steps

    @property
    def is_empty(self) -> bool:
        """Whether no action is left."""
        return self._taken == len(self._actions)

    def clear(self) -> None:
        """Drops the remaining actions."""
        self._taken = len(self._actions)

    def add(self, segment: Floats) -> None:
        """Adds actions u, (K, A), from the next step on. They are clipped to [-1, 1]."""
        clipped = np.clip(segment, np.float32(-1.0), np.float32(1.0))
        left = len(self._actions) - self._taken
        clipped[:left] = np.float32(0.5) * (self._actions[self._taken :] + clipped[:left])
        self._actions, self._taken = clipped, 0

    def take(self) -> Floats:
        """Takes the next action, (A,); the plan must not be empty."""
        action = self._actions[self._taken]
        self._taken += 1
        return action

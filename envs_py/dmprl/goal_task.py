"""Tasks with a goal in the observation, whose reward only depends on the goal and on its distance.

An observation starts with the achieved goal (G) and the desired goal (G). So a step can be rewarded
for a goal other than its own, which hindsight experience replay does (Andrychowicz et al. 2017).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dmprl.segment_env import Goals
from dmprl.stepwise_batch import StepwiseTask


class GoalTask(StepwiseTask):
    """A task that rewards a small distance between the achieved and the desired goal.

    Its reward is sparse (0 within a distance, else -1) or dense (minus the distance).
    """

    goal_len: int
    """G, the number of entries of a goal."""
    goal_norm = "euclidean"
    """Norm of the difference of two goals, which is their distance."""
    success_distance = 0.05
    """Distance below which the goal counts as reached."""
    sparse = True
    """Whether the reward only depends on whether the goal is reached."""

    def goals(self) -> Goals:  # noqa: D102 - inherited
        length = self.goal_len
        return {"achieved": 0, "desired": length, "length": length, "sparse": self.sparse}

    def goal_rewards(  # noqa: D102 - inherited
        self,
        achieved: NDArray[np.float64],
        desired: NDArray[np.float64],
        out: NDArray[np.float64],
    ) -> None:
        distances = goal_distances(achieved, desired)
        if self.sparse:
            np.greater(distances, self.success_distance, out=out, casting="unsafe")
            distances = out
        np.subtract(0.0, distances, out=out)

    def rewards(  # noqa: D102 - inherited
        self,
        observations: NDArray[np.float64],
        actions: NDArray[np.float32],
        out: NDArray[np.float64],
    ) -> None:
        self.goal_rewards(*self._split(observations[:, 1:]), out)

    def successes(  # noqa: D102 - inherited
        self, observations: NDArray[np.float64], out: NDArray[np.uint8]
    ) -> None:
        distances = goal_distances(*self._split(observations))
        np.less(distances, self.success_distance, out=out, casting="unsafe")

    def _split(
        self, observations: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        length = self.goal_len
        return observations[..., :length], observations[..., length : 2 * length]


def goal_distances(
    achieved: NDArray[np.float64], desired: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Computes the Euclidean distances (…) of goals (…, G)."""
    difference = achieved - desired
    return np.sqrt(np.vecdot(difference, difference))

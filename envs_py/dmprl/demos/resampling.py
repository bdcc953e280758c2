"""Resamples episodes to another rate."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmprl.demos.source import DemosError, Episode, Source
from dmprl.demos.task import Task

EQUAL = 1e-3
"""Rates that differ by at most this share are equal: it is a tenth of a step in 100 steps."""
RATE_MAX_HZ = 10_000.0
RATIO_MAX = 100.0
"""Maximum ratio of two rates. A larger one is a mistake in one of them."""


class Rates(NamedTuple):
    """Rates before and after resampling."""

    recorded_hz: float
    """0.0 if unknown."""
    wanted_hz: float
    """0.0 if unknown."""

    @property
    def differ(self) -> bool:
        """Whether episodes must be resampled."""
        known = self.recorded_hz > 0.0 and self.wanted_hz > 0.0
        return known and not math.isclose(self.recorded_hz, self.wanted_hz, rel_tol=EQUAL)

    @property
    def result_hz(self) -> float:
        """Rate of the result; 0.0 if unknown."""
        return self.wanted_hz or self.recorded_hz

    def notes(self) -> list[str]:
        """Describes the resampling, or why there may be one missing."""
        if self.differ:
            return [
                f"resampled from {self.recorded_hz:g} to {self.wanted_hz:g} Hz: observations and "
                "actions linearly, rewards as recorded at the end of each step"
            ]
        if self.wanted_hz and not self.recorded_hz:
            return [
                "the rate of the recording is unknown (dmprl demos convert --recorded-rate), so "
                f"its steps are used as steps of {self.wanted_hz:g} Hz"
            ]
        return []


def rates_of(
    source: Source, task: Task | None, rate_hz: float | None, recorded_hz: float | None
) -> Rates:
    """Determines the rates: those that are given, else those of the task and of the source.

    :raises DemosError: if a rate makes no sense.
    """
    for flag, given in (("--rate", rate_hz), ("--recorded-rate", recorded_hz)):
        if given is not None and not 0.0 < given <= RATE_MAX_HZ:  # also refuses NaN
            raise DemosError(f"{flag} {given:g}: expected more than 0, at most {RATE_MAX_HZ:g} Hz")
    of_task = task.rate_hz if task is not None else 0.0
    if rate_hz and of_task and not math.isclose(rate_hz, of_task, rel_tol=EQUAL):
        raise DemosError(
            f"--rate {rate_hz:g}: the control rate of {task.id} is {of_task:g} Hz; omit --rate"
        )
    rates = Rates(recorded_hz or source.rate_hz, rate_hz or of_task)
    if not 0.0 <= rates.recorded_hz <= RATE_MAX_HZ:
        raise DemosError(
            f"{source.name}: its rate is {rates.recorded_hz:g} Hz; expected more than 0, at most "
            f"{RATE_MAX_HZ:g}; give the right one with --recorded-rate"
        )
    if rate_hz and not rates.recorded_hz:
        raise DemosError(
            f"{source.name} does not state its rate, which --rate needs; give it with "
            "--recorded-rate"
        )
    if rates.differ:
        ratio = rates.wanted_hz / rates.recorded_hz
        if not 1.0 / RATIO_MAX <= ratio <= RATIO_MAX:
            raise DemosError(
                f"{source.name}: {rates.recorded_hz:g} Hz cannot be resampled to "
                f"{rates.wanted_hz:g} Hz; expected a ratio of at most {RATIO_MAX:g}"
            )
    return rates


def resampled(episode: Episode, rates: Rates) -> Episode | None:
    """Resamples an episode; None if it is shorter than one step of the result.

    - Observations are interpolated linearly. An action belongs to the start of its step, and is
      interpolated between these times; the last one is kept to the end of the episode.
    - The reward of a step is that of the recorded step in which it ends.
    - A rest that is shorter than a step is left out. The result is then truncated.
    """
    recorded_steps = len(episode.actions)
    duration_s = recorded_steps / rates.recorded_hz
    steps = math.floor(duration_s * rates.wanted_hz + EQUAL)
    if steps < 1 or recorded_steps < 1:
        return None
    # Times in recorded steps.
    times = np.arange(steps + 1) * (rates.recorded_hz / rates.wanted_hz)
    ends = np.clip(np.ceil(times[1:] - EQUAL).astype(np.intp) - 1, 0, recorded_steps - 1)
    is_whole = math.isclose(times[-1], recorded_steps, abs_tol=EQUAL)
    return Episode(
        observations=interpolated(episode.observations, times),
        actions=interpolated(episode.actions, times[:-1]),
        rewards=None if episode.rewards is None else episode.rewards[ends],
        terminated=episode.terminated and is_whole,
        success=episode.success,
    )


def interpolated(rows: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolates rows at times that are given in rows; the first and last row extend further."""
    at = np.arange(len(rows))
    return np.stack([np.interp(times, at, column) for column in rows.T], axis=1)

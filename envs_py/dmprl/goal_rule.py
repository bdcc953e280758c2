"""Finds the rule by which an environment rewards goals, and proves it.

With such a rule the learner computes the reward of any step for any goal, without Python
(``shared/runtime/src/goal_rule.rs``). An environment can declare its rule; otherwise it is fitted
by probing :meth:`SegmentEnv.relabel`. In both cases the rule is used only if it agrees with the
environment on pairs of goals, many of them near the threshold.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dmprl.segment_env import SegmentEnv

PAIRS = 1_000
"""Pairs of goals on which a rule must agree with the environment."""

FAR = 1e3
"""A distance beyond every threshold."""

ROUNDING = 1e-6
"""A pair this close to a threshold proves nothing: environments compare in 32 or 64 bits."""


class NoGoalRuleError(ValueError):
    """Raised if no rule agrees with the environment. The message is the reason."""


class GoalRule(TypedDict):
    """Reward as a function of the distance between achieved and desired goal.

    Sparse with ``threshold``, ``reached`` and ``missed``; dense with ``factor``.
    """

    norm: str
    """``euclidean`` or ``max``."""
    components: NotRequired[list[int]]
    """Entries of a goal that the distance depends on; all if missing."""
    threshold: NotRequired[float]
    """Largest distance at which the goal is reached."""
    reached: NotRequired[float]
    """Reward of a step that reaches the goal."""
    missed: NotRequired[float]
    """Reward of any other step."""
    factor: NotRequired[float]
    """Reward divided by the distance."""
    ends_within: NotRequired[float | None]
    """Largest distance at which the episode ends; None: it does not end at the goal."""


@dataclass
class Outcomes:
    """Rewards and ends of steps, (M,)."""

    rewards: NDArray[np.float64]
    ends: NDArray[np.bool_]


Probe = Callable[[NDArray[np.float64], NDArray[np.float64]], Outcomes]
"""Computes outcomes for achieved and desired goals, (M, G) each."""


def proven(env: SegmentEnv) -> GoalRule:
    """Returns the declared or fitted rule of ``env``, with all its keys, after proving it.

    Raises:
        NoGoalRuleError: if there is no rule, or the environment does not agree with it.
        NotGoalConditionedError: if the environment has no goals.
    """
    length = env.goals()["length"]
    probe = probe_of(env, length)
    try:
        rule = env.goal_rule()
        if rule is None:
            raise NoGoalRuleError("the environment declares that it has none")
        rule = {"components": list(range(length)), "ends_within": None, **rule}
        prove(rule, probe, length)
    except NoGoalRuleError:
        raise
    except Exception as error:  # the user's code; without a rule, workers make copies
        raise NoGoalRuleError(f"{type(error).__name__}: {error}") from error
    return rule


def fit(env: SegmentEnv) -> GoalRule:
    """Finds the rule that a few probes of ``env`` suggest.

    Raises:
        NoGoalRuleError: if the reward is neither sparse nor a multiple of the distance.
    """
    length = env.goals()["length"]
    return _fit(probe_of(env, length), length)


def probe_of(env: SegmentEnv, length: int) -> Probe:
    """Returns a function that computes the outcomes of goals with ``env``."""
    from dmprl.segment_env import GoalRows  # that module imports this one

    def probe(achieved: NDArray[np.float64], desired: NDArray[np.float64]) -> Outcomes:
        rows = GoalRows(len(achieved), length)
        rows.count[0] = len(achieved)
        rows.achieved[:], rows.desired[:] = achieved, desired
        env.relabel(rows)
        if not np.isfinite(rows.rewards).all():
            raise NoGoalRuleError("compute_reward returned a number that is not finite")
        return Outcomes(rows.rewards, rows.terminated != 0)

    return probe


def _fit(probe: Probe, length: int) -> GoalRule:
    origin = np.zeros(length)

    def at(*goals: NDArray[np.float64]) -> Outcomes:
        desired = np.stack(goals)
        return probe(np.zeros_like(desired), desired)

    # The origin, then a far goal along each axis.
    far = at(origin, *(FAR * np.eye(length)))
    reached, end = float(far.rewards[0]) + 0.0, bool(far.ends[0])  # not -0.0
    changed = (far.rewards[1:] != reached) | (far.ends[1:] != end)
    components = np.flatnonzero(changed).tolist()
    if not components:
        raise NoGoalRuleError("the reward does not depend on the distance of the goals")
    axis = np.eye(length)[components[0]]
    spread = np.zeros(length)
    spread[components] = 1.0
    missed = float(far.rewards[1 + components[0]])
    rule: GoalRule = {"norm": "euclidean", "components": components, "ends_within": None}
    if missed == float(at(2.0 * FAR * axis).rewards[0]):
        rule["reached"], rule["missed"] = reached, missed
        rule["threshold"] = _threshold(lambda d: at(d * axis).rewards[0] == reached)
        # Between the thresholds of both norms, which are equal for one component.
        between = 0.5 * (1.0 + len(components) ** -0.5) * rule["threshold"]
        is_max = at(between * spread).rewards[0] == reached
    else:
        rule["factor"] = missed / FAR
        is_max = np.isclose(at(FAR * spread).rewards[0], missed, rtol=1e-3)
    if len(components) > 1 and is_max:
        rule["norm"] = "max"
    if end and not far.ends[1 + components[0]]:
        rule["ends_within"] = _threshold(lambda d: bool(at(d * axis).ends[0]))
    return rule


def _threshold(is_within: Callable[[float], bool]) -> float:
    """Finds the largest distance that is within, by bisection, as a short decimal if possible."""
    low, high = 0.0, FAR
    while True:
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (middle, high) if is_within(middle) else (low, middle)
    short = float(f"{low:.6g}")
    return short if abs(short - low) <= ROUNDING * low else low


def distance(rule: GoalRule, achieved: NDArray, desired: NDArray) -> NDArray[np.float64]:
    """Computes the rule's distance of goals, (M, G) each."""
    differences = np.abs(achieved - desired)[:, rule["components"]]
    if rule["norm"] == "max":
        return differences.max(axis=1)
    return np.sqrt((differences**2).sum(axis=1))


def prove(rule: GoalRule, probe: Probe, length: int) -> None:
    """Compares ``rule`` with the environment on :data:`PAIRS` pairs.

    Of each three pairs, one is far apart, one at up to three thresholds, and one within 10 % to
    0.01 % of a threshold, on either side.

    Raises:
        NoGoalRuleError: with the first pair on which they differ.
    """
    thresholds = [rule.get(key) for key in ("threshold", "ends_within")]
    thresholds = [value for value in thresholds if value is not None] or [1.0]
    random = np.random.default_rng(0)
    achieved = random.normal(size=(PAIRS, length))
    desired = achieved + random.normal(size=(PAIRS, length))
    scale = random.choice(thresholds, size=PAIRS)
    near = scale * random.uniform(0.0, 3.0, PAIRS)
    margin = 10.0 ** random.uniform(-4.0, -1.0, PAIRS) * random.choice([-1.0, 1.0], PAIRS)
    wanted = np.where(np.arange(PAIRS) % 3 == 1, near, scale * (1.0 + margin))
    apart = distance(rule, achieved, desired)
    moved = achieved + (desired - achieved) * (wanted / apart)[:, None]
    desired = np.where((np.arange(PAIRS) % 3 == 0)[:, None], desired, moved)
    outcomes, apart = probe(achieved, desired), distance(rule, achieved, desired)
    if "threshold" in rule:
        expected = np.where(apart <= rule["threshold"], rule["reached"], rule["missed"])
        same = np.isclose(outcomes.rewards, expected, rtol=1e-6, atol=0.0)
        same |= np.abs(apart - rule["threshold"]) < ROUNDING * (1.0 + np.abs(achieved).max(axis=1))
    else:
        expected = rule["factor"] * apart
        same = np.isclose(outcomes.rewards, expected, rtol=1e-4, atol=1e-5)
    within = rule["ends_within"]
    ends = np.zeros(PAIRS, bool) if within is None else apart <= within
    same_end = outcomes.ends == ends
    if within is not None:
        same_end |= np.abs(apart - within) < ROUNDING * (1.0 + np.abs(achieved).max(axis=1))
    for name, agree, got, by_rule in (
        ("reward", same, outcomes.rewards, expected),
        ("end", same_end, outcomes.ends, ends),
    ):
        if not agree.all():
            at = int(agree.argmin())
            raise NoGoalRuleError(
                f"at distance {apart[at]:.6g} the {name} is {got[at]}, not {by_rule[at]} as for "
                f"a {'sparse' if 'threshold' in rule else 'dense'} reward by {rule['norm']} norm"
            )

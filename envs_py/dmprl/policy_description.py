"""Checks a policy's description, like ``shared/runtime/src/policy/description.rs`` in Rust."""

from __future__ import annotations

import math
from typing import Any

WORDS = {
    "algorithm": ("ddpg", "td3", "sac", "tqc", "ndp"),
    "policy.kind": ("dmp", "mlp", "chunk"),
    "policy.controller": ("inverse", "position", "direct"),
    "policy.rho": ("bounded", "free"),
    "policy.start": ("zero", "observed", "carry", "action"),
    "policy.start_velocity": ("measured", "zero"),
    "dmp.forcing_scaling": ("none", "goal"),
}
"""Known values of each key that changes the policy's function. Newer files may have others."""
EXECUTIONS = ("segment", "ensemble")
POSITIVE = ("policy.goal_range", "policy.rho_range", "policy.position_scale", "dmp.alpha_y")
COUNTS = ("policy.segment_steps", "dmp.basis_count", "spec.observation_len", "spec.action_len")


def check(description: dict[str, Any]) -> None:
    """Rejects an invalid description.

    :raises ValueError: with the key, its value and the expected one.
    :raises KeyError: if a key is missing.
    """
    for key, words in WORDS.items():
        expect(key, found := value(description, key), found in words, f"one of {', '.join(words)}")
    for key in POSITIVE:
        found = value(description, key)
        expect(key, found, is_finite(found) and found > 0, "a positive number")
    # Files of older versions do not have the next two.
    found = description["policy"].get("action_range", 1.0)
    fits = is_finite(found) and 0 < found <= 1
    expect("policy.action_range", found, fits, "a number above 0, at most 1")
    found = description["policy"].get("execution", "segment")
    expect("policy.execution", found, found in EXECUTIONS, f"one of {', '.join(EXECUTIONS)}")
    for key in COUNTS:
        found = value(description, key)
        expect(key, found, isinstance(found, int) and found > 0, "an integer, 1 or more")
    spec = description["spec"]
    low, high, length = spec["action_low"], spec["action_high"], spec["action_len"]
    for key, bounds in (("spec.action_low", low), ("spec.action_high", high)):
        fits = len(bounds) == length and all(is_finite(bound) for bound in bounds)
        expect(key, bounds, fits, f"{length} finite numbers")
    ordered = all(below < above for below, above in zip(low, high, strict=True))
    expect("spec.action_low", low, ordered, f"below action_high = {high}")
    duration = spec["control_dt_s"]
    expect("spec.control_dt_s", duration, is_finite(duration) and duration >= 0, "0 or more [s]")
    names = spec["observation_names"]
    fits = len(names) in (0, spec["observation_len"])
    expect("spec.observation_names", names, fits, f"0 or {spec['observation_len']} names")
    if description["policy"]["kind"] == "dmp" and description["policy"]["start"] == "observed":
        check_sources(description["start_sources"], length, spec["observation_len"])


def check_sources(sources: list[dict[str, Any]], count: int, observation_len: int) -> None:
    """Rejects sources of the DMP's start that are not in the observation."""
    expect("start_sources", sources, len(sources) == count, f"{count} entries")
    for source in sources:
        keys = ("cos", "sin", "velocity") if "cos" in source else ("index", "velocity")
        indices = [source[key] for key in keys]
        fits = all(isinstance(index, int) and 0 <= index < observation_len for index in indices)
        expect("start_sources", source, fits, f"indices below {observation_len}")
        expect("start_sources", source, is_finite(source.get("scale", 1.0)), "a finite scale")


def value(description: dict[str, Any], key: str) -> Any:
    """Returns the value of a dotted key."""
    for part in key.split("."):
        description = description[part]
    return description


def is_finite(number: Any) -> bool:
    """Returns whether ``number`` is a finite number."""
    return isinstance(number, int | float) and math.isfinite(number)


def expect(key: str, found: Any, fits: bool, expected: str) -> None:
    """Raises ValueError unless ``fits``."""
    if not fits:
        raise ValueError(f"{key} is {found!r}, expected {expected}")

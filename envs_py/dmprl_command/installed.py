"""Finds which optional parts of dmprl have all they need in this Python."""

from __future__ import annotations

import re
from importlib import metadata
from itertools import zip_longest

REQUIREMENT = re.compile(r"([\w.-]+)\s*(?:\[([^\]]*)\])?([^;]*)")
"""A requirement: name, extras, ranges of versions."""
RANGE = re.compile(r"(>=|<=|<|>)\s*([\d.]+)")
"""A bound of a version. Other conditions are pip's concern and count as fulfilled."""


def has_extra(extra: str, package: str = "dmprl") -> bool:
    """Returns whether an optional part's requirements are installed in permitted versions."""
    try:
        lines = metadata.requires(package) or []
    except metadata.PackageNotFoundError:
        return False
    condition = f"extra == '{extra}'"
    wanted = (line for line in lines if _marker(line) == condition)
    return all(_is_installed(line) for line in wanted)


def _marker(line: str) -> str:
    return line.partition(";")[2].strip().replace('"', "'")


def _is_installed(line: str) -> bool:
    match = REQUIREMENT.match(line)
    if match is None:
        return False
    name, extras, ranges = match.groups()
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    parts = [part.strip() for part in (extras or "").split(",") if part.strip()]
    in_range = all(_fits(version, *bound) for bound in RANGE.findall(ranges))
    return in_range and all(has_extra(part, name) for part in parts)


def _fits(version: str, operator: str, bound: str) -> bool:
    numbers = [[int(number) for number in re.findall(r"\d+", text)] for text in (version, bound)]
    for own, limit in zip_longest(*numbers, fillvalue=0):
        if own != limit:
            return own > limit if operator in (">", ">=") else own < limit
    return operator in (">=", "<=")

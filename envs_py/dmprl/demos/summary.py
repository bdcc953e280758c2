"""Summarises a source of demonstrations, for ``dmprl demos show``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmprl.demos.converting import Conversion, Wishes
from dmprl.demos.source import DemosError, Episode, Source
from dmprl.demos.task import ColumnMapping, Task


class Tally:
    """Figures of episodes, added one after the other."""

    def __init__(self) -> None:
        self.lengths: list[int] = []
        self.returns: list[float] = []
        self.successes: list[bool] = []
        self._ranges: dict[str, NDArray[np.float64]] = {}

    def add(self, episode: Episode) -> None:
        """Adds an episode."""
        self.lengths.append(len(episode.actions))
        if episode.rewards is not None:
            self.returns.append(float(episode.rewards.sum()))
        if episode.success is not None:
            self.successes.append(episode.success)
        for part, rows in (("observation", episode.observations), ("action", episode.actions)):
            if len(rows):
                ends = np.stack([rows.min(axis=0), rows.max(axis=0)])
                before = self._ranges.get(part, ends)
                low, high = np.minimum(before[0], ends[0]), np.maximum(before[1], ends[1])
                self._ranges[part] = np.stack([low, high])

    def part(self, part: str, columns: tuple[str, ...], names: list[str]) -> dict[str, Any]:
        """Describes observation or action."""
        low, high = self._ranges.get(part, np.full((2, len(names)), np.nan))
        known = part in self._ranges
        return {
            "columns": list(columns),
            "length": len(names),
            "names": names,
            "low": low.tolist() if known else [],
            "high": high.tolist() if known else [],
        }


def summarise(source: Source, task: Task | None, wishes: Wishes) -> dict[str, Any]:
    """Returns figures of a source, and the reasons for which it cannot be converted.

    Without a fitting mapping the figures are those of the columns as the format names them.
    """
    found: dict[str, Any] = {
        "source": source.name,
        "format": source.format,
        "rate_hz": source.rate_hz or None,
        "columns": {name: len(names) for name, names in source.columns.items()},
        "other_columns": source.others,
        "task": None if task is None else described(task),
        "notes": [],
        "missing": [],
    }
    missing: list[str] = []
    conversion = None
    for of_task in (task, None) if task is not None else (None,):
        try:
            conversion = Conversion(source, of_task, wishes)
            break
        except DemosError as error:
            missing += str(error).splitlines()
    tally = Tally()
    if conversion is not None:
        try:
            for episode in conversion.checked():
                tally.add(episode)
        except DemosError as error:
            missing.append(str(error))
        if task is not None and task.goals is None and conversion.rewards_from == "none":
            missing.append(str(conversion.missing_rewards()))
        if task is not None and conversion.task is task:
            found["notes"] = conversion.notes()
    found["missing"] = [reason.removeprefix(f"{source.name}: ") for reason in missing]
    if conversion is None:
        return found | {"episodes": source.episode_count}
    return found | figures(tally, conversion.mapping)


def figures(tally: Tally, mapping: ColumnMapping) -> dict[str, Any]:
    """Returns the figures of the episodes that were read."""
    columns = mapping.columns
    returns = tally.returns
    return {
        "episodes": len(tally.lengths),
        "steps": sum(tally.lengths),
        "episode_steps": [min(tally.lengths), max(tally.lengths)] if tally.lengths else None,
        "observation": tally.part("observation", columns.observation, mapping.names),
        "action": tally.part("action", (columns.action,), mapping.action_names),
        "return": {"mean": float(np.mean(returns)), "low": min(returns), "high": max(returns)}
        if returns
        else None,
        "successes": sum(tally.successes) if len(tally.successes) == len(tally.lengths) else None,
    }


def described(task: Task) -> dict[str, Any]:
    """Describes a task."""
    return {
        "id": task.id,
        "observation_len": task.spec["observation_len"],
        "action_len": task.spec["action_len"],
        "rate_hz": task.rate_hz or None,
    }


def text_of(found: dict[str, Any]) -> str:
    """Describes a source for people."""
    lines = [("source", f"{found['source']}, {found['format']}")]
    if "steps" in found:
        lines += episode_lines(found)
    else:
        lines.append(("episodes", str(found["episodes"])))
    rate = f"{found['rate_hz']:g} Hz" if found["rate_hz"] else "unknown"
    lines.append(("rate", rate))
    columns = [f"{name} ({length})" for name, length in found["columns"].items()]
    columns += [f"{name} ({kind}, cannot be read)" for name, kind in found["other_columns"].items()]
    lines.append(("columns", ", ".join(columns)))
    if task := found["task"]:
        rate = f"{task['rate_hz']:g} Hz" if task["rate_hz"] else "unknown rate"
        sizes = f"observation {task['observation_len']}, action {task['action_len']}"
        lines.append(("task", f"{task['id']}: {sizes}, {rate}"))
    lines += [("note", note) for note in found["notes"]]
    lines += [("missing", reason) for reason in found["missing"]]
    if found["task"] and not found["missing"]:
        lines.append(("missing", "nothing"))
    return "\n".join(f"{label:11} {text}" for label, text in lines)


def episode_lines(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Describes the episodes."""
    episodes, of = f"{found['episodes']}, {found['steps']} steps", found["episode_steps"]
    if of is not None:
        episodes += f" ({of[0]} to {of[1]} each)" if of[0] < of[1] else f" ({of[0]} each)"
    lines = [("episodes", episodes)]
    for part in ("observation", "action"):
        it = found[part]
        text = f"{it['length']} entries of {', '.join(it['columns'])}"
        if it["low"]:
            text += f", {min(it['low']):.4g} to {max(it['high']):.4g}"
        lines.append((part, text))
    returns, successes = found["return"], found["successes"]
    if returns is None:
        lines.append(("return", "not recorded"))
    else:
        text = f"{returns['mean']:.2f} on average, {returns['low']:.2f} to {returns['high']:.2f}"
        lines.append(("return", text))
    known = "not recorded" if successes is None else f"{successes} of {found['episodes']}"
    return [*lines, ("success", known)]

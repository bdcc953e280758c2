"""Prints the tables of ``equal-minutes*.csv``, and draws a figure of each, without arguments.

They show the interquartile mean over seeds with a 95 % bootstrap interval. Fewer than four seeds
have a mean, with the range.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

FOLDER = Path(__file__).parent
FILES = ("equal-minutes-two-cores", "equal-minutes")
"""Data, and the names of the figures."""
TASKS = {
    "pusher-v0": "pusher-v0",
    "thrower-v0": "thrower-v0",
    "box-pushing": "box-pushing",
    "panda-push": "panda-push, success",
    "FetchPush-v4": "FetchPush-v4, success",
    "HalfCheetah-v5": "HalfCheetah-v5, mlp",
    "Walker2d-v5": "Walker2d-v5, mlp",
}
"""Tasks and their titles."""
METHODS = {
    "ours": "Ours",
    "before": "Before",
    "sb3-tqc": "TQC",
    "sbx-crossq": "CrossQ",
    "sbx-simba": "SimBa",
}
"""Methods and their names. TQC has hindsight on tasks with goals."""
SEEDS_MIN = 4
"""Seeds from which there is an interquartile mean."""
SAMPLES = 10_000
WIDTH, HEIGHT, COLUMNS = 300, 150, 3
"""Size of a panel with all methods, and panels in a row."""
LEFT, RIGHT, TOP, STEP = 62, 22, 38, 20
"""Margins of a panel, and the height of a row."""
COLOURS, OTHERS = {"ours": "#0072B2", "before": "#D55E00"}, "#777777"


class Result(NamedTuple):
    """A method's result on a task, or the difference of two."""

    middle: float
    low: float
    high: float
    count: int
    drawn: np.ndarray
    """Interquartile means of bootstrap samples; empty for few seeds."""


def iqm(scores: np.ndarray) -> np.ndarray:
    """Returns the means along the last axis, without a quarter of the scores at each end."""
    ordered, count = np.sort(scores, axis=-1), scores.shape[-1]
    cut = count // 4
    return ordered[..., cut : count - cut].mean(axis=-1)


def result(scores: np.ndarray, generator: np.random.Generator) -> Result:
    """Summarises the scores of the seeds."""
    count = len(scores)
    if count < SEEDS_MIN:
        return Result(scores.mean(), scores.min(), scores.max(), count, np.empty(0))
    return bootstrap(float(iqm(scores)), iqm(generator.choice(scores, (SAMPLES, count))), count)


def bootstrap(middle: float, drawn: np.ndarray, count: int) -> Result:
    """Returns a result with the interval of bootstrap samples."""
    low, high = np.quantile(drawn, (0.025, 0.975))
    return Result(middle, float(low), float(high), count, drawn)


def difference(ours: Result, before: Result) -> Result:
    """Returns the difference of two results that have bootstrap samples."""
    return bootstrap(ours.middle - before.middle, ours.drawn - before.drawn, ours.count)


def results(path: Path) -> dict[str, dict[str, Result]]:
    """Reads the results by task and method."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    found: dict[str, dict[str, Result]] = {}
    generator = np.random.default_rng(0)
    for task, title in TASKS.items():
        key = "success_rate" if title.endswith("success") else "return_mean"
        for method in METHODS:
            own = [
                float(row[key])
                for row in rows
                if row["task"] == task and row["method"].removesuffix("-her") == method
            ]
            if own:
                found.setdefault(task, {})[method] = result(np.array(own), generator)
    return found


def shown(value: float, is_success: bool) -> str:
    """Formats a score."""
    if is_success:
        return f"{value:.2f}"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.1f}"


def cell(result: Result, is_success: bool) -> str:
    """Returns a cell of the table."""
    middle, low, high = (shown(value, is_success) for value in result[:3])
    if result.count == 1:
        return middle
    return f"{middle} ({low} to {high}){'' if result.count >= SEEDS_MIN else '*'}"


def table(found: dict[str, dict[str, Result]]) -> Iterator[str]:
    """Yields the table's lines."""
    present = [method for method in METHODS if any(method in methods for methods in found.values())]
    heads = ["Task", *(METHODS[method] for method in present), "Ours less before"]
    yield f"| {' | '.join(heads)} |"
    yield "|---" * len(heads) + "|"
    for task, methods in found.items():
        is_success = TASKS[task].endswith("success")
        cells = [
            cell(methods[method], is_success) if method in methods else "" for method in present
        ]
        ours, before = methods["ours"], methods["before"]
        both = difference(ours, before) if ours.drawn.size and before.drawn.size else None
        cells.append("" if both is None else cell(both, is_success))
        yield f"| {TASKS[task]} | {' | '.join(cells)} |"


def panel(task: str, methods: dict[str, Result]) -> Iterator[str]:
    """Yields a panel's elements. Results far below the others are written at the left edge."""
    near = [methods[name] for name in ("ours", "before", "sb3-tqc") if name in methods]
    low, high = min(each.low for each in near), max(each.high for each in near)
    margin = 0.06 * (high - low)
    low, high = low - margin, high + margin
    is_success = TASKS[task].endswith("success")
    yield f'<text x="{LEFT}" y="20" font-size="13">{TASKS[task]}</text>'
    for row, (method, own) in enumerate(methods.items()):
        y, colour = TOP + STEP * row, COLOURS.get(method, OTHERS)
        yield f'<text x="{LEFT - 8}" y="{y + 4}" text-anchor="end">{METHODS[method]}</text>'
        yield (f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y}" y2="{y}" stroke="#DDDDDD"/>')
        if own.middle < low:
            yield f'<text x="{LEFT + 2}" y="{y + 4}">◂ {shown(own.middle, is_success)}</text>'
            continue
        middle, start, end = (
            LEFT + (max(value, low) - low) / (high - low) * (WIDTH - LEFT - RIGHT)
            for value in own[:3]
        )
        yield (
            f'<line x1="{start:.1f}" x2="{end:.1f}" y1="{y}" y2="{y}" stroke="{colour}" '
            'stroke-width="3"/>'
        )
        yield f'<circle cx="{middle:.1f}" cy="{y}" r="4" fill="{colour}"/>'
    y = TOP + STEP * len(methods)
    for value, anchor, x in ((low, "start", LEFT), (high, "end", WIDTH - RIGHT)):
        yield f'<text x="{x}" y="{y}" text-anchor="{anchor}">{shown(value, is_success)}</text>'


def figure(found: dict[str, dict[str, Result]]) -> str:
    """Returns the figure."""
    panel_height = HEIGHT - STEP * (len(METHODS) - max(len(methods) for methods in found.values()))
    height = panel_height * -(-len(found) // COLUMNS)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH * COLUMNS} {height}" '
        'font-family="sans-serif" font-size="11" fill="#222222">',
        f'<rect width="{WIDTH * COLUMNS}" height="{height}" fill="#FFFFFF"/>',
    ]
    for index, (task, methods) in enumerate(found.items()):
        x, y = WIDTH * (index % COLUMNS), panel_height * (index // COLUMNS)
        elements = "\n".join(panel(task, methods))
        parts.append(f'<g transform="translate({x} {y})">\n{elements}\n</g>')
    return "\n".join([*parts, "</svg>\n"])


def main() -> None:
    """Prints the tables and writes the figures."""
    for name in FILES:
        found = results(FOLDER / f"{name}.csv")
        print("\n".join(table(found)))
        (FOLDER / f"{name}.svg").write_text(figure(found))


if __name__ == "__main__":
    main()

"""Draws ``curves.svg`` from ``update.csv`` and ``workers.csv``, without arguments.

Both axes of each panel are logarithmic. A solid line is measured, a dashed one is how the cost
should grow.
"""

from __future__ import annotations

import csv
from math import log
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).parent
WIDTH, HEIGHT = 300, 230
"""Size of a panel."""
LEFT, RIGHT, TOP, BOTTOM = 52, 16, 34, 42
"""Margins in a panel."""
COLUMNS = 3
MEASURED, EXPECTED, TEXT, GRID = "#0072B2", "#777777", "#222222", "#DDDDDD"
PANELS = {
    "units": "Units in each layer",
    "batch": "Rows of a batch",
    "segment_steps": "Steps of a segment, K",
    "observation_len": "Numbers in an observation",
    "replay_steps": "Steps in the replay",
}


class Panel(NamedTuple):
    """The curves of one quantity."""

    title: str
    unit: str
    values: list[float]
    measured: list[float]
    expected: list[float]


class Axis(NamedTuple):
    """A logarithmic axis from ``low`` to ``high``, drawn between two places."""

    low: float
    high: float
    start: float
    end: float

    def place(self, value: float) -> float:
        """Returns where a value is drawn."""
        share = log(value / self.low) / log(self.high / self.low)
        return self.start + share * (self.end - self.start)


def rows(name: str) -> list[dict[str, str]]:
    """Reads a file of this folder."""
    with (FOLDER / name).open(newline="") as file:
        return list(csv.DictReader(file))


def panels() -> list[Panel]:
    """Reads the panels. The limit is the time of as many products on registers."""
    drawn = []
    for quantity, title in PANELS.items():
        own = [row for row in rows("update.csv") if row["quantity"] == quantity]
        values, measured, limit = (
            [float(row[key]) for row in own] for key in ("value", "ms_per_update", "limit_ms")
        )
        drawn.append(Panel(title, "ms per update", values, measured, limit))
    workers = rows("workers.csv")
    values = [float(row["workers"]) for row in workers]
    measured = [float(row["rollout_steps_per_s"]) / 1000 for row in workers]
    cores = 2
    expected = [measured[0] * min(count, cores) for count in values]
    drawn.append(Panel("Workers on two cores", "1,000 steps/s", values, measured, expected))
    return drawn


def text(x: float, y: float, content: str, anchor: str = "middle", size: int = 11) -> str:
    """Returns a text."""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}">{content}</text>'
    )


def line(
    points: list[tuple[float, float]], colour: str, dashes: str = "none", thickness: int = 2
) -> str:
    """Returns a polyline."""
    joined = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    style = f'stroke="{colour}" stroke-width="{thickness}" stroke-dasharray="{dashes}"'
    return f'<polyline points="{joined}" fill="none" {style}/>'


def short(value: float) -> str:
    """Returns a number as a label."""
    if value >= 1e6:
        return f"{value / 1e6:g} M"
    return f"{value / 1e3:g} k" if value >= 1e4 else f"{value:,g}"


def draw(panel: Panel) -> str:
    """Returns a panel's elements."""
    across = Axis(panel.values[0], panel.values[-1], LEFT, WIDTH - RIGHT)
    costs = panel.measured + panel.expected
    up = Axis(min(costs) / 1.6, max(costs) * 1.6, HEIGHT - BOTTOM, TOP)
    parts = [text(LEFT, 20, panel.title, "start", 13)]
    for tick in (1, 2, 5, 10, 20, 50, 100, 200):
        if up.low <= tick <= up.high:
            y = up.place(tick)
            parts.append(line([(LEFT, y), (WIDTH - RIGHT, y)], GRID, thickness=1))
            parts.append(text(LEFT - 6, y + 4, f"{tick}", "end"))
    for value in panel.values:
        parts.append(text(across.place(value), HEIGHT - BOTTOM + 16, short(value)))
    x, y = 12, (TOP + HEIGHT - BOTTOM) / 2
    rotated = f'<g transform="rotate(-90 {x} {y})">' + text(x, y, panel.unit) + "</g>"
    parts.append(rotated)
    for costs, colour, dashes in (
        (panel.expected, EXPECTED, "5 4"),
        (panel.measured, MEASURED, "none"),
    ):
        points = [
            (across.place(value), up.place(cost))
            for value, cost in zip(panel.values, costs, strict=True)
        ]
        parts.append(line(points, colour, dashes))
        if colour == MEASURED:
            dot = f'r="3" fill="{colour}"'
            parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" {dot}/>' for x, y in points]
    return "\n".join(parts)


def main() -> None:
    """Writes the figure."""
    drawn = panels()
    height = HEIGHT * -(-len(drawn) // COLUMNS) + 26
    width = WIDTH * COLUMNS
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'font-family="sans-serif" fill="{TEXT}">',
        f'<rect width="{width}" height="{height}" fill="#FFFFFF"/>',
    ]
    for index, panel in enumerate(drawn):
        x, y = WIDTH * (index % COLUMNS), HEIGHT * (index // COLUMNS)
        parts.append(f'<g transform="translate({x} {y})">\n{draw(panel)}\n</g>')
    y = height - 12
    parts += [
        line([(LEFT, y), (LEFT + 30, y)], MEASURED),
        text(LEFT + 36, y + 4, "measured", "start"),
        line([(LEFT + 120, y), (LEFT + 150, y)], EXPECTED, "5 4"),
        text(LEFT + 156, y + 4, "expected: the time of the products alone, or the cores", "start"),
        "</svg>\n",
    ]
    (FOLDER / "curves.svg").write_text("\n".join(parts))


if __name__ == "__main__":
    main()

"""Draws curves.svg from the evaluations in this folder: ``python curves.py``; needs matplotlib."""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

FOLDER = Path(__file__).parent
PANELS = [
    ("FetchPush-v4", "imitation.csv", "FetchPush-v1"),
    ("panda-push", "imitation.csv", "PandaPush-v1"),
    ("FetchPickAndPlace-v4", "imitation.csv", "FetchPickAndPlace-v1"),
    ("panda-pick-and-place", "imitation.csv", "PandaPickAndPlace-v1"),
    ("FetchSlide-v4", "fetch-slide-layer-norm.csv", "FetchSlide-v1"),
    ("panda-slide", "panda-slide-discount.csv", "PandaSlide-v1"),
    ("panda-stack", "imitation.csv", None),
]
"""Our task, its file, and the task of TQC's published run."""
OURS, TQC = "#0072b2", "#d55e00"


def curves(file: str, task: str) -> list[np.ndarray]:
    """Returns for each seed of a task its steps in thousands and its success rates."""
    seeds: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
    with (FOLDER / file).open(encoding="utf-8") as lines:
        for row in csv.DictReader(lines):
            if row["task"] == task:
                point = (float(row["env_steps"]) / 1000, float(row["success_rate"]))
                seeds[row.get("seed", "")].append(point)
    return [np.array([(0.0, 0.0), *points]).T for points in seeds.values()]


def main() -> None:
    """Draws a panel for each task."""
    # The same picture from the same data.
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "curves", "font.size": 9})
    figure, axes = plt.subplots(2, 4, figsize=(12, 5.2), sharey=True, layout="constrained")
    for axis, (task, file, published) in zip(axes.flat, PANELS, strict=False):
        seeds = curves(file, task)
        end = max(steps[-1] for steps, _ in seeds)
        for steps, rates in seeds:
            axis.plot(steps, rates, color=OURS, linewidth=1.2, alpha=0.7)
        if published:
            for steps, rates in curves("rl-zoo-tqc-her.csv", published):
                axis.plot(steps, rates, color=TQC, linewidth=1.6, linestyle="--")
        axis.set(title=task, xlim=(0, max(end, 300)), ylim=(0, 1.02))
        axis.grid(color="#dddddd", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    figure.supxlabel("environment steps, in thousands")
    figure.supylabel("success rate")
    legend = axes.flat[-1]
    legend.axis("off")
    legend.plot([], [], color=OURS, label="TD3-DMP, each seed")
    legend.plot([], [], color=TQC, linestyle="--", label="TQC with hindsight, published run")
    legend.legend(loc="center", frameon=False)
    figure.savefig(FOLDER / "curves.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()

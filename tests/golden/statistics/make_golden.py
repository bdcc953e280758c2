"""Writes golden.json: interquartile means and their intervals by the package rliable.

Run by hand in an environment of its own (requirements.txt); the test that reads the file is in
deploy/analysis/src/report/statistics.rs.
"""

import json
import sys
from pathlib import Path

import numpy as np
from rliable import library, metrics

REPETITIONS = 50_000


def main() -> None:
    """Draws score matrices of several shapes and lets rliable judge them."""
    random = np.random.default_rng(7)
    cases = []
    for runs, tasks in [(3, 1), (5, 1), (5, 5), (10, 3), (7, 2)]:
        # Skewed, and of another scale in each task.
        scores = random.gamma(2.0, 1.0, size=(runs, tasks)) * np.arange(1, tasks + 1)
        scores = np.round(scores, 4)
        points, intervals = library.get_interval_estimates(
            {"method": scores},
            lambda matrix: np.array([metrics.aggregate_iqm(matrix)]),
            reps=REPETITIONS,
            random_state=np.random.RandomState(3),
        )
        cases.append(
            {
                # One list of runs a task.
                "scores": scores.T.tolist(),
                "interquartile_mean": float(points["method"][0]),
                "interval": [float(bound[0]) for bound in intervals["method"]],
            }
        )
    golden = {
        "made_by": f"rliable 1.2.0, numpy {np.__version__}, Python {sys.version.split()[0]}",
        "repetitions": REPETITIONS,
        "cases": cases,
    }
    Path(__file__).with_name("golden.json").write_text(json.dumps(golden, indent=1) + "\n")


if __name__ == "__main__":
    main()

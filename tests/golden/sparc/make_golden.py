"""Writes golden.json: spectral arc lengths of speed profiles by the package monalysa.

Its authors are those of the measure (Balasubramanian et al. 2015). Run by hand in an environment of
its own (requirements.txt). deploy/analysis/src/motion/smoothness.rs reads the file.
"""

import json
import sys
from pathlib import Path

import numpy as np
from monalysa.quality.smoothness import sparc


def profiles() -> list[tuple[float, np.ndarray]]:
    """Rates [Hz] and speeds: smooth, of several submovements, trembling, short, cut off."""
    random = np.random.default_rng(11)
    cases = []
    for rate, length in [(50.0, 51), (25.0, 51), (20.0, 101), (100.0, 200), (15.0, 64), (8.0, 30)]:
        time = np.arange(length) / rate
        middle, width = time[-1] / 2, time[-1] / 8
        bell = np.exp(-0.5 * ((time - middle) / width) ** 2)
        several = bell + 0.7 * np.exp(-0.5 * ((time - 0.9 * time[-1]) / (width / 3)) ** 2)
        trembling = np.abs(several + 0.15 * random.standard_normal(length))
        braking = np.maximum(0.0, 1.0 - time / time[-1])
        cases += [(rate, speed) for speed in (bell, several, trembling, braking)]
    cases += [(50.0, np.array([0.0, 1.0, 0.0])), (50.0, np.ones(16)), (50.0, np.array([1.0, 2.0]))]
    return cases


def main() -> None:
    """Lets the package judge them, with its own parameters but at most the Nyquist frequency."""
    cases = []
    for rate, speed in profiles():
        speed = np.round(speed, 6)
        length, _, _ = sparc(speed, rate, padlevel=4, fc=min(10.0, rate / 2), amp_th=0.05)
        cases.append({"rate_hz": rate, "speed": speed.tolist(), "sparc": float(length)})
    golden = {
        "made_by": f"monalysa 0.2.1, numpy {np.__version__}, Python {sys.version.split()[0]}",
        "cases": cases,
    }
    Path(__file__).with_name("golden.json").write_text(json.dumps(golden) + "\n")


if __name__ == "__main__":
    main()

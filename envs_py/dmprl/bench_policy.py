"""Python peers of ``dmprl bench policy``, which make the same decisions one at a time.

``python -m dmprl.bench_policy KIND FILE`` writes one JSON object per line. The first is
``{"ready": "description"}``, or ``{"absent": "reason"}`` if the peer is unavailable. Each line
``run CALLS`` on standard input is then answered by ``{"us": […]}``, the microseconds of each call.
The process exits at the end of its input, and thus with the program that started it.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

OBSERVATIONS = 256
"""Number of different observations, used in turn."""


class AbsentError(Exception):
    """Raised if a peer is unavailable. The message gives the reason."""


def numpy_policy(path: Path) -> tuple[str, Callable[[np.ndarray], object], int]:
    """Loads ``dmprl.Policy``."""
    from dmprl import Policy

    policy = Policy.load(path)
    return f"NumPy {np.__version__}", policy.segment, policy.spec["observation_len"]


def onnx_policy(path: Path) -> tuple[str, Callable[[np.ndarray], object], int]:
    """Loads the graph in onnxruntime with one thread."""
    try:
        import onnxruntime
    except ImportError as error:
        raise AbsentError(f"{error}; dmprl env add onnxruntime") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options)
    shapes = {entry.name: entry.shape for entry in session.get_inputs()}
    state = {"state": np.zeros((1, shapes["state"][1]), np.float32)} if "state" in shapes else {}

    def decide(observation: np.ndarray) -> object:
        return session.run(None, {"observation": observation[None].astype(np.float32), **state})

    return f"onnxruntime {onnxruntime.__version__}", decide, shapes["observation"][1]


def main() -> None:
    """Answers requests until the end of the input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=("numpy", "onnx"))
    parser.add_argument("file", type=Path)
    arguments = parser.parse_args()
    make = numpy_policy if arguments.kind == "numpy" else onnx_policy
    try:
        name, decide, observation_len = make(arguments.file)
    except AbsentError as error:
        print(json.dumps({"absent": str(error)}), flush=True)
        return
    rows = np.random.default_rng(1).standard_normal((OBSERVATIONS, observation_len))
    print(json.dumps({"ready": name}), flush=True)
    for line in sys.stdin:
        calls = int(line.removeprefix("run "))
        took = np.empty(calls)
        for call in range(calls):
            row = rows[call % OBSERVATIONS]
            begun = time.perf_counter()
            decide(row)
            took[call] = time.perf_counter() - begun
        print(json.dumps({"us": np.round(took * 1e6, 3).tolist()}), flush=True)


if __name__ == "__main__":
    main()

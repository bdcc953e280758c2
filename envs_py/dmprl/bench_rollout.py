"""Peers of ``dmprl bench rollout``: one process of this module for each worker.

``python -m dmprl.bench_rollout KIND --plan FILE --index I`` writes one JSON object per line. The
first is ``{"ready": "description"}``, or ``{"absent": "reason"}`` if the peer is unavailable. Each
line ``run SECONDS`` on standard input is then answered by
``{"steps": …, "seconds": …, "cpu_s": …}``. The process exits at the end of its input, and thus with
the program that started it.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from dmprl import python_path
from dmprl.bench_peers import AbsentError, EnvPoolLoop, GymnasiumLoop, PandaGymLoop
from dmprl.bench_physics import Ceiling, PlainMujoco

SETTLE_S = 0.1
"""Warm-up time before the measurement, for caches and clock frequency [s]."""

KINDS = {
    "mujoco": PlainMujoco,
    "ceiling": Ceiling,
    "gymnasium": GymnasiumLoop,
    "envpool": EnvPoolLoop,
    "panda_gym": PandaGymLoop,
}


def run_for(segment: Callable[[], int], seconds: float) -> dict:
    """Runs whole segments for ``seconds``; returns the steps and the time that they took."""
    clock = time.perf_counter
    end = clock() + SETTLE_S
    while clock() < end:
        segment()
    steps, start, cpu_s = 0, clock(), time.process_time()
    end = start + seconds
    now = start
    while now < end:
        steps += segment()
        now = clock()
    return {"steps": steps, "seconds": now - start, "cpu_s": time.process_time() - cpu_s}


def main() -> None:
    """Answers requests, as described in the module's docstring."""
    parser = argparse.ArgumentParser(prog="dmprl.bench_rollout")
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--plan", type=Path, required=True)
    parser.add_argument("--index", type=int, required=True)
    arguments = parser.parse_args()
    # Ctrl-C reaches the whole process group; the program that started this one handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Environments may print; only answers may reach the caller.
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    plan = json.loads(arguments.plan.read_text())
    python_path.extend(plan["task"]["python_path"])
    try:
        peer = KINDS[arguments.kind](plan, plan["seed"] + plan["env_count"] * arguments.index)
    except AbsentError as error:
        print(json.dumps({"absent": str(error)}), file=lines)
        return
    print(json.dumps({"ready": peer.about}), file=lines)
    for line in sys.stdin:
        command, _, seconds = line.partition(" ")
        if command != "run":
            raise SystemExit(f"expected `run SECONDS`, got {line!r}")
        print(json.dumps(run_for(peer.segment, float(seconds))), file=lines)


if __name__ == "__main__":
    main()

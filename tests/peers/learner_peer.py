"""The peer of ``dmprl bench learner``: the same update in PyTorch or JAX.

``python learner_peer.py torch|torch-compile|jax --settings FILE --threads N`` writes one JSON
object a line. The first is ``{"ready": "description"}``, or ``{"absent": "why"}`` if it cannot;
then each line ``run SECONDS`` on standard input is answered by
``{"updates": …, "seconds": …, "cpu_s": …}``. It ends with its input, so the death of the program
that started it ends it too.

The networks, their inputs and the batch have the sizes of dmprl's own; batches lie ready in memory,
where dmprl samples them from a replay.
"""

import argparse
import importlib
import json
import os
import signal
import sys
import time
from pathlib import Path

# PyTorch's peer is the implementation that made the golden updates: one truth.
sys.path.append(str(Path(__file__).parents[1] / "golden" / "update"))

SETTLE_S = (
    0.1  # run before the clock starts: caches and clock frequency are then those of long runs
)
MAKERS = {
    "torch": ("torch_update", "make"),
    "torch-compile": ("torch_update", "make_compiled"),
    "jax": ("jax_update", "make"),
}


def confine(threads):
    """Leaves this process as many cores as it may have threads; before anything starts threads.

    JAX has no setting that keeps its compiler's and its arrays' threads to one.
    """
    for name in ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"]:
        os.environ[name] = str(threads)
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[-threads:])


def run_for(update, seconds):
    """Updates for so long; whole updates, and the time that they really took."""
    clock = time.perf_counter
    end = clock() + SETTLE_S
    while clock() < end:
        update()
    updates, start, cpu_s = 0, clock(), time.process_time()
    now, end = start, start + seconds
    while now < end:
        update()
        updates += 1
        now = clock()
    return {"updates": updates, "seconds": now - start, "cpu_s": time.process_time() - cpu_s}


def main():
    """Speaks the protocol of the module's first lines."""
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=MAKERS)
    parser.add_argument("--settings", type=Path, required=True)
    parser.add_argument("--threads", type=int, required=True)
    arguments = parser.parse_args()
    # Ctrl-C reaches the whole process group; the program that reads our lines decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Output of a library must not become a line of the protocol.
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    confine(arguments.threads)
    try:
        from settings import Settings

        module, maker = MAKERS[arguments.kind]
        settings = Settings.from_dict(json.loads(arguments.settings.read_text()))
        make = getattr(importlib.import_module(module), maker)
        update, about = make(settings, arguments.threads)
    except ImportError as error:
        why = f"{sys.executable} cannot import {error.name} ({error}); name an interpreter that has"
        print(json.dumps({"absent": f"{why} it with --peer-python"}), file=lines)
        return
    print(json.dumps({"ready": about}), file=lines)
    for line in sys.stdin:
        command, _, seconds = line.partition(" ")
        if command != "run":
            raise SystemExit(f"expected `run SECONDS`, got {line!r}")
        print(json.dumps(run_for(update, float(seconds))), file=lines)


if __name__ == "__main__":
    main()

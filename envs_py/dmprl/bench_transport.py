"""Python peers of ``dmprl bench transport``: a queue between two processes.

``python -m dmprl.bench_transport KIND --segment-bytes N --folder DIR`` writes one JSON object per
line. The first is ``{"ready": "description"}``, or ``{"absent": "reason"}`` if the peer is
unavailable. Each line ``run SECONDS`` on standard input is then answered by
``{"segments": …, "seconds": …}``. The process and its sender exit at the end of its input, and thus
with the program that started it.

A segment is ``bytes`` of the given size. The sender sends it as fast as the queue accepts it, and
sleeps while the queue is full. The receiver only checks its length.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

SETTLE_S = 0.1
"""Warm-up time before the measurement, in which the queue drains [s]."""
QUEUE_SEGMENTS = 512
"""Capacity of the queue, equal to that of dmprl's."""
PARENT_POLL_S = 0.05
"""Interval between checks whether the receiver is alive [s]."""
CONTEXT = get_context("fork")
"""Other start methods create named semaphores, which a killed process leaves behind."""
RECEIVE_S = 20.0
"""Time without a segment after which the sender is assumed dead [s]."""


class AbsentError(Exception):
    """Raised if a peer is unavailable. The message gives the reason."""


def end_with(parent: int) -> None:
    """Starts a thread that ends this process when its parent has ended."""

    def poll() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_POLL_S)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=poll, daemon=True).start()


def start_sender(send: Callable[..., None], target: Any, payload: bytes) -> Any:
    """Starts the sender's process."""
    sender = CONTEXT.Process(target=send, args=(target, payload, os.getpid()), daemon=True)
    sender.start()
    return sender


def put_all(queue: Any, payload: bytes, parent: int) -> None:
    """Sends forever through a queue of ``multiprocessing``."""
    end_with(parent)
    while True:
        queue.put(payload)


def push_all(address: str, payload: bytes, parent: int) -> None:
    """Sends forever through ZeroMQ."""
    import zmq

    end_with(parent)
    socket = zmq.Context().socket(zmq.PUSH)
    socket.set_hwm(QUEUE_SEGMENTS)
    socket.connect(address)
    while True:
        socket.send(payload)


class MultiprocessingQueue:
    """``multiprocessing.Queue``, in which a thread of the sender pickles into a pipe."""

    about = "multiprocessing.Queue of bytes, same capacity as dmprl; not checked or acknowledged"

    def __init__(self, segment_bytes: int, folder: Path) -> None:
        self._queue = CONTEXT.Queue(QUEUE_SEGMENTS)
        self.sender = start_sender(put_all, self._queue, os.urandom(segment_bytes))

    def receive(self) -> bytes:
        """Returns the next segment."""
        return self._queue.get(timeout=RECEIVE_S)


class ZeroMq:
    """A PUSH and a PULL socket over a Unix socket."""

    def __init__(self, segment_bytes: int, folder: Path) -> None:
        try:
            import zmq
        except ImportError as error:
            reason = f"pyzmq is not installed in {sys.executable} ({error})"
            raise AbsentError(reason) from None
        self.about = (
            f"ZeroMQ {zmq.zmq_version()} with pyzmq {zmq.__version__}, PUSH to PULL over ipc://, "
            f"same capacity as dmprl; not checked or acknowledged"
        )
        address = f"ipc://{folder}/zeromq-{segment_bytes}"
        # Forks before this process has a context, because a fork does not copy its threads.
        self.sender = start_sender(push_all, address, os.urandom(segment_bytes))
        self._socket = zmq.Context().socket(zmq.PULL)
        self._socket.set_hwm(QUEUE_SEGMENTS)
        self._socket.setsockopt(zmq.RCVTIMEO, int(1000 * RECEIVE_S))
        self._socket.bind(address)

    def receive(self) -> bytes:
        """Returns the next segment."""
        return self._socket.recv()


KINDS = {"multiprocessing_queue": MultiprocessingQueue, "zeromq": ZeroMq}


def run_for(receive: Callable[[], bytes], segment_bytes: int, seconds: float) -> dict:
    """Receives for ``seconds``; returns the segments and the time that they took."""
    clock = time.perf_counter
    end = clock() + SETTLE_S
    while clock() < end:
        receive()
    segments, start = 0, clock()
    end = start + seconds
    now = start
    while now < end:
        got = len(receive())
        if got != segment_bytes:
            raise SystemExit(f"expected {segment_bytes} bytes, got {got}")
        segments += 1
        now = clock()
    return {"segments": segments, "seconds": now - start}


def main() -> None:
    """Answers requests, as described in the module's docstring."""
    parser = argparse.ArgumentParser(prog="dmprl.bench_transport")
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--segment-bytes", type=int, required=True)
    parser.add_argument("--folder", type=Path, required=True)
    arguments = parser.parse_args()
    # Ctrl-C reaches the whole process group; the program that started this one handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        peer = KINDS[arguments.kind](arguments.segment_bytes, arguments.folder)
        peer.receive()
    except AbsentError as error:
        print(json.dumps({"absent": str(error)}), flush=True)
        return
    print(json.dumps({"ready": peer.about}), flush=True)
    for line in sys.stdin:
        command, _, seconds = line.partition(" ")
        if command != "run":
            raise SystemExit(f"expected `run SECONDS`, got {line!r}")
        measured = run_for(peer.receive, arguments.segment_bytes, float(seconds))
        print(json.dumps(measured), flush=True)
    peer.sender.kill()


if __name__ == "__main__":
    main()

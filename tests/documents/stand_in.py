"""`cargo` and `dmprl` for the code blocks of README and the book, as a test runs these.

    stand_in.py cargo run --release -- train reacher --steps 60000
    stand_in.py dmprl eval runs/mine

It runs the program itself, but a fiftieth of the steps, few rounds of a benchmark, a sweep without
its runs, a page only until it can be opened, and a stand-in for the Hugging Face hub. Everything
else is done as it is written.
"""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

STEPS_SHARE = 50
STEPS = 400
"""Environment steps of a training whose block gives none."""
WAIT_S = 100.0
"""Limit for a page or a run to start [s]."""
POLL_S = 0.02
INTERRUPTED = 130
"""Exit status after Ctrl-C."""
SERVERS = ("dashboard", "play")
PICTURES = ("play", "record")
OF_A_HUB = ("push", "pull")
FEW = {
    "chaos": {"--seconds": "1", "--worker-kills": "1", "--learner-kills": "1"},
    "eval": {"--episodes": "2"},
    "record": {"--episodes": "1"},
}
"""Values for flags that cost time, where a block has them or their default."""
FEW_OF_BENCH = {
    "rollout": {"--rounds": "1", "--seconds": "0.2"},
    "learner": {"--rounds": "1", "--seconds": "0.05"},
    "transport": {"--rounds": "1", "--seconds": "0.05"},
    "policy": {"--rounds": "1", "--calls": "20"},
    "system": {"--seconds": "0.2"},
    "scale": {
        "--seconds": "0.1",
        "--cost-seconds": "0.1",
        "--check-seconds": "0.1",
        "--check-workers": "1",
        "--synthetic-workers": "8",
    },
}
"""The same for each benchmark."""

PROGRAM = os.environ["STAND_IN_PROGRAM"]
PROJECT = Path(os.environ["STAND_IN_PROJECT"])


def main(words):
    """Runs one command line; returns its exit status."""
    called, *words = words
    if called == "cargo":
        if words[:3] != ["run", "--release", "--"]:
            return cargo(" ".join(["cargo", *words]))
        words = words[3:]
    command = words[0]
    if command in PICTURES and "STAND_IN_CANNOT_DRAW" in os.environ:
        print(f"skipped: no OpenGL for dmprl {command}", file=sys.stderr)
        return 0
    if command in SERVERS:
        if command == "play" and "--stream" not in words:
            words = [*words, "--stream"]
        return serve([*words, "--port", "0"])
    if command in OF_A_HUB:
        hub = [sys.executable, str(PROJECT / "envs_py/tests_extras/hub_stand_in.py")]
        words = [*hub, "--root", "hub", "--around", PROGRAM, *words]
        return subprocess.run(words, check=False).returncode
    if words[:2] == ["actor", "--join"]:
        return join(words[2])
    return subprocess.run([PROGRAM, *cheap(words)], check=False).returncode


def cargo(line):
    """Checks the cargo command line of a block, without building or testing again."""
    if line in (PROJECT / ".ci/run").read_text().splitlines():
        return 0
    test = re.fullmatch(r"cargo test --release --test (\w+)", line)
    places = [PROJECT / f"{crate}/tests" for crate in ("tests", "deploy", "learner", "shared")]
    names = [f"{test[1]}.rs", f"{test[1]}/main.rs"] if test else []
    if any((place / name).is_file() for place in places for name in names):
        return 0
    print(f"`{line}` is not in .ci/run and names no test", file=sys.stderr)
    return 1


def cheap(words):
    """The command line, with less to do."""
    command = words[0]
    if command in ("train", "resume"):
        steps = flag(words, "--steps")
        if steps is not None:
            words = replaced(words, "--steps", str(max(int(steps) // STEPS_SHARE, 1)))
        elif command == "train":
            words = [*words, "--steps", str(STEPS)]
    if command == "train" and "ndp" not in words:
        words = [*words, "--set", "exploration.warm_up_steps=40"]
    if command == "sweep" and "--dry-run" not in words:
        words = [*words, "--dry-run"]
    few = FEW_OF_BENCH[words[1]] if command == "bench" else FEW.get(command, {})
    for name, value in few.items():
        words = replaced(words, name, value)
    return words


def flag(words, name):
    """Returns a flag's value, or None."""
    return words[words.index(name) + 1] if name in words else None


def replaced(words, name, value):
    """Returns the words with another value for a flag."""
    if name in words:
        at = words.index(name)
        words = words[:at] + words[at + 2 :]
    return [*words, name, value]


def serve(words):
    """Starts a command that runs until Ctrl-C, and stops it once it has printed an address."""
    server = subprocess.Popen([PROGRAM, *words], stdout=subprocess.PIPE, encoding="utf-8")
    # The program limits everything before this line itself.
    line = server.stdout.readline()
    server.send_signal(signal.SIGINT)
    server.communicate(timeout=WAIT_S)
    if "http://127.0.0.1:" not in line:
        print(f"{words} printed no address but {line!r}", file=sys.stderr)
        return 1
    return 0 if server.returncode in (0, INTERRUPTED) else 1


def join(run):
    """Joins a running run in place of the named one, and leaves it."""
    run = f"{run}-joined"
    trained = [PROGRAM, "train", "reacher", "--run-dir", run, "--steps", str(10**9)]
    training = subprocess.Popen(trained, stderr=subprocess.DEVNULL)
    try:
        until(lambda: Path(run, "processes.json").is_file(), "a run to join")
        joined, said = joined_worker(run)
        joined.send_signal(signal.SIGINT)
        joined.communicate(timeout=WAIT_S)
        # Ctrl-C makes it deliver its segments and end.
        return 0 if said and joined.returncode == INTERRUPTED else 1
    finally:
        training.send_signal(signal.SIGINT)
        training.wait(WAIT_S)


def joined_worker(run):
    """Starts a worker until the run accepts it; returns it and its line, empty if it may not join.

    A run refuses workers for a moment after it has written `processes.json`.
    """
    deadline = time.monotonic() + WAIT_S
    while True:
        words = [PROGRAM, "actor", "--join", run]
        joined = subprocess.Popen(words, stderr=subprocess.PIPE, encoding="utf-8")
        said = joined.stderr.readline()
        while said and not re.match(r"joined .+ as actor-\d+", said):
            said = joined.stderr.readline()
        if said or time.monotonic() > deadline:
            return joined, said
        joined.wait(WAIT_S)
        time.sleep(POLL_S)


def until(condition, what):
    """Waits for a condition.

    :raises TimeoutError: it does not come about.
    """
    deadline = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited {WAIT_S} s for {what}")
        time.sleep(POLL_S)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

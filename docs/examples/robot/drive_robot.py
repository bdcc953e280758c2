"""Drives a robot at control rate with a trained policy, through Gymnasium's interface.

robo-gym, panda_robot and others offer ``reset()`` and ``step(action)``. To use one of them, replace
the class ``RemoteRobot`` below. This example drives a simulated robot over the network::

    dmprl export runs/mine --output panda.safetensors --hold zero-velocity
    python stand_in_robot.py dmprl/PandaReachJoints-v0 --hold zero-velocity --timeout 0.5 &
    python drive_robot.py panda.safetensors --hz 20 --rate 0.2

The robot's computer needs only NumPy, the package ``dmprl`` and this file. SIGINT, SIGTERM, SIGHUP
and errors end the drive with the hold. The exit status is 1 if the robot did not get the hold, and
128 plus the signal's number after a signal.
"""

import argparse
import contextlib
import json
import signal
import socket
import sys
import time
from collections.abc import Iterator

import numpy as np

import dmprl

STEPS_MAX = 1_000
"""Limit of an episode whose task has no time limit."""
LINK_TIMEOUT_S = 5.0
"""Longest wait for a connection, a reset, and for room to send a command [s]."""
DEADLINE_STEPS = 5
"""Default of ``--deadline``, in control steps."""


class RemoteRobot:
    """Client of ``stand_in_robot.py`` with Gymnasium's ``reset`` and ``step``.

    The observation of a step is None if the robot does not answer within ``patience_s``.
    """

    def __init__(self, host: str, port: int, patience_s: float) -> None:
        self._socket = socket.create_connection((host, port), timeout=LINK_TIMEOUT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._patience_s = patience_s
        self._received = b""
        self._number = 0

    def reset(self, seed: int) -> tuple[np.ndarray, dict]:
        """Starts an episode."""
        answer = self._ask({"reset": seed}, LINK_TIMEOUT_S)
        if answer is None:
            raise TimeoutError("the robot does not answer a reset")
        return np.array(answer["observation"]), answer["info"]

    def step(self, action: np.ndarray) -> tuple[np.ndarray | None, float, bool, bool, dict]:
        """Runs one control step."""
        answer = self._ask({"action": action.tolist()}, self._patience_s)
        if answer is None:
            return None, 0.0, False, False, {}
        observation = np.array(answer["observation"])
        done = answer["terminated"], answer["truncated"]
        return observation, answer["reward"], *done, answer["info"]

    def _ask(self, message: dict, patience_s: float) -> dict | None:
        self._send(message)
        deadline = time.monotonic() + patience_s
        while (left := deadline - time.monotonic()) > 0.0:
            self._socket.settimeout(left)
            try:
                received = self._socket.recv(65536)
            except TimeoutError:
                break
            if not received:
                raise ConnectionError("the robot has hung up")
            *lines, self._received = (self._received + received).split(b"\n")
            # Answers to earlier steps came too late and are dropped.
            answers = [json.loads(line) for line in lines]
            if answers and answers[-1]["number"] == self._number:
                return answers[-1]
        return None

    def _send(self, message: dict) -> None:
        self._number += 1
        line = json.dumps({**message, "number": self._number})
        self._socket.settimeout(LINK_TIMEOUT_S)
        self._socket.sendall(line.encode() + b"\n")


class Pace:
    """Control steps of 1 / ``hz`` seconds; 0: as fast as the robot answers."""

    def __init__(self, hz: float) -> None:
        self._step_s = 1.0 / hz if hz > 0.0 else None
        self._due = time.monotonic()

    def wait(self) -> bool:
        """Waits for the end of the control step. Returns whether it was late."""
        if self._step_s is None:
            return False
        now = time.monotonic()
        late = self._due + self._step_s < now
        # After a stall the schedule restarts: missed steps are not caught up.
        self._due = max(self._due + self._step_s, now)
        time.sleep(self._due - now)
        return late


@contextlib.contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Collects the numbers of signals that ask to stop.

    They raise no exception, which could cut a command in two, and do not interrupt the hold.
    """
    received: list[int] = []
    before = {}
    for stop in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        before[stop] = signal.signal(stop, lambda number, _: received.append(number))
    try:
        yield received
    finally:
        for stop, handler in before.items():
            signal.signal(stop, handler)


def drive(policy: dmprl.Policy, robot: RemoteRobot, seed: int, hz: float) -> dict:
    """Runs one episode.

    The last commands lead to the hold, and the last one is the hold: also after a signal or an
    error. Only a link that is down prevents this; then the robot's controller must hold the robot.
    """
    result = {
        "return": 0.0,
        "steps": 0,
        "held_steps": [],
        "frozen_steps": [],
        "late": 0,
        "is_success": False,
        "signal": None,
        "hold_steps": 0,
        "hold_answered": False,
        "error": None,
    }
    with stop_signals() as stopped:
        try:
            policy.reset()
            observation, _ = robot.reset(seed)
            pace = Pace(hz)
            try:
                control_steps(policy, robot, observation, pace, stopped, result)
            finally:

                def send(action: np.ndarray) -> None:
                    result["hold_answered"] = robot.step(action)[0] is not None
                    pace.wait()

                result["hold_steps"] = policy.hold_until_reached(send)
        except OSError as error:
            result["hold_answered"] = False
            result["error"] = f"the link to the robot failed: {error!r}"
        result["signal"] = stopped[0] if stopped else None
    return result


def control_steps(
    policy: dmprl.Policy,
    robot: RemoteRobot,
    observation: np.ndarray | None,
    pace: Pace,
    stopped: list[int],
    result: dict,
) -> None:
    """Runs an episode's control steps, until its end or a signal."""
    steps_max = policy.spec["episode_steps"] or STEPS_MAX
    while result["steps"] < steps_max and not stopped:
        step = result["steps"] + 1
        try:
            action = policy.action(observation)
            if policy.is_holding and observation is not None:
                print(f"step {step}: this program was frozen; holding", file=sys.stderr)
                result["frozen_steps"].append(step)
        except ValueError as error:
            print(f"step {step}: {error}", file=sys.stderr)
            action = policy.hold()
        observation, reward, terminated, truncated, info = robot.step(action)
        result["return"] += reward
        result["steps"] = step
        if policy.is_holding:
            result["held_steps"].append(step)
        result["is_success"] = info.get("is_success", result["is_success"])
        if terminated or truncated:
            break
        result["late"] += pace.wait()


def main() -> int:
    """Runs an episode, prints the result as JSON, and returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", help="a policy file or a run directory")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5555)
    parser.add_argument("--hz", type=float, default=20.0, help="control rate [Hz]; 0: no limit")
    parser.add_argument("--patience", type=float, help="maximum wait for an answer [s]")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--rate", type=float, help="maximum change of an action per step")
    parser.add_argument(
        "--hold",
        help="command that holds the robot: zero-velocity, zero-torque or position=V,V,… [default: "
        "the policy file's]",
    )
    parser.add_argument(
        "--deadline",
        type=float,
        help="maximum time between two control steps, after which this program was frozen and the "
        f"robot is held [s] [default: --patience and {DEADLINE_STEPS} steps; none with --hz 0]",
    )
    arguments = parser.parse_args()
    policy = dmprl.Policy.load(arguments.policy)
    step_s = 1.0 / arguments.hz if arguments.hz > 0.0 else None
    patience_s = arguments.patience or step_s or 1.0
    deadline_s = arguments.deadline
    if deadline_s is None and step_s is not None:
        deadline_s = patience_s + DEADLINE_STEPS * step_s
    try:
        hold = None if arguments.hold is None else dmprl.Hold.parse(arguments.hold)
        policy.limit(rate=arguments.rate, hold=hold, deadline_s=deadline_s)
    except (dmprl.NoHoldError, ValueError) as error:
        parser.error(f"{error}")
    robot = RemoteRobot(arguments.host, arguments.port, patience_s)
    result = drive(policy, robot, arguments.seed, arguments.hz)
    print(json.dumps(result))
    if not result["hold_answered"]:
        return 1
    return 0 if result["signal"] is None else 128 + result["signal"]


if __name__ == "__main__":
    sys.exit(main())

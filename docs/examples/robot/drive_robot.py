"""Drives a robot at control rate with a trained policy, through Gymnasium's interface.

robo-gym, panda_robot and others offer ``reset()`` and ``step(action)``. To use one of them, replace
the class ``RemoteRobot`` below. This example drives a simulated robot over the network::

    dmprl export runs/mine --output panda.safetensors
    python stand_in_robot.py dmprl/PandaReachJoints-v0 &
    python drive_robot.py panda.safetensors --hz 20

The robot's computer needs only NumPy, the package ``dmprl`` and this file.
"""

import argparse
import json
import socket
import sys
import time

import numpy as np

import dmprl

STEPS_MAX = 1_000
"""Limit of an episode whose task has no time limit."""


class RemoteRobot:
    """Client of ``stand_in_robot.py`` with Gymnasium's ``reset`` and ``step``.

    The observation of a step is None if the robot does not answer within ``patience_s``.
    """

    def __init__(self, host: str, port: int, patience_s: float) -> None:
        self._socket = socket.create_connection((host, port), timeout=5.0)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._patience_s = patience_s
        self._received = b""
        self._number = 0

    def reset(self, seed: int) -> tuple[np.ndarray, dict]:
        """Starts an episode."""
        answer = self._ask({"reset": seed}, 5.0)
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

    def command(self, action: np.ndarray) -> None:
        """Sends a command without waiting for the answer."""
        self._send({"action": action.tolist()})

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
        self._socket.sendall(line.encode() + b"\n")


def drive(policy: dmprl.Policy, robot: RemoteRobot, seed: int, hz: float) -> dict:
    """Runs one episode with a step every 1 / ``hz`` seconds; 0: as fast as the robot answers.

    The last command is always the hold, also after an error.
    """
    steps_max = policy.spec["episode_steps"] or STEPS_MAX
    policy.reset()
    observation, _ = robot.reset(seed)
    result = {"return": 0.0, "steps": 0, "held_steps": [], "late": 0, "is_success": False}
    due = time.monotonic()
    try:
        while result["steps"] < steps_max:
            try:
                action = policy.action(observation)
            except ValueError as error:
                print(f"step {result['steps'] + 1}: {error}", file=sys.stderr)
                action = policy.hold()
            observation, reward, terminated, truncated, info = robot.step(action)
            result["return"] += reward
            result["steps"] += 1
            if policy.is_holding:
                result["held_steps"].append(result["steps"])
            result["is_success"] = info.get("is_success", result["is_success"])
            if terminated or truncated:
                break
            if hz > 0.0:
                # After a stall the schedule restarts: missed steps are not caught up.
                now = time.monotonic()
                result["late"] += due + 1.0 / hz < now
                due = max(due + 1.0 / hz, now)
                time.sleep(due - now)
    finally:
        robot.command(policy.hold())
    return result


def main() -> None:
    """Runs an episode and prints the result as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", help="a policy file or a run directory")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5555)
    parser.add_argument("--hz", type=float, default=20.0, help="control rate [Hz]; 0: no limit")
    parser.add_argument("--patience", type=float, help="maximum wait for an answer [s]")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--rate", type=float, help="maximum change of an action per step")
    arguments = parser.parse_args()
    policy = dmprl.Policy.load(arguments.policy)
    if arguments.rate is not None:
        policy.limit(rate=arguments.rate)
    patience_s = arguments.patience or (1.0 / arguments.hz if arguments.hz > 0.0 else 1.0)
    robot = RemoteRobot(arguments.host, arguments.port, patience_s)
    print(json.dumps(drive(policy, robot, arguments.seed, arguments.hz)))


if __name__ == "__main__":
    main()

"""A simulated robot behind a socket, for trying and testing ``drive_robot.py`` without a robot.

It takes the place of a robot's controller::

    python stand_in_robot.py dmprl/PandaReachJoints-v0 --port 5555

It serves one client at a time, with one JSON object per line. The answer to
``{"reset": seed, "number": n}`` and ``{"action": […], "number": n}`` is ``{"number": n,
"observation": […], "reward": …, "terminated": …, "truncated": …, "info": {…}}``.

As a robot's controller must, it holds the robot by itself if no command arrives: with ``--hold`` it
executes the hold when the client disconnects, and with ``--timeout`` also when the client is silent
for so long.

``--silence FROM TO`` simulates a bad network: the robot executes the steps FROM to TO - 1 of each
episode, but does not answer them. ``--drop STEP`` simulates a link that breaks at that step.
``--log FILE`` records each executed command as one line of JSON.
"""

import argparse
import contextlib
import json
import socketserver
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np

import dmprl


class Server(socketserver.TCPServer):
    """Can reuse the port of a server that has just stopped."""

    allow_reuse_address = True


class Controller(socketserver.BaseRequestHandler):
    """Serves one client until it disconnects."""

    def handle(self) -> None:
        """Answers each line; holds the robot while there is none."""
        self._step = 0
        self._is_ready = False
        for line in self._lines():
            if line is None:
                self._hold()
                continue
            message = json.loads(line)
            if "reset" in message:
                observation, info = self.server.environment.reset(seed=message["reset"])
                reward, terminated, truncated, self._step = 0.0, False, False, 0
                self._is_ready = True
            else:
                self._step += 1
                if self._step == self.server.drop:
                    break
                observation, reward, terminated, truncated, info = self._execute(message["action"])
            if self._step in self.server.silence:
                continue
            answer = {
                "number": message["number"],
                "observation": observation.tolist(),
                "reward": float(reward),
                "terminated": bool(terminated),
                "truncated": bool(truncated),
                "info": {"is_success": bool(info.get("is_success", False))},
            }
            try:
                self.request.sendall(json.dumps(answer).encode() + b"\n")
            except ConnectionError:
                break  # the client has disconnected
        self._hold()

    def _lines(self) -> Iterator[bytes | None]:
        """Yields the client's lines, and None if none arrives for the timeout."""
        received = b""
        self.request.settimeout(self.server.client_timeout_s)
        while True:
            try:
                more = self.request.recv(65536)
            except TimeoutError:
                yield None
                continue
            except ConnectionError:
                return
            if not more:
                return
            *lines, received = (received + more).split(b"\n")
            yield from lines

    def _hold(self) -> None:
        """Executes the controller's own hold."""
        space = self.server.environment.action_space
        if self.server.hold is not None and self._is_ready:
            low, high = (np.asarray(bound, np.float64) for bound in (space.low, space.high))
            self._execute(self.server.hold.action(low, high).tolist(), is_own=True)

    def _execute(self, action: list[float], is_own: bool = False) -> tuple:
        """Executes a command and records it."""
        if self.server.log is not None:
            entry = {"step": self._step, "action": action, "is_own": is_own}
            with self.server.log.open("a") as log:
                log.write(json.dumps(entry) + "\n")
        environment = self.server.environment
        return environment.step(environment.action_space.dtype.type(action))


def main() -> None:
    """Serves until interrupted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("environment", help="a Gymnasium id, such as dmprl/PandaReachJoints-v0")
    parser.add_argument("--port", type=int, default=5555, help="0: any free port")
    parser.add_argument("--hold", type=dmprl.Hold.parse, help="as of dmprl export")
    parser.add_argument("--timeout", type=float, help="silence after which the robot holds [s]")
    parser.add_argument("--silence", type=int, nargs=2, metavar=("FROM", "TO"), default=(0, 0))
    parser.add_argument("--drop", type=int, metavar="STEP", help="step at which the link breaks")
    parser.add_argument("--log", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    with Server(("127.0.0.1", arguments.port), Controller) as server:
        server.environment = gymnasium.make(arguments.environment)
        server.silence = range(*arguments.silence)
        server.hold, server.client_timeout_s = arguments.hold, arguments.timeout
        server.drop, server.log = arguments.drop, arguments.log
        print(f"listening on port {server.server_address[1]}", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


if __name__ == "__main__":
    main()

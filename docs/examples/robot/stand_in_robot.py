"""A simulated robot behind a socket, for trying and testing ``drive_robot.py`` without a robot.

It takes the place of a robot's controller::

    python stand_in_robot.py dmprl/PandaReachJoints-v0 --port 5555

It serves one client at a time, with one JSON object per line. The answer to
``{"reset": seed, "number": n}`` and ``{"action": […], "number": n}`` is ``{"number": n,
"observation": […], "reward": …, "terminated": …, "truncated": …, "info": {…}}``.

``--silence FROM TO`` simulates a bad network: the robot executes the steps FROM to TO - 1 of each
episode, but does not answer them.
"""

import argparse
import contextlib
import json
import socketserver

import gymnasium

import dmprl  # noqa: F401 - registers its tasks


class Server(socketserver.TCPServer):
    """Can reuse the port of a server that has just stopped."""

    allow_reuse_address = True


class Controller(socketserver.StreamRequestHandler):
    """Serves one client until it disconnects."""

    def handle(self) -> None:
        """Answers each line."""
        environment, silence = self.server.environment, self.server.silence
        step = 0
        for line in self.rfile:
            message = json.loads(line)
            if "reset" in message:
                observation, info = environment.reset(seed=message["reset"])
                reward, terminated, truncated, step = 0.0, False, False, 0
            else:
                step += 1
                action = environment.action_space.dtype.type(message["action"])
                observation, reward, terminated, truncated, info = environment.step(action)
            if step in silence:
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
                self.wfile.write(json.dumps(answer).encode() + b"\n")
            except ConnectionError:
                return  # the client has disconnected


def main() -> None:
    """Serves until interrupted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("environment", help="a Gymnasium id, such as dmprl/PandaReachJoints-v0")
    parser.add_argument("--port", type=int, default=5555, help="0: any free port")
    parser.add_argument("--silence", type=int, nargs=2, metavar=("FROM", "TO"), default=(0, 0))
    arguments = parser.parse_args()
    with Server(("127.0.0.1", arguments.port), Controller) as server:
        server.environment = gymnasium.make(arguments.environment)
        server.silence = range(*arguments.silence)
        print(f"listening on port {server.server_address[1]}", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


if __name__ == "__main__":
    main()

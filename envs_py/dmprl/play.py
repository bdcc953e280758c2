"""Shows a policy in its environment, live; started by ``dmprl play``.

``python -m dmprl.play POLICY --task ID`` serves a web page on the loopback interface, for a browser
on this machine or on one connected with ``ssh -L``. With ``--window`` it opens the environment's
own window instead.
"""

from __future__ import annotations

import argparse
import html
import io
import itertools
import signal
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import gymnasium
import numpy as np

from dmprl import python_path
from dmprl.env_options import NO_OPTIONS, EnvOptions
from dmprl.gymnasium_env import GymnasiumSegmentEnv, success_of
from dmprl.pictures import name_opengl
from dmprl.policy import Policy
from dmprl.segment_env import SUCCESS_YES, kind_of_batch, named_object
from dmprl.task_env import gymnasium_maker

INTERRUPTED = 130
"""Exit status after an interrupt."""
DEFAULT_DT = 0.05
"""Duration of a step if the environment does not report it [s]."""
PAUSE_S = 0.8
"""Pause after an episode, to show its outcome [s]."""
BETWEEN_FRAMES_S = 1 / 50
"""Minimum time between frames [s]; most screens cannot show more."""
QUALITY = 85
"""JPEG quality of the pictures."""
WAIT_S = 5.0
"""Time after which the last picture is sent again [s]."""
BOUNDARY = "frame"
LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")
"""Host names of this machine. Others are rejected, to prevent DNS rebinding."""
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><style>
body {{ font: 16px system-ui, sans-serif; margin: 1.5rem auto; max-width: 46rem; padding: 0 1rem;
color: #1a1a1a; background: #fff }}
img {{ width: 100%; height: auto; border: 1px solid #ddd }}
</style></head><body><h1 style="font-size: 1.2rem">{title}</h1>
<img src="stream" alt="Live view of the policy: time, return so far, and the scene"></body></html>
"""


class Show:
    """The newest picture, for any number of browsers."""

    def __init__(self, title: str) -> None:
        self.title = title
        self._picture = b""
        self._number = 0
        self._changed = threading.Condition()

    def show(self, picture: bytes) -> None:
        """Stores a new picture, as JPEG."""
        with self._changed:
            self._picture, self._number = picture, self._number + 1
            self._changed.notify_all()

    def pictures(self) -> Iterator[bytes]:
        """Yields the newest picture each time the previous one has been sent."""
        seen = 0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._number != seen, WAIT_S)  # noqa: B023
                picture, seen = self._picture, self._number
            if picture:
                yield picture


class Handler(BaseHTTPRequestHandler):
    """Serves the page and its stream to browsers on this machine."""

    server: Server

    def do_GET(self) -> None:
        """Answers a browser's request."""
        host = self.headers.get("Host", "").rsplit(":", 1)[0]
        if host not in LOCAL_NAMES:
            self.send_error(403, "this page is available only on this machine")
        elif self.path == "/":
            page = PAGE.format(title=html.escape(self.server.show.title)).encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(page)))
            self.end_headers()
            self.wfile.write(page)
        elif self.path == "/stream":
            self._stream()
        else:
            self.send_error(404)

    def _stream(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        try:
            for picture in self.server.show.pictures():
                head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\n"
                head += f"Content-Length: {len(picture)}\r\n\r\n"
                self.wfile.write(head.encode() + picture + b"\r\n")
        except OSError:
            pass  # the browser has closed the connection

    def log_message(self, format: str, *arguments: Any) -> None:
        """Suppresses the log line that the base class prints for each request."""


class Server(ThreadingHTTPServer):
    """HTTP server for one show."""

    daemon_threads = True

    def __init__(self, port: int, show: Show) -> None:
        super().__init__(("127.0.0.1", port), Handler)
        self.show = show


class Painter:
    """Draws an environment with a line of text, as JPEG."""

    def __init__(self, environment: gymnasium.Env) -> None:
        from PIL import Image, ImageDraw, ImageFont  # extra `video`

        self._environment = environment
        self._image, self._draw, self._font = Image, ImageDraw, ImageFont.load_default(18)

    def paint(self, text: str) -> bytes:
        """Draws the environment's current state."""
        frame = self._environment.render()
        if not isinstance(frame, np.ndarray) or frame.ndim != 3:
            raise SystemExit(
                f"{self._environment.spec.id} cannot be drawn: in render mode 'rgb_array', "
                f"render() returned {type(frame).__name__}"
            )
        picture = self._image.fromarray(frame[..., :3].astype(np.uint8))
        whole = self._image.new("RGB", (picture.width, picture.height + 36), "#ffffff")
        whole.paste(picture, (0, 36))
        self._draw.Draw(whole).text((12, 18), text, "#1a1a1a", self._font, anchor="lm")
        data = io.BytesIO()
        whole.save(data, "JPEG", quality=QUALITY)
        return data.getvalue()


class Shown(GymnasiumSegmentEnv):
    """One Gymnasium environment with a render mode."""

    def __init__(self, task_id: str, render_mode: str, options: EnvOptions = NO_OPTIONS) -> None:
        named = named_object(task_id)
        kind = kind_of_batch(named)
        if kind:
            raise SystemExit(f"{task_id} is {kind}, which cannot be shown")
        self._mode = render_mode
        super().__init__(task_id, 1, 1, gymnasium_maker(task_id, named, options), options)

    def _make(self) -> gymnasium.Env:
        why = (
            f"{self.task_id} cannot be shown; expected an environment with the render mode "
            f"{self._mode!r}"
        )
        try:
            made = super()._make({"render_mode": self._mode})
        except TypeError as error:
            raise SystemExit(f"{why} ({error})") from error
        if made.render_mode != self._mode:
            raise SystemExit(why)
        return made

    @property
    def environment(self) -> gymnasium.Env:
        """The Gymnasium environment."""
        return self._envs[0]


def play(policy: Policy, made: gymnasium.Env, seeds: Iterator[int], paint) -> None:
    """Plays one episode after the other in real time; ``paint`` shows a frame with its caption."""
    dt = policy.spec["control_dt_s"] or DEFAULT_DT
    every = max(1, round(BETWEEN_FRAMES_S / dt))
    for seed in seeds:
        observation, info = made.reset(seed=seed)
        policy.reset()
        total, steps, ended, due = 0.0, 0, False, time.monotonic()
        paint(f"seed {seed}    {0.0:.2f} s    return {total:.2f}")
        while not ended:
            action = policy.action(np.asarray(observation))
            observation, reward, terminated, truncated, info = made.step(
                action.astype(made.action_space.dtype)
            )
            total, steps, ended = total + float(reward), steps + 1, terminated or truncated
            if ended or steps % every == 0:
                reached = "    at the goal" if success_of(info) == SUCCESS_YES else ""
                paint(f"seed {seed}    {steps * dt:.2f} s    return {total:.2f}{reached}")
            due += dt
            time.sleep(max(0.0, due - time.monotonic()))
        print(f"seed {seed}: return {total:.2f} in {steps} steps", flush=True)
        time.sleep(PAUSE_S)


def main() -> int:
    """Plays the episodes until their end or an interrupt."""
    parser = argparse.ArgumentParser(prog="dmprl play")
    parser.add_argument("policy")
    parser.add_argument("--task", required=True)
    parser.add_argument("--options", type=EnvOptions.parse, default=NO_OPTIONS, help="TOML")
    parser.add_argument("--title", required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--episodes", type=int, default=0, help="0: until it is interrupted")
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--window", action="store_true")
    parser.add_argument("--python-path", action="append", default=[])
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))
    python_path.extend(arguments.python_path)
    policy = Policy.load(arguments.policy)
    seeds = itertools.count(arguments.seed)
    if arguments.episodes > 0:
        seeds = itertools.islice(seeds, arguments.episodes)
    try:
        if arguments.window:
            shown = Shown(arguments.task, "human", arguments.options).environment
            play(policy, shown, seeds, lambda text: None)
            return 0
        name_opengl()
        shown = Shown(arguments.task, "rgb_array", arguments.options).environment
        painter = Painter(shown)
        show = Show(arguments.title)
        try:
            server = Server(arguments.port, show)
        except OSError as error:
            raise SystemExit(
                f"cannot serve on port {arguments.port}: {error}; choose another --port, or 0 for "
                "any free one"
            ) from error
        threading.Thread(target=server.serve_forever, daemon=True).start()
        print(f"http://127.0.0.1:{server.server_address[1]}/", flush=True)
        play(policy, shown, seeds, lambda text: show.show(painter.paint(text)))
    except KeyboardInterrupt:
        return INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Writes a log of episodes for the viewer of rerun.io; started by ``dmprl record --rerun``.

``python -m dmprl.rerun_log PLAN``: PLAN is a JSON file that ``deploy/sweep/src/record`` writes.
Progress is reported on standard output, in the format of ``dmprl_shared::supervision``.

Entities of an episode, on the timelines ``step`` and, if the duration of a step is known, ``time``.
The state after t steps is at step t, and so is the reward for reaching it:

======================================= ==========================================================
``episode_SEED/observation/NAME``       before the first step and after each
``episode_SEED/command/action[i]``      in the environment's units, at the step that it starts
``episode_SEED/reward``, ``…/return``   after each step; the return so far also before the first
``episode_SEED/success``                0 or 1 after each step, if the task reports it
``episode_SEED/joint/position``,        of the robot's joints [rad or m, and per second], one entity
``…/velocity``                          for each joint, before the first step and after each
``episode_SEED/camera``                 a JPEG for each frame
``episode_SEED/segment/index``          number of each segment, at its first step
``episode_SEED/segment/start``,         of the movement primitives, at the first step, if the
``…/goal``, ``…/weights``               policy has them: one entity for each ``action[i]``
``episode_SEED/segment/position``       planned position after each executed step, likewise
======================================= ==========================================================

With two runs, the name of the run directory comes first.
"""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import ArrayLike, NDArray
from PIL import Image

JPEG_QUALITY = 90
APPLICATION = "dmprl"


class Side(TypedDict):
    """The episodes of one run."""

    name: str
    """Name of the run directory."""
    title: str
    episodes: str
    """File of the observer, with the details of each episode."""


class Plan(TypedDict):
    """The file to write, and the episodes in it."""

    sides: list[Side]
    """One or two."""
    output: str


class EpisodeLog:
    """Logs an episode below the entity ``root``."""

    def __init__(
        self, stream: rr.RecordingStream, root: Sequence[str], episode: dict, robot: dict
    ) -> None:
        self.root = root
        self._stream, self._episode, self._dt = stream, episode, robot["control_dt_s"]
        # Of a task whose joints are unknown, there are neither names nor rows.
        self._joints = [joint["name"] for joint in robot["joints"]]
        self._details = episode["details"]
        self._frames = list(
            zip(episode.get("frames", []), episode.get("frame_steps", []), strict=True)
        )

    @property
    def has_times(self) -> bool:
        """Whether the duration of a step is known."""
        return self._dt > 0

    @property
    def has_primitives(self) -> bool:
        """Whether the policy has movement primitives."""
        return self._details["segments"][0]["primitives"] is not None

    @property
    def has_joints(self) -> bool:
        """Whether the robot's joints are known."""
        return bool(self._joints)

    @property
    def frame_count(self) -> int:
        """Number of pictures."""
        return len(self._frames)

    def path(self, *parts: str) -> str:
        """Returns the path of an entity."""
        return rr.new_entity_path([*self.root, *parts])

    def steps(self) -> None:
        """Logs what happened at each step."""
        details, rewards = self._details, np.array(self._episode["rewards"])
        states = np.arange(len(rewards) + 1)
        observations = np.array(details["observations"])
        names = details["observation_names"] or numbered("observation", observations.shape[1])
        self._columns(["observation"], names, states, observations)
        commands = np.array(details["commands"])
        self._columns(["command"], actions(commands), states[:-1], commands)
        self._scalars(["reward"], states[1:], rewards)
        self._scalars(["return"], states, np.concatenate([[0.0], np.cumsum(rewards)]))
        if self.has_joints:
            keys = {"position": "joint_positions", "velocity": "joint_velocities"}
            for quantity, key in keys.items():
                rows = np.array(self._episode[key])
                self._columns(["joint", quantity], self._joints, states, rows)
        success = self._episode["success_by_step"]
        reported = np.array([flag is not None for flag in success], bool)
        if reported.any():
            values = np.array([bool(flag) for flag in success], float)
            self._hold(["success"])
            self._scalars(["success"], states[1:][reported], values[reported])

    def segments(self) -> None:
        """Logs where segments begin, and their movement primitives."""
        segments = self._details["segments"]
        first_steps = np.array([segment["first_step"] for segment in segments])
        self._mark(["segment", "index"])
        self._scalars(["segment", "index"], first_steps, np.arange(len(segments)))
        if not self.has_primitives:
            return
        primitives = [segment["primitives"] for segment in segments]
        start = np.array([chosen["start"] for chosen in primitives])
        names = actions(start)
        goal = np.array([chosen["goal"] for chosen in primitives])
        weights = np.array([chosen["weights"] for chosen in primitives])
        # An episode may end within a segment.
        executed = [it["primitives"]["positions"][: it["steps"]] for it in segments]
        positions = np.concatenate(executed)
        for name in names:
            self._mark(["segment", "start", name])
            self._hold(["segment", "goal", name])
            self._hold(["segment", "weights", name])
        self._columns(["segment", "start"], names, first_steps, start)
        self._columns(["segment", "goal"], names, first_steps, goal)
        for name, column in zip(names, weights.transpose(1, 0, 2), strict=True):
            self._scalars(["segment", "weights", name], first_steps, column)
        self._columns(["segment", "position"], names, np.arange(len(positions)) + 1, positions)

    def frames(self) -> Iterator[None]:
        """Logs the pictures; yields after each."""
        for file, step in self._frames:
            columns = rr.EncodedImage.columns(blob=[jpeg(file)], media_type=["image/jpeg"])
            self._send(["camera"], [step], columns)
            yield

    def _columns(
        self, parts: Sequence[str], names: Sequence[str], steps: ArrayLike, rows: NDArray
    ) -> None:
        for name, column in zip(names, rows.T, strict=True):
            self._scalars([*parts, name], steps, column)

    def _scalars(self, parts: Sequence[str], steps: ArrayLike, values: NDArray) -> None:
        columns = rr.Scalars.columns(scalars=np.asarray(values, np.float64).reshape(-1))
        if values.ndim == 2:
            columns = columns.partition([values.shape[1]] * len(values))
        self._send(parts, steps, columns)

    def _send(self, parts: Sequence[str], steps: ArrayLike, columns: Any) -> None:
        steps = np.asarray(steps, np.int64)
        times = [rr.TimeColumn("step", sequence=steps)]
        if self.has_times:
            # As integers, because rerun truncates seconds.
            nanoseconds = np.round(1e9 * self._dt * steps).astype("timedelta64[ns]")
            times.append(rr.TimeColumn("time", duration=nanoseconds))
        self._stream.send_columns(self.path(*parts), times, columns, strict=True)

    def _mark(self, parts: Sequence[str]) -> None:
        """Draws the values of an entity as points."""
        style = rr.SeriesPoints(markers="diamond", marker_sizes=4.0)
        self._stream.log(self.path(*parts), style, static=True, strict=True)

    def _hold(self, parts: Sequence[str]) -> None:
        """Draws each value of an entity up to the next one."""
        style = rr.SeriesLines(interpolation_mode="StepAfter")
        self._stream.log(self.path(*parts), style, static=True, strict=True)


def actions(rows: NDArray) -> list[str]:
    """Names the columns of an array with a column for each action dimension."""
    return numbered("action", rows.shape[1])


def numbered(name: str, count: int) -> list[str]:
    """Names the entries of an array."""
    return [f"{name}[{index}]" for index in range(count)]


def jpeg(file: str) -> bytes:
    """Reads a picture and compresses it."""
    contents = io.BytesIO()
    with Image.open(file) as picture:
        picture.convert("RGB").save(contents, format="JPEG", quality=JPEG_QUALITY)
    return contents.getvalue()


def read(side: Side) -> tuple[dict, list[dict]]:
    """Reads the robot and the episodes of a run."""
    with open(side["episodes"], encoding="utf-8") as file:
        robot, *episodes = map(json.loads, file)
    return robot, episodes


def roots(sides: list[Side]) -> list[list[str]]:
    """Returns the first parts of each side's entity paths: none for a single run."""
    if len(sides) == 1:
        return [[]]
    names: list[str] = []
    for side in sides:
        names.append(side["name"] if side["name"] not in names else f"{side['name']}-2")
    return [[name] for name in names]


def views(log: EpisodeLog, title: str) -> rrb.Container:
    """Arranges picture and plots of an episode."""

    def plot(name: str, *entities: str) -> rrb.TimeSeriesView:
        contents = [f"{log.path(*entity.split('/'))}/**" for entity in entities]
        return rrb.TimeSeriesView(name=name, contents=contents)

    plots = [plot("commands", "command"), plot("observations", "observation")]
    if log.has_primitives:
        planned = ["segment/position", "segment/goal", "segment/start"]
        plots.insert(1, plot("planned segments", *planned))
    if log.has_joints:
        plots.append(plot("joint velocities", "joint/velocity"))
    plots.append(plot("reward, return and success", "reward", "return", "success"))
    picture = rrb.Spatial2DView(name=title, origin=log.path("camera"))
    return rrb.Horizontal(picture, rrb.Vertical(*plots), name=title)


def blueprint(logs: list[list[EpisodeLog]], titles: list[str]) -> rrb.Blueprint:
    """Arranges a tab for each episode, with the runs side by side."""
    tabs = []
    for sides in zip(*logs, strict=True):
        shown = [views(log, title) for log, title in zip(sides, titles, strict=True)]
        tabs.append(rrb.Horizontal(*shown, name=sides[0].root[-1]))
    timeline = "time" if logs[0][0].has_times else "step"
    return rrb.Blueprint(rrb.Tabs(*tabs), rrb.TimePanel(timeline=timeline))


def main() -> None:
    """Writes the file of the plan."""
    with open(sys.argv[1], encoding="utf-8") as file:
        plan: Plan = json.load(file)
    output = Path(plan["output"])
    # Would switch logging off: users set it for programs of their own.
    os.environ.pop("RERUN", None)
    # The viewer keeps one arrangement per application, and the entities depend on the episodes.
    stream = rr.RecordingStream(f"{APPLICATION} {output.stem}")
    logs = []
    for side, root in zip(plan["sides"], roots(plan["sides"]), strict=True):
        robot, episodes = read(side)
        logs.append(
            [EpisodeLog(stream, [*root, f"episode_{it['seed']}"], it, robot) for it in episodes]
        )
    titles = [side["title"] for side in plan["sides"]]
    stream.save(output, blueprint(logs, titles))
    stream.send_recording_name(f"{' and '.join(titles)} ({output.stem})")
    total = sum(log.frame_count for side in logs for log in side)
    done = 0
    for log in (log for side in logs for log in side):
        log.steps()
        log.segments()
        for _ in log.frames():
            done += 1
            print(json.dumps({"filmed": {"done": done - (done == total), "of": total}}), flush=True)
    # Completes the file.
    stream.disconnect()
    print(json.dumps({"filmed": {"done": total, "of": total}}), flush=True)


if __name__ == "__main__":
    main()

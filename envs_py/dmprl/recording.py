"""An environment that records its robot's motion at control rate.

``dmprl record`` and the measurement of motion use it (``actors/src/python_env/recording.rs``). Its
episodes equal those of an evaluation with the same seeds; they run one step at a time.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import gymnasium
import numpy as np
from numpy.typing import NDArray

try:
    import mujoco
except Exception as error:  # raised by the OpenGL that MUJOCO_GL names
    if not os.environ.get("MUJOCO_GL"):
        raise
    raise RuntimeError(
        f"no OpenGL to draw with (MUJOCO_GL={os.environ['MUJOCO_GL']}: {error}). Unset MUJOCO_GL, "
        "or install OpenGL; on Debian and Ubuntu: apt install libegl1 libgl1-mesa-dri for egl, "
        "libosmesa6 for osmesa"
    ) from None

from dmprl import segment_env
from dmprl.delayed_env import DelayedEnv
from dmprl.env_options import NO_OPTIONS, EnvOptions
from dmprl.gymnasium_env import GymnasiumSegmentEnv, success_of
from dmprl.pictures import name_opengl
from dmprl.robot_joints import Joints, robot_joints
from dmprl.segment_env import EnvSpec, SegmentBuffers, SegmentEnv, kind_of_batch, named_object
from dmprl.task_env import TaskEnv, gymnasium_maker

RENDER_MODE = "rgb_array"
DRAWABLE = f"expected a Gymnasium environment with the render mode {RENDER_MODE!r}"
FRAME_RATE_MAX = 50.0
"""Maximum frames per second of an episode; most screens cannot show more."""


class NoPicturesError(RuntimeError):
    """Raised if the environment cannot be drawn."""


class Recording(TypedDict):
    """An episode of T steps. Rows of joints follow :meth:`RecordingEnv.joints`."""

    joint_positions: list[list[float]]
    """(T+1, J) [rad or m]: before the first step and after each; empty without joints."""
    joint_velocities: list[list[float]]
    """(T+1, J) [rad/s or m/s]."""
    success: list[int]
    """(T,): value of ``SegmentBuffers.success`` after each step."""
    frames: list[str]
    """Files of the pictures, if requested."""
    frame_steps: list[int]
    """Number of steps executed before each picture."""


class State(NamedTuple):
    """State of a MuJoCo simulation, as arrays that change with it."""

    model: mujoco.MjModel
    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]


class Log:
    """Records the episode that started with the last reset with a seed."""

    def __init__(self, pictures: Path | None) -> None:
        self.joints: Joints | None = None
        self.recording = empty_recording()
        self._pictures = pictures
        self._open = False
        self._seed = 0

    def begin(self, env: Watched, seed: int | None) -> None:
        """Starts an episode. An automatic reset has no seed, and its episode is not recorded."""
        self._open = seed is not None
        if seed is not None:
            self._seed = seed
            self.recording = empty_recording()
            self._note_state(env)
            self._draw(env)

    def step(self, env: Watched, info: dict[str, Any], ended: bool) -> None:
        """Records a step."""
        if not self._open:
            return
        self.recording["success"].append(success_of(info))
        self._note_state(env)
        if ended or len(self.recording["success"]) % steps_per_frame(env) == 0:
            self._draw(env)

    def _draw(self, env: Watched) -> None:
        if self._pictures is None:
            return
        from PIL import Image  # extra `video`

        step = len(self.recording["success"])
        file = self._pictures / f"{self._seed}-{step:06}.png"
        picture = env.render()
        if not isinstance(picture, np.ndarray) or picture.ndim != 3:
            raise NoPicturesError(f"{env.spec.id}: render() returned {type(picture).__name__}")
        # Low compression, because the file is read once and deleted.
        Image.fromarray(picture[..., :3].astype(np.uint8)).save(file, compress_level=1)
        self.recording["frames"].append(str(file))
        self.recording["frame_steps"].append(step)

    def _note_state(self, env: Watched) -> None:
        state = env.state()
        if state is None or self.joints is None:
            return
        self.recording["joint_positions"].append(state.qpos[self.joints.qpos].tolist())
        self.recording["joint_velocities"].append(state.qvel[self.joints.qvel].tolist())


class Watched(gymnasium.Wrapper):
    """Records every step in a :class:`Log`."""

    def __init__(self, env: gymnasium.Env, log: Log) -> None:
        super().__init__(env)
        self._log = log

    def state(self) -> State | None:
        """Returns the simulation's state; None if the environment does not use MuJoCo."""
        env = self.unwrapped
        if isinstance(env, TaskEnv):
            return State(env.task.model, *env.positions_and_velocities)
        model, data = getattr(env, "model", None), getattr(env, "data", None)
        if isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData):
            return State(model, data.qpos, data.qvel)
        return None

    def reset(  # noqa: D102 - inherited
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        result = self.env.reset(seed=seed, options=options)
        self._log.begin(self, seed)
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:  # noqa: D102
        result = self.env.step(action)
        self._log.step(self, result[4], bool(result[2] or result[3]))
        return result


class RecordingEnv(GymnasiumSegmentEnv):
    """One recorded Gymnasium environment."""

    def __init__(
        self,
        task_id: str,
        segment_steps: int,
        named: object = None,
        pictures: Path | None = None,
        options: EnvOptions = NO_OPTIONS,
    ) -> None:
        self._log = Log(pictures)
        self._drawing = {} if pictures is None else {"render_mode": RENDER_MODE}
        super().__init__(task_id, 1, segment_steps, named, options)
        state = self._envs[0].state()
        self._log.joints = None if state is None else robot_joints(state.model)

    def _make(self) -> gymnasium.Env:
        if not self._drawing:
            return Watched(super()._make(), self._log)
        try:
            env = Watched(super()._make(self._drawing), self._log)
        except TypeError as error:
            raise NoPicturesError(f"{self.task_id} cannot be drawn: {error}; {DRAWABLE}") from error
        if env.render_mode != RENDER_MODE:
            raise NoPicturesError(f"{self.task_id} cannot be drawn; {DRAWABLE}")
        return env

    def goal_in_pictures(self) -> str:
        """Returns the appearance of the goal in pictures; empty if unknown."""
        env = self._envs[0].unwrapped
        return env.task.goal_in_pictures if isinstance(env, TaskEnv) else ""

    def spec(self) -> EnvSpec:  # noqa: D102 - inherited
        spec = super().spec()
        env = self._envs[0].unwrapped
        if isinstance(env, TaskEnv) and not self.options.wrappers:
            # As the worker's batch of this task reports them.
            spec["id"] = env.task.id
            spec["observation_names"] = env.task.observation_names()
        return spec

    def joints(self) -> list[tuple[str, str]]:
        """Returns name and kind, ``hinge`` or ``slide``, of each joint of the robot."""
        joints = self._log.joints
        return [] if joints is None else list(zip(joints.names, joints.kinds, strict=True))

    def why_no_joints(self) -> str:
        """Returns why there are no joints; empty if there are some."""
        if self._log.joints is None:
            return "not a MuJoCo environment, so its joints are unknown"
        return "" if self._log.joints.names else "no actuator of its model moves a joint"

    def recording(self) -> Recording:
        """Returns the record of the episode that started with the last reset with a seed."""
        return self._log.recording


class OpaqueEnv(SegmentEnv):
    """Environments that are stepped together, of which only rewards can be recorded."""

    def __init__(self, env: SegmentEnv) -> None:
        self._env = env
        self.env_count, self.segment_steps = env.env_count, env.segment_steps

    def spec(self) -> EnvSpec:  # noqa: D102 - inherited
        return self._env.spec()

    def reset(  # noqa: D102 - inherited
        self, mask: NDArray[np.uint8], seeds: NDArray[np.uint64], out: SegmentBuffers
    ) -> None:
        self._env.reset(mask, seeds, out)

    def step_segment(  # noqa: D102 - inherited
        self, actions: NDArray[np.float64], out: SegmentBuffers
    ) -> None:
        self._env.step_segment(actions, out)

    def take_failures(self) -> list[str]:  # noqa: D102 - inherited
        return self._env.take_failures()

    def close(self) -> None:  # noqa: D102 - inherited
        self._env.close()

    def joints(self) -> list[tuple[str, str]]:
        """Returns an empty list."""
        return []

    def why_no_joints(self) -> str:
        """Returns the reason."""
        return "its environment runs a whole segment at once, so the motion within is not recorded"

    def goal_in_pictures(self) -> str:
        """Returns an empty string: there are no pictures."""
        return ""

    def recording(self) -> Recording:
        """Returns an empty record."""
        return empty_recording()


def empty_recording() -> Recording:
    """Returns the record of an episode that has not started."""
    return {
        "joint_positions": [],
        "joint_velocities": [],
        "success": [],
        "frames": [],
        "frame_steps": [],
    }


def steps_per_frame(env: gymnasium.Env) -> int:
    """Returns the number of environment steps per frame."""
    dt = getattr(env.unwrapped, "dt", 0.0)
    return max(1, round(1.0 / (FRAME_RATE_MAX * dt))) if np.isscalar(dt) and dt > 0 else 1


def make(
    task_id: str,
    segment_steps: int,
    pictures: str | None = None,
    options: EnvOptions = NO_OPTIONS,
) -> RecordingEnv | OpaqueEnv | DelayedEnv:
    """Creates one environment of a task.

    - ``task_id``, ``options``: as for :func:`dmprl.segment_env.make`.
    - ``pictures``: folder for pictures; None to make no pictures.
    """
    if pictures is not None:
        name_opengl()
    named = named_object(task_id)
    kind = kind_of_batch(named)
    if kind:
        if pictures is not None:
            raise NoPicturesError(f"{task_id} is {kind}, which cannot be drawn; {DRAWABLE}")
        return OpaqueEnv(segment_env.make(task_id, 1, segment_steps, options))
    folder = None if pictures is None else Path(pictures)
    maker = gymnasium_maker(task_id, named, options)
    env = RecordingEnv(task_id, segment_steps, maker, folder, options)
    return segment_env.delayed(env, options)

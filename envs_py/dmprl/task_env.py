"""Wraps one of dmprl's tasks as a Gymnasium environment."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dmprl.env_options import EnvOptions, Randomise
from dmprl.goal_task import GoalTask
from dmprl.mujoco_batch import MujocoTask, quieten_mujoco
from dmprl.segment_env import SUCCESS_NOT_REPORTED, SegmentBuffers, SegmentEnvError
from dmprl.tasks import make_task, registered, replaces

# Without a display, GLFW would end the whole process when it opens a window.
HAS_DISPLAY = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


Observation = NDArray[np.float64] | dict[str, NDArray[np.float64]]
GOALS = "achieved_goal", "desired_goal"


class TaskEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A batch of one environment with segments of one step, so it behaves as in a worker.

    The observation of a task with goals is a ``Dict`` of ``achieved_goal``, ``desired_goal`` and
    ``observation``, as in Gymnasium-Robotics; a worker's row is the ``Dict`` flattened.

    ``gymnasium.make`` adds Gymnasium's own wrapper for the time limit. The render modes
    ``rgb_array`` and ``depth_array`` need no display (:mod:`dmprl.pictures`).
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": ["rgb_array", "depth_array"] + ["human"] * HAS_DISPLAY
    }

    def __init__(
        self,
        task_id: str,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        task: Callable[..., MujocoTask] | None = None,
        **kwargs: Any,
    ) -> None:
        """Creates the environment.

        ``task``, if given, creates a user's own task for a number of environments. ``kwargs`` are
        the task's arguments.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            modes = ", ".join(self.metadata["render_modes"])
            raise ValueError(f"{task_id}: render_mode {render_mode!r}; expected one of {modes}")
        made = make_task(task_id, 1, kwargs) if task is None else task(1, **kwargs)
        if made is None:
            raise ValueError(f"{task_id} is not a task of dmprl; `dmprl tasks` lists them")
        self.task = made
        self._batch = made.batch(1, None)
        batch = self._batch.batch
        # (nq,) and (nv,) of :attr:`task`'s model; they change with every step.
        self.positions_and_velocities = batch.bind("qpos")[0], batch.bind("qvel")[0]
        spec = self._batch.spec()
        self.dt = spec["control_dt_s"]
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.dt)}
        self._goal_len = made.goal_len if isinstance(made, GoalTask) else 0
        self.observation_space = self._space(spec["observation_len"])
        self.action_space = spaces.Box(made.action_low, made.action_high, dtype=np.float32)
        self._out = SegmentBuffers(1, 1, spec["observation_len"], spec["action_len"])
        self.render_mode = render_mode
        self._size = (width, height)
        self._data: mujoco.MjData | None = None
        self._view: Callable[[], Any] = lambda: None
        self._close_view: Callable[[], None] | None = None

    def randomise(self, ranges: Randomise) -> None:
        """Draws the model for each episode; pictures show the model's own sizes."""
        self._batch.randomise(ranges)

    def _space(self, observation_len: int) -> spaces.Space:
        lengths = {"observation": observation_len - 2 * self._goal_len}
        if self._goal_len:
            lengths |= dict.fromkeys(GOALS, self._goal_len)
        boxes = {
            name: spaces.Box(-np.inf, np.inf, (length,), np.float64)
            for name, length in lengths.items()
        }
        return spaces.Dict(boxes) if self._goal_len else boxes["observation"]

    def _observation(self, row: NDArray[np.float64]) -> Observation:
        if not self._goal_len:
            return row.copy()
        parts = np.split(row, [self._goal_len, 2 * self._goal_len])
        return dict(zip((*GOALS, "observation"), map(np.copy, parts), strict=True))

    def compute_reward(
        self,
        achieved_goal: NDArray[np.float64],
        desired_goal: NDArray[np.float64],
        info: Any,
    ) -> np.float64 | NDArray[np.float64]:
        """Computes the rewards (…) for having achieved goals (…, G) when others were desired."""
        achieved, desired = np.asarray(achieved_goal), np.asarray(desired_goal)
        rewards = np.zeros(achieved.shape[:-1])
        self.task.goal_rewards(achieved, desired, rewards)
        return rewards[()]

    def reset(  # noqa: D102 - inherited
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self._batch.seed_model(0, seed)
        self._batch.seed(0, self.np_random)
        self._batch.begin(np.zeros(1, np.int32), self._out)
        if self.render_mode == "human":
            self.render()
        return self._observation(self._out.next_observations[0]), {}

    def step(  # noqa: D102 - inherited
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        out = self._out
        self._batch.step_segment(np.asarray(action, np.float64).reshape(1, 1, -1), out)
        if out.failed[0]:
            raise SegmentEnvError("; ".join(self._batch.take_failures()))
        info = {}
        if out.success[0] != SUCCESS_NOT_REPORTED:
            info["is_success"] = bool(out.success[0])
        if self.render_mode == "human":
            self.render()
        observation = self._observation(out.observations[0, 1])
        return observation, float(out.rewards[0, 0]), False, False, info

    def render(self) -> Any:  # noqa: D102 - inherited
        if self.render_mode is None:
            return None
        if self._data is None:
            self._model = self.task.picture_model()
            self._data = mujoco.MjData(self._model)
            self._view = self._open_view(self._data)
        state = self._batch.batch.state[0]
        mujoco.mj_setState(self._model, self._data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_forward(self._model, self._data)
        return self._view()

    def _open_view(self, data: mujoco.MjData) -> Callable[[], Any]:
        model, camera = self._model, dict(self.task.camera)
        if self.render_mode == "human":
            from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

            window = MujocoRenderer(model, data, camera, *self._size)
            self._close_view = window.close
            return lambda: window.render("human")

        from dmprl.pictures import PictureMaker

        maker = PictureMaker(model, *self._size, camera)
        self._close_view = maker.close
        draw = maker.rgb if self.render_mode == "rgb_array" else maker.depth
        return lambda: draw(data)

    def close(self) -> None:  # noqa: D102 - inherited
        if self._close_view is not None:
            self._close_view()
            self._close_view = None


def gymnasium_maker(task_id: str, named: object, options: EnvOptions) -> object:
    """Returns what creates the Gymnasium environments of a task.

    A task on MuJoCo's batch becomes a :class:`TaskEnv`, with the process settings of a worker. For
    any other task the result is ``named``, the object that ``task_id`` names.
    """
    ours = task_id.removeprefix("dmprl:")
    if isinstance(named, type) and issubclass(named, MujocoTask):
        maker = functools.partial(TaskEnv, task_id, task=named)
        maker.max_episode_steps = named.episode_steps
    elif replaces(ours, options):
        maker = functools.partial(TaskEnv, ours)
        maker.max_episode_steps = registered(ours).episode_steps
    else:
        return named
    quieten_mujoco()
    return maker

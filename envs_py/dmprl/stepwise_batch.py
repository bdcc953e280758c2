"""Tasks on MuJoCo's batched simulation whose controls depend on the state at each step.

For example, a displacement is relative to the robot's state at the start of a step. So the controls
of a segment are not known in advance, and it is simulated step by step.
"""

from __future__ import annotations

from abc import abstractmethod

import mujoco
import numpy as np
from numpy.typing import NDArray

from dmprl.mujoco_batch import BatchSegmentEnv, Fields, MujocoTask
from dmprl.segment_env import SegmentBuffers

VELOCITY_STAGE = mujoco.mjtStage.mjSTAGE_VEL.value
"""Computes positions, velocities and sensors for the state after a step; ``mj_step`` leaves them
one simulation step behind."""


class StepwiseTask(MujocoTask):
    """A task with a controller between actions and actuators."""

    def batch(  # noqa: D102 - inherited
        self, segment_steps: int, episode_steps: int | None
    ) -> BatchSegmentEnv:
        return StepwiseSegmentEnv(self, segment_steps, episode_steps)

    @abstractmethod
    def targets(
        self, fields: Fields, actions: NDArray[np.float32], out: NDArray[np.float64]
    ) -> None:
        """Writes the controls for one step.

        ``fields`` (E, …) of the state before it, ``actions`` (E, A), ``out`` (E, actuators).
        """


class StepwiseSegmentEnv(BatchSegmentEnv):
    """E simulations of one :class:`StepwiseTask`."""

    task: StepwiseTask

    def _prepare(self) -> None:
        self._targets = self.batch.bind("ctrl")

    def _simulate(self, steps: int, out: SegmentBuffers) -> NDArray[np.int32] | None:
        task, batch, failed = self.task, self.batch, None
        for step in range(steps):
            task.targets(self._fields, self._actions[:, step], self._targets)
            try:
                batch.step(nstep=task.frame_skip, stage=VELOCITY_STAGE)
            except mujoco.batch.SimulationError as error:
                # The others continue; the results of the failed ones are discarded.
                failed = error.ids if failed is None else np.union1d(failed, error.ids)
            task.observe(self._fields, out.observations[:, step + 1])
        return self._failed(failed)

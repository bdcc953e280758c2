"""The point mass of ``point_reach.py`` as a minimal ``SegmentEnv``, which steps many at once.

``dmprl train point_reach_batch:PointReachBatch --python-path docs/examples`` trains on it. NumPy
steps all environments together, so a step of sixteen costs as much as a step of one.
"""

import numpy as np

from dmprl.segment_env import EnvSpec, SegmentBuffers, SegmentEnv

DT, DAMPING, SUCCESS_DISTANCE, EPISODE_STEPS = 0.05, 0.5, 0.05, 60


class PointReachBatch(SegmentEnv):
    """E point masses, with O = 6 and A = 2. Shapes are those of ``SegmentEnv``."""

    def __init__(self, env_count: int, segment_steps: int) -> None:
        self.env_count, self.segment_steps = env_count, segment_steps
        # Per environment: position (2), velocity (2), target - position (2).
        self.state = np.zeros((env_count, 6))
        self.steps_left = np.zeros(env_count, np.int32)
        self.generators = [np.random.default_rng() for _ in range(env_count)]

    def spec(self) -> EnvSpec:
        """Returns sizes, bounds and timing."""
        axes = ("x", "y")
        return {
            "id": "PointReachBatch",
            "observation_len": 6,
            "observation_names": [
                f"{quantity}_{axis}"
                for quantity in ("position", "velocity", "to_target")
                for axis in axes
            ],
            "action_len": 2,
            "action_low": [-2.0, -2.0],
            "action_high": [2.0, 2.0],
            "control_dt_s": DT,
            "episode_steps": EPISODE_STEPS,
        }

    def reset(self, mask: np.ndarray, seeds: np.ndarray, out: SegmentBuffers) -> None:
        """Starts the masked environments from their seeds."""
        for index in np.flatnonzero(mask):
            self.generators[index] = np.random.default_rng(seeds[index])
            self._begin(index)
        out.next_observations[mask != 0] = self.state[mask != 0]

    def step_segment(self, actions: np.ndarray, out: SegmentBuffers) -> None:
        """Runs K steps in all environments, and resets those whose episode has ended."""
        out.observations[:, 0] = self.state
        # Environments whose episode ends within the segment run on; the surplus is zeroed below.
        position, velocity, to_target = np.split(self.state, 3, axis=1)  # views
        for step in range(self.segment_steps):
            target = position + to_target
            velocity += DT * (actions[:, step] - DAMPING * velocity)
            position += DT * velocity
            to_target[:] = target - position
            out.observations[:, step + 1] = self.state
            out.rewards[:, step] = -np.linalg.norm(to_target, axis=1)
        np.minimum(self.steps_left, self.segment_steps, out=out.steps)
        self.steps_left -= out.steps
        out.terminated[:] = 0
        out.truncated[:] = self.steps_left == 0
        out.failed[:] = 0
        for index, steps in enumerate(out.steps):
            out.success[index] = -out.rewards[index, steps - 1] < SUCCESS_DISTANCE
            out.observations[index, steps + 1 :] = 0.0
            out.rewards[index, steps:] = 0.0
            if out.truncated[index]:
                self._begin(index)
        out.next_observations[:] = self.state

    def _begin(self, index: int) -> None:
        self.state[index] = 0.0
        self.state[index, 4:] = self.generators[index].uniform(-1.0, 1.0, 2)
        self.steps_left[index] = EPISODE_STEPS

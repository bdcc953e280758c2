"""A point mass that reaches a target: a minimal environment for a movement primitive.

Importing the module registers ``PointReach-v0``. To train on it, run
``dmprl train point_reach:PointReach-v0`` with this folder as ``--python-path``.
"""

import gymnasium
import numpy as np
from gymnasium import spaces


class PointReach(gymnasium.Env):
    """Two forces move a damped unit mass; the target lies within one metre of the origin.

    Observation: position (2) [m], velocity (2) [m/s], target - position (2) [m].
    Action: force (2) [N]. Reward: minus the distance to the target [m].
    """

    dt = 0.05
    """Duration of a step [s]; dmprl reads it."""

    observation_space = spaces.Box(-np.inf, np.inf, (6,), np.float64)
    action_space = spaces.Box(-2.0, 2.0, (2,), np.float64)

    damping = 0.5
    success_distance = 0.05

    def reset(self, *, seed=None, options=None):
        """Starts at rest at the origin, with a new target."""
        super().reset(seed=seed)
        self.position, self.velocity = np.zeros(2), np.zeros(2)
        self.target = self.np_random.uniform(-1.0, 1.0, 2)
        return self._observation(), {}

    def step(self, action):
        """Advances the mass by one step (semi-implicit Euler)."""
        self.velocity += self.dt * (action - self.damping * self.velocity)
        self.position += self.dt * self.velocity
        distance = float(np.linalg.norm(self.target - self.position))
        # An episode is a success if `is_success` is true at its last step. The time limit ends it.
        info = {"is_success": distance < self.success_distance}
        return self._observation(), -distance, False, False, info

    def _observation(self):
        return np.concatenate([self.position, self.velocity, self.target - self.position])


gymnasium.register("PointReach-v0", entry_point=PointReach, max_episode_steps=60)

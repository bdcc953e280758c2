"""A user-defined MujocoTask in its own module."""

from dmprl.tasks.reacher import Reacher


class SlowReacher(Reacher):
    """Reacher at half the control rate."""

    id = "SlowReacher"
    frame_skip = 4


class ScaledReacher(Reacher):
    """Reacher with scaled rewards; takes an argument."""

    id = "ScaledReacher"

    def __init__(self, env_count, scale):
        super().__init__(env_count)
        self.scale = scale

    def rewards(self, observations, actions, out):
        super().rewards(observations, actions, out)
        out *= self.scale

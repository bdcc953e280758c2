"""A user-defined MujocoTask in its own module."""

from dmprl.tasks.reacher import Reacher


class SlowReacher(Reacher):
    """Reacher at half the control rate."""

    id = "SlowReacher"
    frame_skip = 4

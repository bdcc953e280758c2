"""A user's own MujocoTask, in a module of its own."""

from dmprl.tasks.reacher import Reacher


class SlowReacher(Reacher):
    """Reacher at half the control rate."""

    id = "SlowReacher"
    frame_skip = 4

"""A MujocoTask of one's own, as a user's module would hold it."""

from dmprl.tasks.reacher import Reacher


class SlowReacher(Reacher):
    """Reacher at half the control rate."""

    id = "SlowReacher"
    frame_skip = 4

"""Sends MuJoCo's warnings to standard error, which a worker writes to its log.

MuJoCo's own handler writes them to ``MUJOCO_LOG.TXT`` in the current folder.
"""

from __future__ import annotations

import sys

import mujoco

from dmprl.mujoco_batch import mujoco_hook

MESSAGES_MAX = 100
"""Maximum number of messages that are shown. An unstable simulation warns at every step."""

_shown: set[str] = set()


def to_standard_error() -> None:
    """Replaces MuJoCo's own handler, but not that of :func:`~dmprl.mujoco_batch.quieten_mujoco`."""
    if mujoco_hook("mju_user_warning").value is None:
        mujoco.set_mju_user_warning(_show)


def _show(message: str) -> None:
    if message in _shown or len(_shown) > MESSAGES_MAX:
        return
    _shown.add(message)
    if len(_shown) > MESSAGES_MAX:
        message = f"after {MESSAGES_MAX} warnings, no more are shown"
    print(f"MuJoCo: {message}", file=sys.stderr, flush=True)

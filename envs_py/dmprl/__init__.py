"""Environments and trained policies of dmprl.

A policy that dmprl has trained, with NumPy alone::

    import dmprl

    policy = dmprl.Policy.load("policy.safetensors")
    actions = policy.segment(observation)

Importing this package registers its tasks with Gymnasium, where that is installed::

    import dmprl
    import gymnasium

    env = gymnasium.make("dmprl/Thrower-v0", render_mode="rgb_array")

The rollout worker (Rust, ``actors/src/python_env``) embeds Python and calls
:func:`dmprl.segment_env.make`, then ``step_segment`` once per policy decision.
"""

from dmprl.policy import Policy
from dmprl.policy_file import PolicyFileError

__all__ = ["Policy", "PolicyFileError"]
__version__ = "0.1.0"


def _register() -> None:
    try:
        from gymnasium import register
    except ModuleNotFoundError:
        return  # who only loads a policy needs no environments

    from dmprl.tasks import TASKS

    for task_id, entry in TASKS.items():
        register(
            task_id,
            "dmprl.task_env:TaskEnv",
            max_episode_steps=entry.episode_steps,
            kwargs={"task_id": task_id},
        )


_register()

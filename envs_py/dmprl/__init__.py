"""Environments of dmprl.

Importing this package registers its tasks with Gymnasium::

    import dmprl
    import gymnasium

    env = gymnasium.make("dmprl/Thrower-v0", render_mode="rgb_array")

The rollout worker (Rust, ``actors/src/python_env``) embeds Python and calls
:func:`dmprl.segment_env.make`, then ``step_segment`` once per policy decision.
"""

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

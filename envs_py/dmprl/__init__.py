"""Environments and trained policies of dmprl.

Run a trained policy, with NumPy only::

    import dmprl

    policy = dmprl.Policy.load("policy.safetensors")
    action = policy.action(observation)

Train, read a run's evaluations, and create an environment::

    run = dmprl.train("reacher", steps=20_000)
    run.evaluations().plot(x="env_steps", y="return_mean")
    env = dmprl.make("reacher", render_mode="rgb_array")

Importing this package registers its tasks with Gymnasium, if that is installed::

    import dmprl
    import gymnasium

    env = gymnasium.make("dmprl/Thrower-v0", render_mode="rgb_array")

The rollout worker (Rust, ``actors/src/python_env``) embeds Python and calls
:func:`dmprl.segment_env.make`, then ``step_segment`` once per policy decision.
"""

from typing import TYPE_CHECKING, Any

from dmprl.callbacks import Callback
from dmprl.hold import Hold, NoHoldError
from dmprl.policy import Policy
from dmprl.policy_file import PolicyFileError
from dmprl.program import ProgramError
from dmprl.run import Run, pull
from dmprl.training import TrainingError, train

if TYPE_CHECKING:
    import gymnasium

__all__ = [
    "Callback",
    "Hold",
    "NoHoldError",
    "Policy",
    "PolicyFileError",
    "ProgramError",
    "Run",
    "TrainingError",
    "make",
    "pull",
    "train",
]
__version__ = "0.2.0"

SHORT_NAMES = {
    "reacher": "dmprl/Reacher-v5",
    "pusher": "dmprl/Pusher-v5",
    "thrower": "dmprl/Thrower-v0",
    "panda-reach": "dmprl/PandaReach-v0",
    "panda-reach-joints": "dmprl/PandaReachJoints-v0",
    "panda-push": "dmprl/PandaPush-v0",
    "panda-push-dense": "dmprl/PandaPushDense-v0",
    "panda-slide": "dmprl/PandaSlide-v0",
    "panda-slide-dense": "dmprl/PandaSlideDense-v0",
    "panda-pick-and-place": "dmprl/PandaPickAndPlace-v0",
    "panda-pick-and-place-dense": "dmprl/PandaPickAndPlaceDense-v0",
    "panda-stack": "dmprl/PandaStack-v0",
    "panda-stack-dense": "dmprl/PandaStackDense-v0",
    "box-pushing": "dmprl/BoxPushingDense-v0",
    "box-pushing-sparse": "dmprl/BoxPushingTemporalSparse-v0",
    "reacher-v1": "dmprl/Reacher-v1",
    "pusher-v0": "dmprl/Pusher-v0",
    "thrower-v0": "dmprl/Thrower-v0",
}
"""Gymnasium ids by their names in ``dmprl tasks``."""


def make(task: str, **options: Any) -> "gymnasium.Env":
    """Creates the Gymnasium environment of a task, by its short name or any Gymnasium id.

    :param options: arguments of ``gymnasium.make``, such as ``render_mode="rgb_array"``.
    """
    import gymnasium

    return gymnasium.make(SHORT_NAMES.get(task, task), **options)


def _register() -> None:
    try:
        from gymnasium import register
    except ModuleNotFoundError:
        return  # a policy can be used without Gymnasium

    from dmprl.tasks import TASKS

    for task_id, entry in TASKS.items():
        register(
            task_id,
            "dmprl.task_env:TaskEnv",
            max_episode_steps=entry.episode_steps,
            kwargs={"task_id": task_id},
        )


_register()

"""A peer of ``dmprl bench peers``: trains another library's agent until a target.

``python agent_peer.py sb3-td3|… --settings FILE --package FOLDER`` writes one JSON object a line.
The first is ``{"ready": "description"}``, or ``{"absent": "why"}`` if it cannot. One follows each
evaluation, and one ends the training, with ``"ended": true``. It ends with its input, so the death
of the program that started it ends it too.
"""

import argparse
import importlib
import json
import math
import os
import signal
import sys
import threading
import time
from pathlib import Path

STARTED = time.monotonic()
NOISE = 0.1
"""Standard deviation of TD3's exploration, as in the RL Zoo. The library's default is none."""

EPISODE_STEPS_MAX = 10_000
"""Steps after which an evaluation ends an episode, as in dmprl."""

AGENTS = {
    "sb3-td3": ("stable_baselines3", "TD3"),
    "sb3-sac": ("stable_baselines3", "SAC"),
    "sbx-td3": ("sbx", "TD3"),
    "sbx-sac": ("sbx", "SAC"),
    "sbx-crossq": ("sbx", "CrossQ"),
    "sbx-simba": ("sbx", "SAC"),
    "sb3-tqc": ("sb3_contrib", "TQC"),
    "sb3-tqc-her": ("sb3_contrib", "TQC"),
}
WITH_HINDSIGHT = "sb3-tqc-her"
POLICIES = {WITH_HINDSIGHT: "MultiInputPolicy", "sbx-simba": "SimbaPolicy"}
"""Policies other than ``MlpPolicy``."""

ZOO_SETTINGS = {
    "batch_size": 2048,
    "buffer_size": 1_000_000,
    "gamma": 0.95,
    "learning_rate": 1e-3,
    "tau": 0.05,
    "policy_kwargs": {"net_arch": [512, 512, 512], "n_critics": 2},
}
"""Settings of the RL Zoo for TQC on the tasks of Fetch and the Panda that move an object."""

GOALS_PER_STEP = 4
"""Achieved goals that hindsight draws for each step, among those of later steps, as in the Zoo."""


class Evaluator:
    """Evaluates an agent without noise, on the seeds of dmprl's own evaluations."""

    def __init__(self, env, settings):
        self.env = env
        self.episodes = settings["episodes"]
        self.first_seed = settings["first_seed"]
        self.seconds = 0.0

    def evaluate(self, agent):
        """Returns mean return and success rate, or None if a return is not finite."""
        start = time.monotonic()
        episodes = [self.episode(agent, self.first_seed + index) for index in range(self.episodes)]
        self.seconds += time.monotonic() - start
        returns, successes = zip(*episodes, strict=True)
        rate = None if None in successes else sum(successes) / len(successes)
        mean = sum(returns) / len(returns)
        return {"return_mean": mean, "success_rate": rate} if math.isfinite(mean) else None

    def episode(self, agent, seed):
        """Runs one episode, and returns its return and success (None if none is reported)."""
        observation, _ = self.env.reset(seed=seed)
        total, success = 0.0, None
        for _ in range(EPISODE_STEPS_MAX):
            action, _ = agent.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            success = info.get("is_success", info.get("success", success))
            if terminated or truncated:
                break
        return total, None if success is None else float(success)


def make(kind, settings):
    """Returns the agent, and the environment for its evaluations."""
    module, name = AGENTS[kind]
    agents = importlib.import_module(module)
    import numpy as np

    from dmprl import bench_peers

    plan = {
        "task": {"id": settings["task"]},
        "options": settings["options"],
        "spec": {"episode_steps": 0},
    }
    shaped = with_time if kind == WITH_HINDSIGHT else flattened
    env, evaluated = (shaped(bench_peers.gymnasium_env(plan)) for _ in range(2))
    arguments = {"learning_starts": settings["learning_starts"], "seed": settings["seed"]}
    arguments["device"] = "cpu"  # as ours
    if name == "TD3":
        from stable_baselines3.common.noise import NormalActionNoise

        size = env.action_space.shape
        arguments["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, NOISE))
    if kind == WITH_HINDSIGHT:
        arguments |= ZOO_SETTINGS | hindsight()
    if settings["algorithm"] is not None:
        arguments |= ours(name, settings["algorithm"])
    policy = POLICIES.get(kind, "MlpPolicy")
    agent = getattr(agents, name)(policy, env, **arguments)
    return agent, evaluated, f"{module} {agents.__version__}"


def ours(name, algorithm):
    """Returns our settings as arguments of the library's algorithm."""
    arguments = {
        "policy_kwargs": {
            "net_arch": {"pi": algorithm["hidden"], "qf": algorithm["critic_hidden"]}
        },
        "batch_size": algorithm["batch_size"],
        "learning_rate": algorithm["learning_rate"],
        "gamma": algorithm["discount"],
        "train_freq": algorithm["steps"],
        "gradient_steps": algorithm["updates"],
    }
    if name != "CrossQ":  # which has no target networks
        arguments["tau"] = algorithm["polyak"]
    return arguments


def hindsight():
    """Returns the arguments for replaying steps with goals that were achieved later."""
    from stable_baselines3 import HerReplayBuffer

    goals = {"goal_selection_strategy": "future", "n_sampled_goal": GOALS_PER_STEP}
    return {"replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": goals}


def with_time(env):
    """Returns an environment that also observes the rest of the episode, as in the Zoo."""
    import gymnasium
    from sb3_contrib.common.wrappers import TimeFeatureWrapper

    if not isinstance(env.observation_space, gymnasium.spaces.Dict):
        raise ValueError("hindsight needs an environment with goals, as a Dict observation")
    return TimeFeatureWrapper(env)


def flattened(env):
    """Returns an environment whose observations are vectors, as in dmprl."""
    import gymnasium

    is_vector = isinstance(env.observation_space, gymnasium.spaces.Box)
    return env if is_vector else gymnasium.wrappers.FlattenObservation(env)


def reached(evaluated, target):
    """Returns whether an evaluation reaches a target.

    - ``target``: such as ``{"of": "return_mean", "value": -5.2}``
    """
    value = None if evaluated is None else evaluated[target["of"]]
    return value is not None and value >= target["value"]


def train(agent, evaluator, settings, send):
    """Trains until the target or a limit. Without a target, evaluates only the last policy."""
    from stable_baselines3.common.callbacks import BaseCallback

    interval, seconds_max = settings["evaluation_interval"], settings["seconds_max"]
    target = settings["target"]
    start_s = time.monotonic() - STARTED

    class Evaluations(BaseCallback):
        evaluated = None

        def _on_step(self):
            if target is not None and self.num_timesteps % interval == 0:
                self.evaluated = evaluator.evaluate(agent)
                self.send(ended=False)
                if reached(self.evaluated, target):
                    return False
            return time.monotonic() - STARTED < seconds_max

        def send(self, *, ended):
            send(
                {
                    "ended": ended,
                    "env_steps": self.num_timesteps,
                    "evaluated": self.evaluated,
                    "start_s": start_s,
                    "evaluation_s": evaluator.seconds,
                }
            )

    evaluations = Evaluations()
    agent.learn(settings["steps"], callback=evaluations)
    if target is None:
        evaluations.evaluated = evaluator.evaluate(agent)
    evaluations.send(ended=True)


def end_with_input():
    """Ends this process when the program that started it has ended."""
    for _ in sys.stdin:
        pass
    os._exit(1)


def main():
    """Speaks the protocol of the module's first lines."""
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=AGENTS)
    parser.add_argument("--settings", type=Path, required=True)
    parser.add_argument("--package", required=True, help="folder with the package dmprl")
    arguments = parser.parse_args()
    # Ctrl-C reaches the whole process group; the program that reads our lines decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Output of a library must not become a line of the protocol.
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    threading.Thread(target=end_with_input, daemon=True).start()
    settings = json.loads(arguments.settings.read_text())
    sys.path += [arguments.package, *settings["python_path"]]

    def send(line):
        print(json.dumps(line), file=lines)

    try:
        agent, env, about = make(arguments.kind, settings)
    except ImportError as error:
        why = f"{sys.executable} cannot import {error.name} ({error}); name an interpreter that has"
        send({"absent": f"{why} it with --peer-python"})
        return
    except Exception as error:  # such as an environment that the library does not take
        send({"absent": f"{type(error).__name__}: {error}"})
        return
    send({"ready": about})
    train(agent, Evaluator(env, settings), settings, send)


if __name__ == "__main__":
    main()

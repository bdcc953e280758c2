"""Writes ndp.safetensors, beside this file: one rollout, learned from in twenty whole passes.

    python make_golden_ndp.py

As make_golden.py, whose README describes the file. The rollout is one minibatch, so that the order
of its segments, which is left to chance, does not matter.
"""

from dataclasses import replace

import torch
from make_golden import BASE, UPDATES, check_conditioning, configuration, write
from ndp import CLIP, DISCOUNT, ENTROPY_COEFFICIENT, GAE_LAMBDA, GRADIENT_NORM_MAX, Ndp
from networks import flat

SEED = 20250617
SEGMENTS = 16
ENVIRONMENTS = 2
INITIAL_LOG_STD = -1.0
# Updates of which losses and gradients are kept. In the first no ratio differs from 1, and the
# policy's loss, a mean of advantages, is zero but for rounding and the segments cut short.
DETAILED = (1, 5)

CASE = replace(
    BASE,
    algorithm="ndp",
    start="observed",
    integrator="explicit",
    forcing_scaling="goal",
    controller="position",
    position_scale=2.0,
    critic_learning_rate=3e-3,
    actor_learning_rate=1e-2,
)


def keys():
    """Keys that differ from dmprl's defaults."""
    return configuration(CASE) | {
        "policy.controller": "position",
        "policy.position_scale": "2.0",
        "actors.workers": "1",
        "actors.envs_per_worker": str(ENVIRONMENTS),
        "algorithm.discount": str(DISCOUNT),
        "algorithm.critic_learning_rate": str(CASE.critic_learning_rate),
        "algorithm.actor_learning_rate": str(CASE.actor_learning_rate),
        "algorithm.ndp.clip": str(CLIP),
        "algorithm.ndp.gae_lambda": str(GAE_LAMBDA),
        "algorithm.ndp.rollout_segments": str(SEGMENTS),
        "algorithm.ndp.epochs": str(UPDATES),
        "algorithm.ndp.minibatches": "1",
        "algorithm.ndp.entropy_coefficient": str(ENTROPY_COEFFICIENT),
        "algorithm.ndp.gradient_norm_max": str(GRADIENT_NORM_MAX),
        "algorithm.ndp.learning_rate_decay": "none",
    }


def draw_rollout():
    """Segments of the environments in turn: whole ones, ended, and cut short in both ways."""
    steps, observation = CASE.steps, CASE.observation_len
    rollout = {
        "observations": 2 * torch.rand(SEGMENTS, steps + 1, observation) - 1,
        "actions": torch.zeros(SEGMENTS, steps, CASE.action_len),
        "rewards": 2 * torch.rand(SEGMENTS, steps) - 1,
        "steps_len": torch.full((SEGMENTS,), float(steps)),
        "terminated": torch.zeros(SEGMENTS),
        "truncated": torch.zeros(SEGMENTS),
        "environment": (torch.arange(SEGMENTS) % ENVIRONMENTS).float(),
        "episode": torch.zeros(SEGMENTS),
        "episode_step": torch.zeros(SEGMENTS),
    }
    rollout["terminated"][5], rollout["steps_len"][5] = 1, 3
    rollout["truncated"][8], rollout["steps_len"][8] = 1, 2
    rollout["terminated"][11] = 1
    for environment in range(ENVIRONMENTS):
        episode = step = 0
        for row in range(environment, SEGMENTS, ENVIRONMENTS):
            rollout["episode"][row], rollout["episode_step"][row] = episode, step
            step += int(rollout["steps_len"][row])
            if rollout["terminated"][row] or rollout["truncated"][row]:
                episode, step = episode + 1, 0
    return rollout


def draw():
    """Networks, and a rollout that their policy has drawn."""
    torch.manual_seed(SEED)
    ndp = Ndp(CASE, draw_rollout(), INITIAL_LOG_STD)
    with torch.no_grad():
        means, _, _ = ndp.actor(ndp.rollout["observations"][:, 0])
        noise = torch.randn(means.shape) * ndp.log_std.exp()
        ndp.rollout["actions"] = (means + noise) * ndp.taken()[..., None]
    return ndp


def in_double(ndp):
    """The same start in float64."""
    double = Ndp(CASE, {name: v.double() for name, v in ndp.rollout.items()}, INITIAL_LOG_STD)
    double.actor.load_state_dict(ndp.actor.state_dict())
    double.critic.load_state_dict(ndp.critic.state_dict())
    double.actor.double()
    double.critic.double()
    double.log_std = ndp.log_std.detach().double().requires_grad_()
    double.begin()
    return double


def run(ndp):
    """Makes all updates; returns the tensors of the file."""
    out = {f"initial.{name}": flat(values) for name, values in ndp.parameters.items()}
    out |= {f"rollout.{name}": values for name, values in ndp.rollout.items()}
    ndp.judge()
    out |= {f"judged.{name}": values for name, values in ndp.judged.items()}
    longest = [0.0, 0.0]
    for count in range(1, UPDATES + 1):
        ndp.update()
        longest = [max(pair) for pair in zip(longest, ndp.norms, strict=True)]
        if count in DETAILED:
            for name, loss in ndp.losses.items():
                if (count, name) != (1, "policy"):
                    out[f"update_{count}.loss.{name}"] = loss.detach().reshape(1)
            for name, gradients in ndp.gradients.items():
                out[f"update_{count}.gradient.{name}"] = flat(gradients)
        if count in (*DETAILED, UPDATES):
            for name, values in ndp.parameters.items():
                out[f"update_{count}.parameters.{name}"] = flat(values)
    # Else a clip would not be tested.
    assert ndp.clip_fraction > 0.1 and min(longest) > GRADIENT_NORM_MAX, longest
    return out


def main():
    """Writes the case."""
    torch.set_num_threads(1)
    ndp = draw()
    precise = in_double(ndp)
    result = run(ndp)
    check_conditioning("ndp", result, run(precise))
    write("ndp", result, keys(), SEED, "make_golden_ndp.py")


if __name__ == "__main__":
    main()

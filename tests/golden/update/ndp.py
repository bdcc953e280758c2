"""Neural Dynamic Policies (Bahl et al. 2020): PPO (Schulman et al. 2017) of a DMP policy.

A decision is a segment of K steps. Its actions are drawn around the position controller's, with one
learned standard deviation for each dimension; ratios are formed per step, value and advantage per
segment.
"""

import torch
from algorithms import adam
from networks import mlp
from policies import make_policy
from torch.distributions import Normal
from torch.nn.utils import clip_grad_norm_

CLIP = 0.1
GAE_LAMBDA = 0.95
DISCOUNT = 0.99
ENTROPY_COEFFICIENT = 0.01
GRADIENT_NORM_MAX = 0.25
DEVIATION_MIN = 1e-5


class Ndp:
    """Actor, log-std and value function, and the advantages at the start of a rollout."""

    def __init__(self, settings, rollout, initial_log_std):
        self.settings, self.rollout = settings, rollout
        self.actor = make_policy(settings)
        dims = settings.action_len
        self.log_std = torch.full((dims,), initial_log_std, requires_grad=True)
        self.critic = mlp(settings.observation_len, settings.critic_hidden, 1)
        self.losses, self.gradients = {}, {}
        self.begin()

    def begin(self):
        """Makes the optimisers, for the parameters as they are now."""
        self.policy_parameters = [*self.actor.parameters(), self.log_std]
        self.policy_adam = adam(self.policy_parameters, self.settings.actor_learning_rate)
        self.critic_adam = adam(self.critic.parameters(), self.settings.critic_learning_rate)

    @property
    def parameters(self):
        """Of every network by name."""
        return {
            "actor": list(self.actor.parameters()),
            "log_std": [self.log_std],
            "critic": list(self.critic.parameters()),
        }

    def value(self, observations):
        """V, (B,)."""
        return self.critic(observations)[:, 0]

    def log_densities(self):
        """Of every step of the rollout, (B, K)."""
        means, _, _ = self.actor(self.rollout["observations"][:, 0])
        return Normal(means, self.log_std.exp()).log_prob(self.rollout["actions"]).sum(-1)

    @torch.no_grad()
    def judge(self):
        """Values, generalised advantages over segments, and the acting policy's densities."""
        rollout = self.rollout
        steps = rollout["steps_len"].long()
        rows = torch.arange(len(steps))
        values = self.value(rollout["observations"][:, 0])
        last_values = self.value(rollout["observations"][rows, steps])
        discounts = DISCOUNT ** torch.arange(self.settings.steps)
        rewards = (rollout["rewards"] * discounts * self.taken()).sum(1)
        bootstrap = DISCOUNT**steps * (1 - rollout["terminated"])
        deltas = rewards + bootstrap * last_values - values
        advantages = deltas.clone()
        ended = (rollout["terminated"] + rollout["truncated"]) > 0
        for row in reversed(range(len(steps))):
            follower = self.follower(row)
            if follower is not None and not ended[row]:
                advantages[row] += bootstrap[row] * GAE_LAMBDA * advantages[follower]
        normalised = (advantages - advantages.mean()) / (advantages.std() + DEVIATION_MIN)
        self.judged = {
            "values": values,
            "last_values": last_values,
            "log_densities": self.log_densities(),
            "returns": advantages + values,
            "advantages": normalised,
        }

    def follower(self, row):
        """The segment of the same environment that came next, if any."""
        environment = self.rollout["environment"]
        later = [
            at for at in range(row + 1, len(environment)) if environment[at] == environment[row]
        ]
        return later[0] if later else None

    def taken(self):
        """1 for each step that was really run, (B, K)."""
        steps = torch.arange(self.settings.steps)
        return (steps < self.rollout["steps_len"][:, None]).to(self.rollout["rewards"].dtype)

    def update(self):
        """One step of all optimisers on the whole rollout."""
        ratio = (self.log_densities() - self.judged["log_densities"]).exp()
        advantages = self.judged["advantages"][:, None]
        clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
        gain = torch.minimum(ratio * advantages, clipped * advantages)
        taken = self.taken()
        policy_loss = -(gain * taken).sum() / taken.sum()
        entropy = Normal(0.0, self.log_std.exp()).entropy().sum()
        errors = self.value(self.rollout["observations"][:, 0]) - self.judged["returns"]
        value_loss = (errors**2).mean()
        self.clip_fraction = (((ratio - 1).abs() > CLIP) * taken).sum() / taken.sum()
        self.losses = {"policy": policy_loss, "value": value_loss, "entropy": entropy}
        self.policy_adam.zero_grad()
        self.critic_adam.zero_grad()
        (policy_loss - ENTROPY_COEFFICIENT * entropy + value_loss).backward()
        # Each with a norm of its own.
        self.norms = [
            clip_grad_norm_(self.policy_parameters, GRADIENT_NORM_MAX),
            clip_grad_norm_(self.critic.parameters(), GRADIENT_NORM_MAX),
        ]
        self.gradients = {
            name: [values.grad.clone() for values in parameters]
            for name, parameters in self.parameters.items()
        }
        self.policy_adam.step()
        self.critic_adam.step()

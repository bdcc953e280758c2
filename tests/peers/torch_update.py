"""The update in PyTorch, eager or compiled.

It is the golden implementation with the fastest parts that PyTorch has. Instead of 40 integration
steps the DMP is one product with the matrix that they amount to; Adam is the fused one; the targets
follow in one `foreach` call. Measured on pusher with one thread, each of these is faster than what
it replaces.
"""

import itertools
from dataclasses import replace

import torch
from algorithms import ALGORITHMS, Kit
from dmp import rollout
from policies import DmpPolicy, MlpPolicy

BATCHES = 16
WARM_UP_UPDATES = 8  # until nothing is compiled any more, TD3's updates without the actor included


class MappedDmpPolicy(DmpPolicy):
    """The movement as a product: (y0, yd0, g, w) of every dimension times one matrix."""

    def __init__(self, settings, extra_outputs=0):
        super().__init__(settings, extra_outputs)
        self.scaled = settings.forcing_scaling == "goal"
        self.register_buffer("matrix", segment_matrix(settings))

    def samples(self, y0, yd0, goal, weights):
        """As the stepped movement: three tensors (B, K, A)."""
        if self.scaled:
            weights = weights * (goal - y0)[..., None]
        inputs = torch.cat([torch.stack([y0, yd0, goal], dim=-1), weights], dim=-1)
        return (inputs @ self.matrix).transpose(1, 2).chunk(3, dim=1)


def segment_matrix(settings):
    """(3 + N, 3K): the movements that unit inputs make; they add up, since the map is linear."""
    unit = torch.eye(3 + settings.basis_count)[:, None]  # (3 + N) movements of one dimension
    y0, yd0, goal, weights = unit[..., 0], unit[..., 1], unit[..., 2], unit[..., 3:]
    # The factor g - y0 is applied to the weights instead.
    plain = replace(settings, forcing_scaling="none")
    return torch.cat(rollout(plain, y0, yd0, goal, weights), dim=1)[..., 0]


def make_policy(settings, extra_outputs=0):
    """The policy that the settings name."""
    kinds = {"mlp": MlpPolicy, "chunk": MlpPolicy, "dmp": MappedDmpPolicy}
    return kinds[settings.policy](settings, extra_outputs)


def fused_adam(parameters, learning_rate):
    """Adam in one pass over each tensor."""
    return torch.optim.Adam(parameters, lr=learning_rate, fused=True)


@torch.no_grad()
def follow_together(target, network, share):
    """Polyak averaging of all tensors in one call."""
    torch._foreach_lerp_(list(target.parameters()), list(network.parameters()), share)


KIT = Kit(make_policy, fused_adam, follow_together)


def draw_batches(settings):
    """Batches to take turns with."""
    rows, observation = settings.batch_size, settings.policy_observation_len
    inputs = observation + settings.critic_action_len
    for _ in range(BATCHES):
        critic_inputs = 2 * torch.rand(rows, inputs) - 1
        yield {
            "observations": critic_inputs[:, :observation].contiguous(),
            "critic_inputs": critic_inputs,
            "rewards": torch.randn(rows),
            "bootstrap": torch.full((rows,), 0.95),
            "next_observations": 2 * torch.rand(rows, observation) - 1,
        }


def make_compiled(settings, threads):
    """As ``make``, with losses, gradients and optimisers compiled by ``torch.compile``."""
    return make(settings, threads, compiled=True)


def make(settings, threads, *, compiled=False):
    """Returns a function that makes one update, and its description."""
    torch.set_num_threads(threads)
    torch.manual_seed(1)
    algorithm = ALGORITHMS[settings.algorithm](settings, KIT)
    batches = itertools.cycle(list(draw_batches(settings)))
    noise = {"td3": ["target_noise"], "sac": ["next_noise", "noise"]}
    drawn = noise.get(settings.algorithm, [])
    # The backward passes break it into several graphs, each of which is compiled.
    make_one = torch.compile(algorithm.update, dynamic=False) if compiled else algorithm.update
    shape = (settings.batch_size, settings.steps, settings.action_len)

    def update():
        batch = dict(next(batches))
        for name in drawn:
            batch[name] = torch.randn(shape)
        make_one(batch)

    if compiled:
        for _ in range(WARM_UP_UPDATES):
            update()
    how = "compiled" if compiled else "eager"
    return update, f"PyTorch {torch.__version__}, {how}, {torch.get_num_threads()} threads"

"""Multilayer perceptrons, and their parameters as the flat vector that dmprl stores."""

import torch
from torch import nn


def mlp(inputs, hidden, outputs, layer_norm=False):
    """ReLU layers and a linear last one, with PyTorch's default initialisation.

    With layer normalisation (Ba et al. 2016) before each ReLU, if asked for.
    """
    widths = [inputs, *hidden]
    layers = []
    for before, after in zip(widths, hidden, strict=False):
        layers += [nn.Linear(before, after)]
        layers += [nn.LayerNorm(after)] if layer_norm else []
        layers += [nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], outputs))


def flat(parameters):
    """Layer by layer, weight (out, in) row-major, then bias."""
    return torch.cat([values.detach().reshape(-1) for values in parameters])


def flat_gradient(parameters):
    """The gradients that the last backward pass left, in the same order."""
    return torch.cat([values.grad.reshape(-1) for values in parameters])


@torch.no_grad()
def follow(target, network, share):
    """Polyak averaging: target <- share * network + (1 - share) * target."""
    for slow, fast in zip(target.parameters(), network.parameters(), strict=True):
        slow.lerp_(fast, share)

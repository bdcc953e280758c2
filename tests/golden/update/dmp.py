"""The dynamic movement primitive by its differential equation, stepped with autograd.

Nothing here is the affine map that dmprl runs: every integration step is a tensor operation, and
the gradient goes back through all of them. Equations: section 2 of Ijspeert et al. 2013, with the
readings that shared/runtime/src/dmp/mod.rs lists (phase advanced before the basis is evaluated).
"""

import math

import torch


def features(settings):
    """phi_i(x_j) = x_j psi_i / sum psi for the steps j = 1..m, as nested lists in double."""
    count, alpha_x, steps = settings.basis_count, settings.alpha_x, settings.integration_steps
    centres = [math.exp(-alpha_x * i / (count - 1)) for i in range(count)]
    widths = [count**1.5 / (c * alpha_x) for c in centres]
    phase, rows = 1.0, []
    for _ in range(steps):
        phase -= alpha_x * phase / steps
        psi = [math.exp(-h * (phase - c) ** 2) for h, c in zip(widths, centres, strict=True)]
        rows.append([phase * value / sum(psi) for value in psi])
    return rows


def rollout(settings, y0, yd0, goal, weights):
    """Samples (y, yd, ydd) after every m/K-th step.

    y0, yd0, goal: (B, A). weights: (B, A, N). Returns three tensors (B, K, A).
    """
    count = settings.integration_steps
    dt = 1.0 / count
    alpha, beta = settings.alpha_y, settings.alpha_y / 4
    scale = goal - y0 if settings.forcing_scaling == "goal" else torch.ones_like(goal)
    phi = torch.tensor(features(settings), dtype=goal.dtype)
    y, yd, ydd = y0, yd0, torch.zeros_like(y0)
    samples = []
    for step in range(count):
        forcing = (weights * phi[step]).sum(-1) * scale
        acceleration = alpha * (beta * (goal - y) - yd) + forcing
        if settings.integrator == "semi_implicit":
            yd = yd + acceleration * dt
            y = y + yd * dt
        elif settings.integrator == "explicit":
            y, yd = y + yd * dt, yd + acceleration * dt
        else:  # "paper": the acceleration acts one step late
            y, yd = y + yd * dt, yd + ydd * dt
        ydd = acceleration
        if (step + 1) % (count // settings.steps) == 0:
            samples.append((y, yd, ydd))
    return tuple(torch.stack(kind, dim=1) for kind in zip(*samples, strict=True))


def starts(settings, observations):
    """(y0, yd0), each (B, A)."""
    dims = settings.action_len
    if settings.start == "zero":
        zero = observations.new_zeros(len(observations), dims)
        return zero, zero
    if settings.start in ("carry", "action"):
        at = settings.observation_len
        return observations[:, at : at + dims], observations[:, at + dims : at + 2 * dims]
    # DMP time runs 1 per segment, the robot's K control steps.
    segment_s = settings.steps * settings.control_dt_s
    speed = segment_s if settings.start_velocity == "measured" else 0.0
    y0, yd0 = [], []
    for source in settings.start_sources:
        if source.cos is None:
            y0.append(source.scale * observations[:, source.index])
        else:
            y0.append(torch.atan2(observations[:, source.sin], observations[:, source.cos]))
        yd0.append(speed * observations[:, source.velocity])
    return torch.stack(y0, dim=1), torch.stack(yd0, dim=1)

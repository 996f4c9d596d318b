"""The loss under three optimisers: as it comes, with clipped gradients, and with gradients in the unit of the targets.

The gradient of the loss as it comes is in 1 / unit of the target: it grows as the residuals shrink. A hook on the
prediction multiplies it by the square of the scale, which makes it as large as that of the mean squared error.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from mkc_torch import MKCLoss

ROWS, WIDTH, STEPS, BATCH, NOISE, WRONG = 600, 64, 1500, 64, 0.03, 0.2

OPTIMISERS: dict[str, tuple[Callable[..., torch.optim.Optimizer], dict[str, Any], tuple[float, ...]]] = {
    "SGD": (torch.optim.SGD, {}, (0.01, 0.1, 0.3)),
    "SGD, momentum 0.9": (torch.optim.SGD, {"momentum": 0.9}, (0.003, 0.01, 0.03)),
    "AdamW": (torch.optim.AdamW, {"weight_decay": 1e-2}, (0.003, 0.01)),
}
"""Class, options and learning rates."""

VARIANTS = ("MSE", "MKC", "MKC, clipped", "MKC, scaled")


def drawn(seed: int, wrong: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return inputs, targets of which a share is wrong, and the noise-free function."""
    generator = torch.Generator().manual_seed(seed)
    x = 12.0**0.5 * (torch.rand(ROWS, 3, generator=generator) - 0.5)
    truth = torch.sin(1.5 * x[:, :1]) + 0.5 * x[:, 1:2]
    target = truth + NOISE * torch.randn(ROWS, 1, generator=generator)
    rows = torch.randperm(ROWS, generator=generator)[: round(wrong * ROWS)]
    target[rows] += 3.0 + 7.0 * torch.rand(len(rows), 1, generator=generator)
    return x, target, truth


def outcome(variant: str, optimiser: str, rate: float, seed: int, wrong: float) -> tuple[float, float]:
    """Return the root mean square error against the noise-free function, and the largest norm of a gradient."""
    x, target, truth = drawn(seed, wrong)
    torch.manual_seed(seed)
    model = nn.Sequential(nn.Linear(3, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 1))
    loss = nn.MSELoss() if variant == "MSE" else MKCLoss(1)
    make, options, _ = OPTIMISERS[optimiser]
    own = loss.param_groups() if isinstance(loss, MKCLoss) else []
    steps = make([{"params": model.parameters()}, *own], lr=rate, **options)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(steps, STEPS)
    largest = 0.0
    for _ in range(STEPS):
        rows = torch.randint(ROWS, (BATCH,))
        steps.zero_grad()
        prediction = model(x[rows])
        if variant == "MKC, scaled" and isinstance(loss, MKCLoss):
            scale = loss.residual_scale
            prediction.register_hook(lambda gradient, scale=scale: gradient * scale.scale.square())
        loss(prediction, target[rows]).backward()
        limit = 1.0 if variant == "MKC, clipped" else math.inf
        largest = max(largest, float(nn.utils.clip_grad_norm_(model.parameters(), limit)))
        steps.step()
        schedule.step()
    with torch.no_grad():
        return float((model(x) - truth).square().mean().sqrt()), largest


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each optimiser and learning rate, with and without wrong targets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--optimisers", nargs="+", default=list(OPTIMISERS), choices=list(OPTIMISERS))
    chosen = parser.parse_args(arguments)
    print("| wrong targets | optimiser | learning rate | " + " | ".join(VARIANTS) + " |")
    print("|---|---|---:|" + "---:|" * len(VARIANTS))
    for wrong in (0.0, WRONG):
        for name in chosen.optimisers:
            for rate in OPTIMISERS[name][2]:
                cells = []
                for variant in VARIANTS:
                    runs = [outcome(variant, name, rate, seed, wrong) for seed in range(chosen.seeds)]
                    error, norm = (statistics.fmean(values) for values in zip(*runs, strict=True))
                    cells.append(f"{error:.3f} ({norm:.2g})")
                print(f"| {wrong:.0%} | {name} | {rate} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()

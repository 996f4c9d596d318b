"""Targets of any unit and offset, a fifth of them wrong: the loss with its default settings.

The last layer of the network has the unit of the target, as in a model of a physical quantity; the loss has not.
"""

from __future__ import annotations

import argparse
import itertools

import torch
from peers import perceptron
from torch import Tensor, nn

from mkc_torch import MKCLoss

ROWS, STEPS, LONG, NOISE = 600, 600, 4000, 0.3
SCALES, OFFSETS = (1e-6, 1e-3, 1.0, 1e3, 1e6), (0.0, 100.0)


class InUnit(nn.Module):
    """A perceptron whose output is scaled by a unit and shifted by an offset."""

    def __init__(self, scale: float, offset: float) -> None:
        super().__init__()
        self.net, self.scale, self.offset = perceptron(3, 32, 1), scale, offset

    def forward(self, x: Tensor) -> Tensor:
        answer: Tensor = self.net(x) * self.scale + self.offset
        return answer


def drawn(seed: int, share: float) -> tuple[Tensor, Tensor, Tensor]:
    """Draw inputs, the truth, and targets of which a share is uniform in [-10, 10]."""
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(ROWS, 3, generator=g)
    truth = torch.sin(4.0 * x[:, :1]) + x[:, 1:2] * x[:, 2:]
    target = truth + NOISE * torch.randn(ROWS, 1, generator=g)
    wrong = torch.rand(ROWS, 1, generator=g) < share
    return x, truth, torch.where(wrong, 20.0 * torch.rand(ROWS, 1, generator=g) - 10.0, target)


def error(
    loss: nn.Module, seed: int, share: float, scale: float = 1.0, offset: float = 0.0, *, steps: int = STEPS
) -> float:
    """Return the RMS error against the truth after training, over the scale."""
    x, truth, target = drawn(seed, share)
    torch.manual_seed(seed)
    model = InUnit(scale, offset * scale)
    groups = [{"params": list(model.parameters())}]
    groups += loss.param_groups(lr=1e-2) if isinstance(loss, MKCLoss) else []
    optimiser = torch.optim.Adam(groups, lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        optimiser.zero_grad()
        loss(model(x), target * scale + offset * scale).backward()
        optimiser.step()
        schedule.step()
    with torch.no_grad():
        return float((model(x) - offset * scale - truth * scale).square().mean().sqrt()) / scale


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    seeds = range(parser.parse_args().seeds)
    plain = [error(MKCLoss(1), seed, 0.2) for seed in seeds]
    print(f"20 % wrong targets; error over the unit, over that of targets of scale 1 and offset 0; {len(seeds)} seeds")
    print(f"{'scale':>8} {'offset, in scales':>18} {'mean':>8} {'worst':>8}")
    for scale, offset in itertools.product(SCALES, OFFSETS):
        ratios = [error(MKCLoss(1), seed, 0.2, scale, offset) / plain[seed] for seed in seeds]
        print(f"{scale:8g} {offset:18g} {sum(ratios) / len(ratios):8.3f} {max(ratios):8.3f}")
    ours, squares = (
        torch.tensor([error(make(), seed, 0.0, steps=LONG) for seed in seeds]).square().mean().sqrt()
        for make in (lambda: MKCLoss(1), nn.MSELoss)
    )
    print(f"\nGaussian noise alone, {LONG} steps: {ours:.4f}, of the mean squared error {squares:.4f}")


if __name__ == "__main__":
    main()

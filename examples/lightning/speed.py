"""Time of forward and backward passes of the loss and of PyTorch's losses, interleaved in one run.

    python examples/lightning/speed.py [--device cpu] [--rounds 15]

Prints milliseconds (the median of the rounds) and ratios: 4 million elements, and a batch of 256 × 4.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from peers import LearnedGaussianNLL
from torch import nn

from mkc_torch import MKCLoss


def milliseconds(step: Callable[[], None], times: int, device: torch.device) -> float:
    started = time.perf_counter()
    for _ in range(times):
        step()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return 1e3 * (time.perf_counter() - started) / times


def measured(
    losses: dict[str, nn.Module], rows: int, times: int, rounds: int, device: torch.device
) -> dict[str, float]:
    """Return the median time of a forward and backward pass of each loss; the losses are interleaved."""
    generator = torch.Generator().manual_seed(0)
    target = torch.randn(rows, 4, generator=generator).to(device)
    input = (target + torch.randn(rows, 4, generator=generator).to(device)).requires_grad_()

    def step(loss: nn.Module) -> Callable[[], None]:
        def run() -> None:
            input.grad = None
            loss.zero_grad()
            loss(input, target).backward()

        return run

    steps = {name: step(loss.to(device)) for name, loss in losses.items()}
    for run in steps.values():
        milliseconds(run, times, device)
    taken: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(rounds):
        for name, run in steps.items():
            taken[name].append(milliseconds(run, times, device))
    return {name: statistics.median(values) for name, values in taken.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args()
    device = torch.device(options.device)
    losses = {
        "HuberLoss": nn.HuberLoss(),
        "GaussianNLLLoss, learned variance": LearnedGaussianNLL(4),
        "MKCLoss, sigma and d fixed": MKCLoss(4, d=1.0, learn_sigma=False, learn_d=False),
        "MKCLoss, learned": MKCLoss(4, d=1.0),
        "MKCLoss, as it comes": MKCLoss(4),
    }
    for title, rows, times in (("4 million elements", 1_000_000, 1), ("a batch of 256 x 4", 256, 200)):
        found = measured(losses, rows, times, options.rounds, device)
        huber, gaussian = found["HuberLoss"], found["GaussianNLLLoss, learned variance"]
        print(f"\n{title}, float32, {device}, {torch.get_num_threads()} threads")
        print(f"{'':36} {'ms':>9} {'over Huber':>11} {'over Gaussian':>14}")
        for name, value in found.items():
            print(f"{name:36} {value:9.3f} {value / huber:11.2f} {value / gaussian:14.2f}")


if __name__ == "__main__":
    main()

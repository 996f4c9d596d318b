"""A network of two outputs, one of them with 25 % one-sided outliers: the error against the clean function.

    python examples/lightning/heavy_tailed_channel.py [--seeds 5] [--epochs 25] [--curve PICTURE.png]

Prints the error of each loss over that of the mean squared error, σ and d of MKC-EM, and the same for clean Gaussian
targets; with ``--curve`` also errors over 0-40 % outliers, as a picture.
"""

from __future__ import annotations

import argparse

import torch
from peers import MKC_AUTO, MKC_EM, MKC_JOINT, Regression, losses, perceptron, quiet, train
from torch import Tensor

from mkc_torch import MKCLoss

SAMPLES, NOISE = 2000, 0.1
SHARES = (0.0, 0.1, 0.2, 0.3, 0.4)

LOSSES = losses(2, bound=20.0)


def clean(x: Tensor) -> Tensor:
    """Two smooth functions of four inputs in [-1, 1]."""
    a, b, c, d = x.unbind(-1)
    return torch.stack([torch.sin(3.0 * a) + b.square(), c * d + torch.cos(2.0 * a)], -1)


def sample(share: float, seed: int) -> tuple[Tensor, Tensor]:
    """Draw inputs and targets; a share of the second channel's targets is 1 to 10 too high."""
    generator = torch.Generator().manual_seed(seed)
    x = 2.0 * torch.rand(SAMPLES, 4, generator=generator) - 1.0
    y = clean(x) + NOISE * torch.randn(SAMPLES, 2, generator=generator)
    hit = torch.rand(SAMPLES, generator=generator) < share
    y[:, 1] += hit * (1.0 + 9.0 * torch.rand(SAMPLES, generator=generator))
    return x, y


def trained(name: str, share: float, seed: int, epochs: int) -> Regression:
    """Train the network with a loss."""
    torch.manual_seed(seed)
    module = Regression(perceptron(4, 64, 64, 2), LOSSES[name]())
    train(module, *sample(share, seed), epochs=epochs)
    return module


@torch.no_grad()
def errors(module: Regression) -> Tensor:
    """Return the RMS error of both channels (2,) against the clean function, on new inputs."""
    x = 2.0 * torch.rand(4000, 4, generator=torch.Generator().manual_seed(10_000)) - 1.0
    out: Tensor = (module.net(x) - clean(x)).square().mean(0).sqrt()
    return out


def table(share: float, seeds: int, epochs: int) -> None:
    """Print a table of the losses."""
    print(f"\n{share:.0%} one-sided outliers in the second channel, {seeds} seeds, {epochs} epochs")
    print(f"{'loss':16} {'clean channel':>14} {'dirty channel':>14} {'both, over MSE':>15}")
    reference = 0.0
    for name in LOSSES:
        modules = [trained(name, share, seed, epochs) for seed in range(seeds)]
        each = torch.stack([errors(m) for m in modules]).square().mean(0).sqrt()
        both = float(each.square().mean().sqrt())
        reference = reference or both
        print(f"{name:16} {float(each[0]):14.4f} {float(each[1]):14.4f} {both / reference:15.3f}")
        if name in (MKC_EM, MKC_JOINT, MKC_AUTO):
            own = [m.criterion for m in modules if isinstance(m.criterion, MKCLoss)]
            sigma, d = (torch.stack([getattr(c, key).detach() for c in own]).median(0).values for key in ("sigma", "d"))
            print(f"{'':16} sigma {sigma[0]:.3g}, {sigma[1]:.3g}; d {d[0]:.3g}, {d[1]:.3g}")


def curve(path: str, seeds: int, epochs: int) -> None:
    """Draw the errors over the share of outliers."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.subplots()
    for name in LOSSES:
        values = [
            torch.stack([errors(trained(name, share, seed, epochs)) for seed in range(seeds)]).square().mean().sqrt()
            for share in SHARES
        ]
        print(f"{name:16} " + " ".join(f"{float(v):8.4f}" for v in values))
        axes.semilogy([100.0 * s for s in SHARES], [float(v) for v in values], "o-", label=name)
    axes.set_xlabel("one-sided outliers in one of two channels (%)")
    axes.set_ylabel("error against the clean function")
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--epochs", type=int, default=25)
    parser.add_argument("--curve", metavar="PICTURE.png")
    options = parser.parse_args()
    quiet()
    for share in (0.25, 0.0):
        table(share, options.seeds, options.epochs)
    if options.curve:
        print("\nerror over 0, 10, 20, 30 and 40 % outliers")
        curve(options.curve, options.seeds, options.epochs)


if __name__ == "__main__":
    main()

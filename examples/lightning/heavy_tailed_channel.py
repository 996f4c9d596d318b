"""A network of two outputs, one of them with 25 % one-sided outliers: the error against the clean function.

    python examples/lightning/heavy_tailed_channel.py [--seeds 5] [--epochs 25] [--curve PICTURE.png]

Prints the error of each loss over that of the mean squared error, σ and d of MKC-EM, and the same for clean Gaussian
targets; with ``--curve`` also errors over 0-40 % outliers, as a picture.
"""

from __future__ import annotations

import argparse
import logging
import math
import warnings
from collections.abc import Callable
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor, nn
from torch.utils.data import DataLoader, TensorDataset

from mkc_torch import MKCLoss
from mkc_torch.lightning import MKCExpectationMaximization

SAMPLES, NOISE = 2000, 0.1
SHARES = (0.0, 0.1, 0.2, 0.3, 0.4)

MKC_EM, MKC_JOINT = "MKC, EM", "MKC, joint"


class LearnedGaussianNLL(nn.Module):
    """torch.nn.GaussianNLLLoss with one learned variance for each channel."""

    def __init__(self, num_channels: int) -> None:
        super().__init__()
        self.log_variance = nn.Parameter(torch.zeros(num_channels))
        self._nll = nn.GaussianNLLLoss()

    def forward(self, input: Tensor, target: Tensor) -> Tensor:
        variance: Tensor = self.log_variance.exp().expand_as(input)
        loss: Tensor = self._nll(input, target, variance)
        return loss


class StudentTNLL(nn.Module):
    """Negative log-likelihood of Student's t with learned degrees of freedom and scale for each channel."""

    def __init__(self, num_channels: int) -> None:
        super().__init__()
        self.log_freedom = nn.Parameter(torch.full((num_channels,), math.log(5.0)))
        self.log_scale = nn.Parameter(torch.zeros(num_channels))

    def forward(self, input: Tensor, target: Tensor) -> Tensor:
        freedom = 1.0 + self.log_freedom.exp()
        density = torch.distributions.StudentT(freedom, input, self.log_scale.exp())
        return -density.log_prob(target).mean()


class AdaptiveLoss(nn.Module):
    """The general adaptive robust loss with learned shape α in (0, 2) and scale c for each channel.

    Barron, "A General and Adaptive Robust Loss Function", CVPR 2019, (13)-(16); the normaliser by the trapezoidal rule.
    """

    def __init__(self, num_channels: int) -> None:
        super().__init__()
        self.raw_shape = nn.Parameter(torch.zeros(num_channels))
        self.log_scale = nn.Parameter(torch.zeros(num_channels))
        reach = torch.linspace(0.0, math.asinh(1e4), 2001, dtype=torch.float64).sinh()
        self.register_buffer("nodes", torch.cat([-reach.flip(0)[:-1], reach]).float(), persistent=False)

    @staticmethod
    def rho(z: Tensor, shape: Tensor) -> Tensor:
        far = (2.0 - shape).clamp(min=1e-3)
        return far / shape * ((z.square() / far + 1.0).pow(0.5 * shape) - 1.0)

    def forward(self, input: Tensor, target: Tensor) -> Tensor:
        shape = 0.01 + 1.98 * torch.sigmoid(self.raw_shape)
        scale = self.log_scale.exp()
        nodes: Tensor = self.nodes  # type: ignore[assignment]
        density = torch.exp(-self.rho(nodes.unsqueeze(-1), shape))
        log_z = torch.trapezoid(density, nodes, dim=0).log()
        return (self.rho((input - target) / scale, shape) + scale.log() + log_z).mean()


LOSSES: dict[str, Callable[[], nn.Module]] = {
    "MSE": nn.MSELoss,
    "Huber": nn.HuberLoss,
    "Gaussian NLL": lambda: LearnedGaussianNLL(2),
    "Student t": lambda: StudentTNLL(2),
    "adaptive": lambda: AdaptiveLoss(2),
    MKC_EM: lambda: MKCLoss(2, bound=20.0, learn_sigma=False, learn_d=False, normalize=True),
    MKC_JOINT: lambda: MKCLoss(2, bound=20.0),
}


def clean(x: Tensor) -> Tensor:
    """Two smooth functions of four inputs in [-1, 1]."""
    a, b, c, d = x.unbind(-1)
    return torch.stack([torch.sin(3.0 * a) + b.square(), c * d + torch.cos(2.0 * a)], -1)


def sample(share: float, seed: int) -> tuple[Tensor, Tensor]:
    """Inputs and targets; that share of the second channel's targets is 1 to 10 too high."""
    generator = torch.Generator().manual_seed(seed)
    x = 2.0 * torch.rand(SAMPLES, 4, generator=generator) - 1.0
    y = clean(x) + NOISE * torch.randn(SAMPLES, 2, generator=generator)
    hit = torch.rand(SAMPLES, generator=generator) < share
    y[:, 1] += hit * (1.0 + 9.0 * torch.rand(SAMPLES, generator=generator))
    return x, y


class Regression(LightningModule):
    """A small perceptron with the loss to be tried; the loss's own parameters are learned with it, if it has any."""

    def __init__(self, criterion: nn.Module) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(4, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 2))
        self.criterion = criterion

    def training_step(self, batch: tuple[Tensor, Tensor], batch_idx: int) -> Tensor:  # noqa: ARG002
        x, y = batch
        loss: Tensor = self.criterion(self.net(x), y)
        return loss

    def configure_optimizers(self) -> torch.optim.Optimizer:
        groups: list[dict[str, Any]] = [{"params": self.net.parameters()}]
        if list(self.criterion.parameters()):
            groups.append({"params": self.criterion.parameters(), "lr": 3e-2})
        return torch.optim.Adam(groups, lr=5e-3)


def trained(name: str, share: float, seed: int, epochs: int) -> Regression:
    """The network after training with a loss."""
    torch.manual_seed(seed)
    module = Regression(LOSSES[name]())
    loader = DataLoader(TensorDataset(*sample(share, seed)), batch_size=64, shuffle=True)
    callbacks: list[Callback] = [MKCExpectationMaximization(log=False)] if name == MKC_EM else []
    trainer = Trainer(
        max_epochs=epochs,
        accelerator="cpu",
        callbacks=callbacks,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(module, loader)
    return module


@torch.no_grad()
def errors(module: Regression) -> Tensor:
    """Root mean square against the clean function of both channels, on inputs of its own (2,)."""
    x = 2.0 * torch.rand(4000, 4, generator=torch.Generator().manual_seed(10_000)) - 1.0
    out: Tensor = (module.net(x) - clean(x)).square().mean(0).sqrt()
    return out


def table(share: float, seeds: int, epochs: int) -> None:
    """Print the losses side by side."""
    print(f"\n{share:.0%} one-sided outliers in the second channel, {seeds} seeds, {epochs} epochs")
    print(f"{'loss':14} {'clean channel':>14} {'dirty channel':>14} {'both, over MSE':>15}")
    reference = 0.0
    for name in LOSSES:
        modules = [trained(name, share, seed, epochs) for seed in range(seeds)]
        each = torch.stack([errors(m) for m in modules]).square().mean(0).sqrt()
        both = float(each.square().mean().sqrt())
        reference = reference or both
        print(f"{name:14} {float(each[0]):14.4f} {float(each[1]):14.4f} {both / reference:15.3f}")
        if name in (MKC_EM, MKC_JOINT):
            own = [m.criterion for m in modules if isinstance(m.criterion, MKCLoss)]
            sigma, d = (torch.stack([getattr(c, key).detach() for c in own]).median(0).values for key in ("sigma", "d"))
            print(f"{'':14} sigma {sigma[0]:.3g}, {sigma[1]:.3g}; d {d[0]:.3g}, {d[1]:.3g}")


def curve(path: str, seeds: int, epochs: int) -> None:
    """Errors over the share of outliers, as a picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.subplots()
    for name in LOSSES:
        values = [
            torch.stack([errors(trained(name, share, seed, epochs)) for seed in range(seeds)]).square().mean().sqrt()
            for share in SHARES
        ]
        print(f"{name:14} " + " ".join(f"{float(v):8.4f}" for v in values))
        axes.semilogy([100.0 * s for s in SHARES], [float(v) for v in values], "o-", label=name)
    axes.set_xlabel("one-sided outliers in one of two channels (%)")
    axes.set_ylabel("error against the clean function")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--epochs", type=int, default=25)
    parser.add_argument("--curve", metavar="PICTURE.png")
    options = parser.parse_args()
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    torch.set_num_threads(1)  # the arrays are small
    for share in (0.25, 0.0):
        table(share, options.seeds, options.epochs)
    if options.curve:
        print("\nerror over 0, 10, 20, 30 and 40 % outliers")
        curve(options.curve, options.seeds, options.epochs)


if __name__ == "__main__":
    main()

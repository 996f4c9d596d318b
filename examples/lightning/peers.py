"""Shared by the examples: the losses compared with MKC, and the training."""

from __future__ import annotations

import itertools
import logging
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor, nn
from torch.utils.data import DataLoader, TensorDataset

from mkc_torch import MKCLoss
from mkc_torch.lightning.callback import MKCExpectationMaximization

MKC_EM, MKC_JOINT, MKC_AUTO = "MKC, EM", "MKC, joint", "MKC, as it comes"


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

    def log_partition(self, shape: Tensor) -> Tensor:
        """Logarithm of the integral of exp(-rho) for each shape."""
        nodes: Tensor = self.nodes  # type: ignore[assignment]
        return torch.trapezoid(torch.exp(-self.rho(nodes.unsqueeze(-1), shape)), nodes, dim=0).log()

    def forward(self, input: Tensor, target: Tensor) -> Tensor:
        shape = 0.01 + 1.98 * torch.sigmoid(self.raw_shape)
        scale = self.log_scale.exp()
        return (self.rho((input - target) / scale, shape) + scale.log() + self.log_partition(shape)).mean()


def losses(num_channels: int, bound: float) -> dict[str, Callable[[], nn.Module]]:
    """Return constructors of the compared losses, with the defaults of their documentation.

    Args:
        num_channels: number of outputs.
        bound: bound of MKC in the unit of the targets: the largest possible error.
    """
    return {
        "MSE": nn.MSELoss,
        "Huber": nn.HuberLoss,
        "Gaussian NLL": lambda: LearnedGaussianNLL(num_channels),
        "Student t": lambda: StudentTNLL(num_channels),
        "adaptive": lambda: AdaptiveLoss(num_channels),
        MKC_EM: lambda: MKCLoss(num_channels, bound=bound, learn_sigma=False, learn_d=False, normalize=True),
        MKC_JOINT: lambda: MKCLoss(num_channels, d=1.0, bound=bound),
        MKC_AUTO: lambda: MKCLoss(num_channels),
    }


class Regression(LightningModule):
    """A network and its loss; learnable parameters of the loss are trained, too.

    Args:
        net: the network; its output is what the loss takes first.
        criterion: the loss.
        weight_decay: weight decay of the network only.
        annealed: whether the learning rate follows a cosine to 0, or is constant.
    """

    def __init__(
        self, net: nn.Module, criterion: nn.Module, *, weight_decay: float = 0.0, annealed: bool = False
    ) -> None:
        super().__init__()
        self.net = net
        self.criterion = criterion
        self.weight_decay = weight_decay
        self.annealed = annealed

    def training_step(self, batch: tuple[Tensor, Tensor], batch_idx: int) -> Tensor:  # noqa: ARG002 - signature of Lightning
        x, y = batch
        loss: Tensor = self.criterion(self.net(x), y)
        return loss

    def configure_optimizers(self) -> Any:
        groups: list[dict[str, Any]] = [{"params": self.net.parameters(), "weight_decay": self.weight_decay}]
        if list(self.criterion.parameters()):
            groups.append({"params": self.criterion.parameters(), "lr": 3e-2, "weight_decay": 0.0})
        optimiser = torch.optim.AdamW(groups, lr=5e-3)
        if not self.annealed:
            return optimiser
        return [optimiser], [torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, self.trainer.max_epochs or 1)]


def perceptron(*sizes: int) -> nn.Sequential:
    """Linear layers of these sizes with tanh between them."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Linear(before, after), nn.Tanh()]
    return nn.Sequential(*layers[:-1])


def train(module: Regression, x: Tensor, y: Tensor, *, epochs: int) -> None:
    """Train on batches of 64; an MKC loss with fixed σ and d uses the callback of MKC-EM."""
    owns = isinstance(module.criterion, MKCLoss) and not list(module.criterion.parameters())
    callbacks: list[Callback] = [MKCExpectationMaximization(log=False)] if owns else []
    trainer = Trainer(
        max_epochs=epochs,
        accelerator="cpu",
        callbacks=callbacks,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(module, DataLoader(TensorDataset(x, y), batch_size=64, shuffle=True))


def quiet() -> None:
    """Use one thread, because the arrays are small, and silence Lightning's hints."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    torch.set_num_threads(1)


def mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean over seeds and its standard error, NaN for one seed."""
    each = torch.tensor(values, dtype=torch.float64)
    return float(each.mean()), float(each.std()) / math.sqrt(len(values)) if len(values) > 1 else math.nan

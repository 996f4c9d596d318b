"""Losses that networks are trained with where targets have outliers, each as a user would take it."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

__all__ = ["AdaptiveLoss", "LearnedGaussianNLL", "StudentTNLL"]


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

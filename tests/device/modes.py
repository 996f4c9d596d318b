"""Modes of the loss, comparable losses, timing, and the rate of memory traffic."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from mkc_torch import MKCLoss

FIXED: dict[str, Any] = {"d": 1.0, "sigma": 2.0, "learn_sigma": False, "learn_d": False}
MODES: dict[str, dict[str, Any]] = {"fixed": FIXED, "learned": {"d": 1.0}, "default": {}}


class LearnedGaussianNLL(nn.Module):
    """GaussianNLLLoss with a learned variance per channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.raw = nn.Parameter(torch.zeros(channels))
        self.loss = nn.GaussianNLLLoss()

    def forward(self, input: Tensor, target: Tensor) -> Tensor:
        value: Tensor = self.loss(input, target, self.raw.exp().expand_as(input))
        return value


class LearnedStudentT(nn.Module):
    """Student's t with learned degrees of freedom and scale for each channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.log_freedom, self.log_scale = (nn.Parameter(torch.zeros(channels)) for _ in range(2))

    def forward(self, input: Tensor, target: Tensor) -> Tensor:
        freedom, scale = 1.0 + self.log_freedom.exp(), self.log_scale.exp()
        z = (input - target) / scale
        norm = torch.lgamma(0.5 * freedom) - torch.lgamma(0.5 * (freedom + 1.0)) + 0.5 * (freedom * torch.pi).log()
        return (norm + scale.log() + 0.5 * (freedom + 1.0) * torch.log1p(z.square() / freedom)).mean()


@dataclass
class Step:
    """Forward and backward pass of a loss on a batch, including the fill of the upstream gradient."""

    loss: Callable[..., Tensor]
    parameters: list[nn.Parameter]
    input: Tensor
    target: Tensor
    weight: Tensor | None = None
    upstream: Tensor | None = None

    def __call__(self) -> Tensor:
        self.input.grad = None
        for parameter in self.parameters:
            parameter.grad = None
        given = (self.input, self.target) if self.weight is None else (self.input, self.target, self.weight)
        value = self.loss(*given)
        if self.upstream is None:
            value.backward()
        else:
            value.backward(self.upstream)
        return value


def batch(rows: int, channels: int, device: torch.device, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """Predictions that require a gradient, and targets."""
    generator = torch.Generator(device).manual_seed(0)
    size = (rows, channels)
    input, target = (torch.randn(size, generator=generator, device=device, dtype=torch.float32).to(dtype) for _ in "ab")
    return input.requires_grad_(), target


def synchronise(device: torch.device) -> None:
    """Wait for the device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def median_seconds(step: Callable[[], object], device: torch.device, *, budget: float = 0.4, least: int = 5) -> float:
    """Median seconds of a step, over groups of steps within ``budget`` seconds."""
    for _ in range(3):
        step()
    synchronise(device)
    start = time.perf_counter()
    step()
    synchronise(device)
    once = max(time.perf_counter() - start, 1e-6)
    group = max(1, min(50, int(0.02 / once)))
    found: list[float] = []
    until = time.perf_counter() + budget
    while len(found) < least or time.perf_counter() < until:
        start = time.perf_counter()
        for _ in range(group):
            step()
        synchronise(device)
        found.append((time.perf_counter() - start) / group)
        if len(found) > 200:
            break
    return statistics.median(found)


def copy_rate(device: torch.device, size: int) -> float:
    """Bytes read and written per second by a copy of ``size`` float32 numbers."""
    source = torch.empty(size, device=device).normal_()
    out = torch.empty_like(source)
    return 8.0 * size / median_seconds(lambda: out.copy_(source), device, budget=0.2)


def make_loss(name: str, channels: int, device: torch.device, **options: Any) -> MKCLoss:
    """The loss in a mode."""
    return MKCLoss(channels, **{**MODES[name], **options}).to(device)

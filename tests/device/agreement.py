"""Values and gradients on a device against the CPU's in float64."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from mkc_torch import MKCLoss
from tests.device.modes import MODES

SHAPES: tuple[tuple[tuple[int, ...], int], ...] = (
    ((256, 4), -1),
    ((1000, 1), -1),
    ((333, 7), -1),
    ((5, 3, 16, 17), 1),
    ((50_000, 3), -1),
    ((64, 1000), -1),
    ((200_001, 1), -1),
)
TOLERANCE = {torch.float32: 3e-5, torch.float64: 1e-7, torch.bfloat16: 2e-2, torch.float16: 4e-3}
"""Greatest difference over the greatest number, by the dtype of the predictions."""


def found(loss: MKCLoss, input: Tensor, target: Tensor, weight: Tensor | None) -> list[Tensor]:
    """Value and gradients of the second of two batches, under an upstream gradient that is not 1."""
    for _ in range(2):
        leaf = input.clone().requires_grad_()
        for parameter in loss.parameters():
            parameter.grad = None
        value = loss(leaf, target, weight)
        # as a gradient scaler has it: float16 has no digits for a mean over many elements
        value.backward(torch.full_like(value, 1700.0 if input.dtype == torch.float16 else 1.7))
    assert leaf.grad is not None
    grads = [p.grad for p in loss.parameters() if p.grad is not None]
    return [one.detach().cpu().double() for one in (value, leaf.grad, *grads)]


def cases() -> Iterator[tuple[str, dict[str, Any], tuple[int, ...], int, str, bool, torch.dtype]]:
    """Mode, options, shape, dimension of the channels, reduction, whether weighted, dtype."""
    for (name, options), (shape, axis), reduction in itertools.product(
        MODES.items(), SHAPES, ("mean", "sum", "none")
    ):
        for weighted, dtype in itertools.product((False, True), TOLERANCE):
            if reduction != "mean" and (dtype in (torch.float16, torch.float64) or shape[0] > 1000):
                continue
            yield name, options, shape, axis, reduction, weighted, dtype


def print_agreement(device: torch.device) -> bool:
    """Print the worst difference of each dtype; whether all are within the tolerances."""
    worst: dict[torch.dtype, tuple[float, str]] = {}
    right = True
    for name, options, shape, axis, reduction, weighted, dtype in cases():
        generator = torch.Generator().manual_seed(1)
        x, y = torch.randn(2, *shape, generator=generator)
        x, y = x.to(dtype), (3.0 * y).to(dtype)
        weight = torch.rand(shape, generator=generator) if weighted else None
        m = shape[axis]
        own = {"channel_dim": axis, "reduction": reduction, **options}
        loss = MKCLoss(m, **own).to(device)
        reference = MKCLoss(m, **own).double()
        if dtype == torch.float64:
            loss = loss.double()
        on_device = found(loss, x.to(device), y.to(device), None if weight is None else weight.to(device))
        expected = found(reference, x.double(), y.double(), None if weight is None else weight.double())
        scale = 1000.0 if dtype == torch.float16 else 1.0
        expected = [one if i == 0 else scale * one for i, one in enumerate(expected)]
        for what, one, other in zip(("value", "input", "sigma", "d"), on_device, expected, strict=False):
            size = other.abs().max().clamp(min=1e-3 if what in ("sigma", "d") else 1e-12)
            off = float((one - other).abs().max() / size)
            text = f"{name} {shape} {reduction} weighted={weighted} {what}"
            if not off <= TOLERANCE[dtype]:
                print(f"  differs: {dtype} {text}: {off:.2e}")
                right = False
            if dtype not in worst or off > worst[dtype][0]:
                worst[dtype] = (off, text)
    for dtype, (off, text) in worst.items():
        print(f"  {str(dtype):16} worst {off:.1e} ({text})")
    return right

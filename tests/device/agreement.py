"""Values and gradients on a device against the CPU's in float64."""

from __future__ import annotations

import functools

import torch
import torch.multiprocessing
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
"""Tolerance of the largest difference, relative to the largest number, by the dtype of the predictions."""


def value_and_gradients(loss: MKCLoss, input: Tensor, target: Tensor, weight: Tensor | None) -> list[Tensor]:
    """Value and gradients of the second of two batches, under an upstream gradient that is not 1."""
    for _ in range(2):
        leaf = input.clone().requires_grad_()
        for parameter in loss.parameters():
            parameter.grad = None
        value = loss(leaf, target, weight)
        # scaled as by a gradient scaler: the mean over many elements underflows float16
        value.backward(torch.full_like(value, 1700.0 if input.dtype == torch.float16 else 1.7))
    assert leaf.grad is not None
    grads = [p.grad for p in loss.parameters() if p.grad is not None]
    return [grad.detach().cpu().double() for grad in (value, leaf.grad, *grads)]


Case = tuple[str, tuple[int, ...], int, str, bool, torch.dtype]
"""Mode, shape, dimension of the channels, reduction, whether weighted, dtype."""


def cases() -> list[Case]:
    """All dtypes, weights and reductions on the first shape; the other shapes in float32."""
    first, *others = SHAPES
    chosen: list[Case] = []
    for name in MODES:
        chosen += [(name, *first, "mean", weighted, dtype) for weighted in (False, True) for dtype in TOLERANCE]
        chosen += [(name, *first, reduction, True, torch.float32) for reduction in ("sum", "none")]
        chosen += [(name, *shape, "mean", i % 2 == 0, torch.float32) for i, shape in enumerate(others)]
    return chosen


def relative_differences(device: str, case: Case) -> list[tuple[str, float]]:
    """Name of each compared quantity, and its largest difference relative to the largest number."""
    name, shape, axis, reduction, weighted, dtype = case
    generator = torch.Generator().manual_seed(1)
    x, y = torch.randn(2, *shape, generator=generator)
    x, y = x.to(dtype), (3.0 * y).to(dtype)
    weight = torch.rand(shape, generator=generator) if weighted else None
    options = {"channel_dim": axis, "reduction": reduction, **MODES[name]}
    loss, reference = MKCLoss(shape[axis], **options).to(device), MKCLoss(shape[axis], **options).double()
    if dtype == torch.float64:
        loss = loss.double()
    on_device = value_and_gradients(loss, x.to(device), y.to(device), None if weight is None else weight.to(device))
    expected = value_and_gradients(reference, x.double(), y.double(), None if weight is None else weight.double())
    rows = []
    for what, value, other in zip(("value", "input", "sigma", "d"), on_device, expected, strict=False):
        # gradients of float16 still have the gradient scaler's factor
        other = other if what == "value" or dtype != torch.float16 else 1000.0 * other
        size = other.abs().max().clamp(min=1e-3 if what in ("sigma", "d") else 1e-12)
        text = f"{name} {shape} {reduction}{' weighted' if weighted else ''} {what}"
        rows.append((text, float((value - other).abs().max() / size)))
    return rows


def print_agreement(device: torch.device) -> bool:
    """Print the largest difference of each dtype. Returns whether all are within the tolerances."""
    todo = cases()
    run = functools.partial(relative_differences, str(device))
    if device.type == "cuda":  # compiling takes most of the time
        with torch.multiprocessing.get_context("spawn").Pool(8) as pool:
            answers = pool.map(run, todo, chunksize=1)
    else:
        answers = [run(case) for case in todo]
    right = True
    for dtype, tolerance in TOLERANCE.items():
        rows = [row for case, rows in zip(todo, answers, strict=True) if case[-1] == dtype for row in rows]
        text, off = max(rows, key=lambda row: row[1] if row[1] == row[1] else float("inf"))
        print(f"  {dtype!s:16} largest difference {off:.1e} of {tolerance:.0e} ({text})")
        for text, off in rows:
            if not off <= tolerance:
                print(f"    differs: {text}: {off:.2e}")
                right = False
    return right

"""Losses of samples and of labels on a device: agreement with float64 on the CPU, and time over the memory floor."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from mkc_torch import GeneralizedCrossEntropyLoss, HeteroscedasticMKCLoss
from tests.device.agreement import TOLERANCE
from tests.device.modes import copy_rate, median_seconds

ELEMENTS = 1 << 26
"""Elements of the timed batches on a GPU."""

BATCHES: tuple[tuple[tuple[int, ...], int, Any], ...] = (
    ((1000, 3), -1, 30.0),
    ((20_000, 1), -1, 4.0),
    ((5, 3, 16, 17), 1, [9.0, 40.0, 90.0]),
)
"""Shape, dimension of the channels and bound of the batches that are compared."""

Case = tuple[Any, Any, list[Tensor], list[Tensor]]
"""A loss, its reference, tensors that require a gradient, and tensors that do not."""


def samples(shape: tuple[int, ...], device: torch.device, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """Input, target, sigma and d."""
    generator = torch.Generator(device).manual_seed(0)

    def uniform(low: float, high: float) -> Tensor:
        unit = torch.rand(shape, generator=generator, device=device)
        return (low + (high - low) * unit).to(dtype)

    return [uniform(-6.0, 6.0), uniform(-6.0, 6.0), uniform(0.06, 6.0), uniform(0.2, 2.0)]


def labels(rows: int, classes: int, device: torch.device, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """Logits and labels; a quarter of the labels is ignored."""
    generator = torch.Generator(device).manual_seed(0)
    logits = 3.0 * torch.randn(rows, classes, generator=generator, device=device)
    target = torch.randint(0, classes, (rows,), generator=generator, device=device)
    target[::4] = -100
    return logits.to(dtype), target


def worst_difference(case: Case, device: torch.device) -> float:
    """Largest difference of value and gradients, each over its largest number."""
    loss, reference, leaves, rest = case
    found = []
    for own, where, wide in ((loss.to(device), device, False), (reference.double(), torch.device("cpu"), True)):
        given = [entry.to(where, torch.float64 if wide else entry.dtype).requires_grad_() for entry in leaves]
        others = [entry.to(where) for entry in rest]
        value = own(*given, *others)
        # without a gradient scaler a mean over many elements underflows float16
        upstream = 1700.0 if own.reduction == "mean" else 1.7
        grads = torch.autograd.grad(value, given, torch.full_like(value, upstream))
        found.append([grad.detach().cpu().double() for grad in (value, *grads)])
    return max(float((a - b).abs().max() / b.abs().max().clamp(min=1e-12)) for a, b in zip(*found, strict=True))


def agreement(device: torch.device) -> bool:
    """Print the largest difference of each loss and dtype. Returns whether all are within the tolerances."""
    worst: dict[tuple[str, torch.dtype], float] = {}
    cpu = torch.device("cpu")
    for reduction, dtype, weighted in itertools.product(("mean", "sum", "none"), TOLERANCE, (False, True)):
        for shape, axis, bound in BATCHES:
            pair = [
                HeteroscedasticMKCLoss(torch.tensor(bound, dtype=kind), channel_dim=axis, reduction=reduction)
                for kind in (torch.promote_types(dtype, torch.float32), torch.float64)
            ]
            weight = [torch.rand(shape) > 0.3] if weighted else []
            off = worst_difference((*pair, samples(shape, cpu, dtype), weight), device)
            worst["samples", dtype] = max(off, worst.get(("samples", dtype), 0.0))
        for rows, classes in ((300, 10), (5000, 37), (20, 4096), (9, 20_000)):
            weight = torch.rand(classes) if weighted else None
            pair = [
                GeneralizedCrossEntropyLoss(weight=weight, reduction=reduction).to(kind)
                for kind in (torch.promote_types(dtype, torch.float32), torch.float64)
            ]
            logits, target = labels(rows, classes, cpu, dtype)
            off = worst_difference((*pair, [logits], [target]), device)
            worst["labels", dtype] = max(off, worst.get(("labels", dtype), 0.0))
    right = True
    for (name, dtype), off in worst.items():
        right = right and off <= TOLERANCE[dtype]
        print(f"  {name:8} {dtype!s:16} worst {off:.1e}{'' if off <= TOLERANCE[dtype] else '  differs'}", flush=True)
    return right


def step_of(loss: Callable[..., Tensor], leaves: list[Tensor], rest: list[Tensor]) -> Callable[[], None]:
    """Forward and backward pass on a batch."""
    for value in leaves:
        value.requires_grad_()

    def step() -> None:
        for value in leaves:
            value.grad = None
        loss(*leaves, *rest).backward()

    return step


def print_times(device: torch.device) -> None:
    """Print times of forward and backward over their floors: 28 bytes an element of samples, two numbers a logit."""
    size = ELEMENTS if device.type == "cuda" else 1 << 18
    rate = copy_rate(device, size)

    def row(name: str, make: Callable[[], Callable[[], None]], floor: float) -> None:
        try:
            time = median_seconds(make(), device, budget=0.2)
        except torch.cuda.OutOfMemoryError:
            print(f"  {name:44} out of memory")
            return
        print(f"  {name:44}{1e3 * time:10.3f} ms{time * rate / floor:8.2f} x its floor", flush=True)

    def of_samples(bound: Any, count: int, dtype: torch.dtype = torch.float32, **options: Any) -> Callable[[], None]:
        x, target, sigma, d = samples((count // 4, 4), device, dtype)
        loss = HeteroscedasticMKCLoss(bound, **options).to(device)
        return step_of(lambda x, s, d: loss(x, target, s, d), [x, sigma, d], [])

    def of_gaussian() -> Callable[[], None]:
        x, target, _, d = samples((size // 4, 4), device)
        return step_of(lambda x, d: nn.functional.gaussian_nll_loss(x, target, d), [x, d], [])

    row("GaussianNLLLoss, floor of 20 bytes", of_gaussian, 20.0 * size)
    row("samples", lambda: of_samples(50.0, size), 28.0 * size)
    row("samples, bfloat16", lambda: of_samples(50.0, size, torch.bfloat16), 14.0 * size)
    row("samples, bounds of channels", lambda: of_samples(torch.full((4,), 50.0), size), 28.0 * size)
    row("samples, domains that end on the head", lambda: of_samples(6.0, size), 28.0 * size)
    row("samples, 1024", lambda: of_samples(50.0, 1024), 28.0 * 1024)
    few = size // 64  # the formulas need several hundred numbers an element
    row(f"samples, impl='eager', {few}", lambda: of_samples(50.0, few, impl="eager"), 28.0 * few)

    def of_labels(loss: nn.Module, rows: int, classes: int, dtype: torch.dtype = torch.float32) -> Callable[[], None]:
        logits, target = labels(rows, classes, device, dtype)
        return step_of(loss.to(device), [logits], [target])

    for classes in (10, 100, 1000, 32_768):
        rows = max(1, size // classes)
        for name, loss in (
            ("CrossEntropyLoss", nn.CrossEntropyLoss()),
            ("labels", GeneralizedCrossEntropyLoss()),
            ("labels, impl='eager'", GeneralizedCrossEntropyLoss(impl="eager")),
        ):
            floor = 8.0 * rows * classes + 8.0 * rows
            row(f"{name}, {classes} classes", lambda loss=loss: of_labels(loss, rows, classes), floor)  # noqa: B023 - called in this round of the loop
    row("labels, 256 rows of 10", lambda: of_labels(GeneralizedCrossEntropyLoss(), 256, 10), 8.0 * 2560)


def print_other_losses(device: torch.device) -> bool:
    """Print agreement and times of the losses other than MKCLoss. Returns whether they agree."""
    right = agreement(device)
    print_times(device)
    return right

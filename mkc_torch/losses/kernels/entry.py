"""Forward passes of the losses by kernels: an autograd function in eager code, an operator in compiled code."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mkc_torch._support.torch_internals import is_transformed
from mkc_torch.losses._checks import checked_weight
from mkc_torch.losses.kernels.label_loss import EachLabel, LabelPass, ReducedLabels, arranged_labels
from mkc_torch.losses.kernels.label_operators import operator_label_loss
from mkc_torch.losses.kernels.loss import EachFunction, ReducedFunction, prepared
from mkc_torch.losses.kernels.operators import operator_loss
from mkc_torch.losses.kernels.sample_loss import EachSample, ReducedSamples, SamplePass, arranged_samples
from mkc_torch.losses.kernels.sample_operators import operator_sample_loss

INT32 = 2**31
"""Limit of counts in signed 32-bit integers."""


def kernel_loss(loss: Any, input: Tensor, target: Tensor, weight: Tensor | None) -> Tensor:
    """Forward pass of an MKCLoss by kernels; by formulas under transforms, or if a weight requires a gradient."""
    axis = loss._checked_axis(input, target)
    own = loss._parameters  # attributes of modules take a microsecond each
    raw_kappa, raw_d = own.get("raw_kappa"), own.get("raw_d")
    given = [entry for entry in (input, target, weight, raw_kappa, raw_d) if entry is not None]
    compiling = torch.compiler.is_compiling()
    if not compiling and any(is_transformed(entry) for entry in given):
        return loss._computed(input, target, weight)
    if weight is not None:
        if weight.requires_grad:
            return loss._computed(input, target, weight)
        weight = checked_weight(weight, input, axis, cast=False)[0]
    if compiling or any(type(entry) is not Tensor and type(entry) is not torch.nn.Parameter for entry in given):
        return operator_loss(loss, input, target, weight, axis)
    batch, work = prepared(loss, input, target, weight, axis)
    function: Any = EachFunction if loss.reduction == "none" else ReducedFunction
    value: Tensor = function.apply(input, target, raw_kappa, raw_d, batch, work)
    return value


def sample_loss(loss: Any, input: Tensor, target: Tensor, sigma: Tensor, d: Tensor, weight: Tensor | None) -> Tensor:
    """Forward pass of a HeteroscedasticMKCLoss by kernels.

    The formulas are used under transforms, if a weight requires a gradient, and if sigma or d differs in shape from the
    input, for example with one value for many channels.
    """
    axis = loss._checked_axis(input, target)
    loss._check_scales(input, sigma, d)
    given = [entry for entry in (input, target, sigma, d, weight) if entry is not None]
    compiling = torch.compiler.is_compiling()
    same = sigma.shape == input.shape and d.shape == input.shape
    # indices within a cycle of the channels are 32-bit
    short = loss.bound.numel() == 1 or input.shape[axis:].numel() < 2**30
    transformed = not compiling and any(is_transformed(entry) for entry in given)
    if transformed or not (same and short) or (weight is not None and weight.requires_grad):
        return loss._computed(input, target, sigma, d, weight)
    own_weight = None if weight is None else checked_weight(weight, input, axis, cast=False)[0]
    if compiling or any(type(entry) is not Tensor and type(entry) is not torch.nn.Parameter for entry in given):
        return operator_sample_loss(loss, input, target, sigma, d, own_weight, axis)
    with torch.no_grad():
        batch = arranged_samples(
            input.detach(), target.detach(), sigma.detach(), d.detach(), own_weight, loss.bound, axis
        )
    function: Any = EachSample if loss.reduction == "none" else ReducedSamples
    value: Tensor = function.apply(input, target, sigma, d, SamplePass(loss, batch, weight))
    return value


def takes_labels(loss: Any, input: object, target: object) -> bool:
    """Whether the kernels compute this batch: labels of rows (N, C). The formulas compute or refuse other batches."""
    if not (isinstance(input, Tensor) and isinstance(target, Tensor)) or not input.is_floating_point():
        return False
    if input.dim() != 2 or input.numel() == 0 or target.shape != input.shape[:1]:
        return False
    if target.is_floating_point() or target.is_complex() or target.dtype == torch.bool:
        return False
    if loss.weight is not None and loss.weight.shape != input.shape[1:]:
        return False
    if not -INT32 <= loss.ignore_index < INT32:
        return False
    return torch.compiler.is_compiling() or not (is_transformed(input) or is_transformed(target))


def label_loss(loss: Any, input: Tensor, target: Tensor) -> Tensor:
    """Forward pass of a GeneralizedCrossEntropyLoss by kernels, for a batch that :func:`takes_labels` accepts."""
    plain = type(target) is Tensor and type(input) in (Tensor, torch.nn.Parameter)
    if torch.compiler.is_compiling() or not plain:
        return operator_label_loss(loss, input, target)
    with torch.no_grad():
        batch = arranged_labels(input.detach(), target, loss.kappa, loss.weight, loss.ignore_index)
    function: Any = EachLabel if loss.reduction == "none" else ReducedLabels
    value: Tensor = function.apply(input, target, LabelPass(loss, batch))
    return value

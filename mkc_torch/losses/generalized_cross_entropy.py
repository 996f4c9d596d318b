"""Classification with wrong labels: correntropy of the deviance residual, known as generalized cross-entropy.

A label that a network gives the probability p has the cross-entropy ``-log p`` and the deviance residual
``e = sqrt(-2 log p)``. Its correntropy energy is Zhang and Sabuncu's generalized cross-entropy with q = 1/σ²::

    σ² (1 - exp(-e² / (2 σ²))) = σ² (1 - p^(1/σ²))

σ = ∞ is cross-entropy, σ = 1 half the mean absolute error of the probabilities. The gradient of a label of small
probability p falls like ``p^(1/σ²)``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import as_numbers, checked_number, checked_whole, refuse_no_tensor, refuse_not_real
from mkc_torch._support.initial_values import InitialValues, has_values, initial_numbers, is_readable
from mkc_torch.density.energy import NEAR, relative_series
from mkc_torch.losses._checks import Reduction, at_least_float32, format_tensor, refuse_other_reduction
from mkc_torch.losses._implementation import Implementation, checked_implementation, runs_kernels
from mkc_torch.losses._label_curves import LabelCurves

if TYPE_CHECKING:
    from jaxtyping import Float, Int

SIGMA_LEAST = 0.5
"""Smallest σ accepted: its gradient is p⁴ times that of cross-entropy, too small for learning."""

_PROBABILITY_SLACK = 0.02
"""Tolerance on the sum of probabilities, which is 1: bfloat16 rounds."""


class GeneralizedCrossEntropyLoss(LabelCurves, InitialValues):
    """Cross-entropy that is robust to wrong labels: ``σ² (1 - p^(1/σ²))`` with the probability p of the label.

    It replaces :class:`torch.nn.CrossEntropyLoss`; at σ = ∞ value and gradient are the same. The default σ = 1.2 is the
    authors' q = 0.7. From random weights a network learns poorly at σ = 1 and below. Later in training, a smaller σ
    keeps it from memorising wrong labels: see :func:`graduated_sigma`.

    σ is not learned. The energy is smallest at the smallest σ, whatever the data. The likelihood
    ``exp(-energy) / Σ_c exp(-energy_c)`` of labels that the network has not seen is largest near σ² = the log-odds of
    the right label against a given wrong label. For training labels its maximum moves to cross-entropy (σ = ∞) as the
    network memorises them.

    Args:
        sigma: bandwidth σ in [0.5, inf], without unit; 1/σ² is the q of generalized cross-entropy.
        weight: non-negative weights of the classes (C,).
        ignore_index: integer label that is masked; its logits, NaN included, affect neither value nor gradient.
        reduction: "none", "mean" or "sum"; as in torch, the mean is weighted by the class weights of the labels, or is
            over samples if the targets are probabilities.
        impl: "auto" runs Triton kernels for labels of logits (N, C) on a GPU that has them, and torch elsewhere;
            "eager", "compile" or "triton" select an implementation. All compute the same.

    Attributes:
        sigma: current value (); assign to set it, also under torch.compile.
        weight: buffer (C,) or None; with ``kappa``, 1/σ², it is saved in the state_dict.

    Raises:
        TypeError, ValueError: an argument out of range.

    References:
        Zhang and Sabuncu, "Generalized Cross Entropy Loss for Training Deep Neural Networks with Noisy Labels",
        NeurIPS 2018, section 3.2. Singh, Pokharel and Principe, "The C-loss function for pattern classification",
        Pattern Recognition 47 (2014): correntropy of the error of a class, in place of the deviance residual.

    Example:
        >>> loss = GeneralizedCrossEntropyLoss(sigma=1.2)
        >>> logits = torch.tensor([[9.0, 0.0, 0.0], [9.0, 0.0, 0.0]], requires_grad=True)
        >>> loss(logits, torch.tensor([0, 2])).backward()  # the second label is wrong
        >>> bool(logits.grad[1].norm() < 2e-3)  # with cross-entropy it is 0.7
        True
    """

    kappa: Tensor
    weight: Tensor | None

    def __init__(
        self,
        sigma: float = 1.2,
        *,
        weight: Float[Tensor, " C"] | None = None,
        ignore_index: int = -100,
        reduction: Reduction = "mean",
        impl: Implementation = "auto",
    ) -> None:
        super().__init__()
        refuse_other_reduction(reduction)
        self.impl = checked_implementation(impl)
        self.ignore_index = checked_whole("ignore_index", ignore_index, advice="-100 is torch's")
        self.reduction = reduction
        self._register("kappa", _inverse_square(sigma))
        self._register("weight", None if weight is None else _class_weights(weight))

    @property
    def sigma(self) -> Float[Tensor, ""]:
        """Bandwidth; assign a number in [0.5, inf] to set it."""
        return self.kappa.rsqrt()

    @sigma.setter
    def sigma(self, value: float | Tensor) -> None:
        with torch.no_grad():
            self.kappa.copy_(_inverse_square(value))

    def forward(
        self, input: Float[Tensor, "N C *rest"], target: Int[Tensor, "*samples"] | Float[Tensor, "N C *rest"]
    ) -> Tensor:
        """The loss of logits against labels.

        Args:
            input: logits (N, C, *), or (C,) of one sample.
            target: labels in [0, C) of any integer type, (N, *) or (); or probabilities of the classes, of the shape of
                the input, for which the loss is the mean over labels drawn from them.

        Returns:
            A scalar, or with reduction "none" (N, *) with 0 where ignored; float32 at least. The mean and its gradients
            are 0 if all labels are ignored or have weight 0; torch returns NaN.

        Raises:
            TypeError: integer or complex logits, boolean or complex targets.
            ValueError: shapes that do not fit, no element, another number of classes than weights; a label out of
                range; logits that are not ignored and NaN or +inf; targets that are not probabilities. The last three
                are not checked on an accelerator: there a NaN gives NaN.
        """
        if runs_kernels(self, input):
            from mkc_torch.losses.kernels.entry import label_loss, takes_labels

            if takes_labels(self, input, target):
                return label_loss(self, input, target)
        if self.impl == "compile" and not torch.compiler.is_compiling():
            return _compiled()(self, input, target)
        return self._computed(input, target)

    def _computed(self, input: Tensor, target: Tensor) -> Tensor:
        return _loss(input, target, self.kappa, self.weight, self.ignore_index, self.reduction)

    @torch.no_grad()
    def inlier_weight(
        self, input: Float[Tensor, "N C *rest"], target: Int[Tensor, "*samples"] | Float[Tensor, "N C *rest"]
    ) -> Float[Tensor, "*samples"]:
        """Inlier weight of each label, ``p^(1/σ²)``: its gradient relative to that of cross-entropy.

        Inspect labels of small weight, below 0.1 for example. At σ = ∞ every weight is 1.

        Args:
            input, target: as for the loss.

        Returns:
            Weights in [0, 1], (N, *), float32 at least, without a gradient; 0 where ignored.

        Raises:
            TypeError, ValueError: as for the loss.

        Example:
            >>> loss = GeneralizedCrossEntropyLoss(sigma=1.0)
            >>> loss.inlier_weight(torch.tensor([[2.0, 0.0], [2.0, 0.0]]), torch.tensor([0, 1]))
            tensor([0.8808, 0.1192])
        """
        deviance, share, counts = _checked(input, target, None, self.ignore_index)
        kappa = self.kappa.to(deviance.dtype)
        weight = torch.where(kappa > 0, torch.exp(-kappa * deviance), 1.0)
        if share is not None:
            return (share * weight).sum(_axis(input))
        return torch.where(counts, weight, 0.0)

    def extra_repr(self) -> str:
        weighted = "" if self.weight is None else f", weight={format_tensor(self.weight)}"
        sigma = f"{self.sigma.item():g}" if is_readable(self.sigma) else format_tensor(self.sigma)
        return f"sigma={sigma}, reduction={self.reduction!r}, ignore_index={self.ignore_index}{weighted}"


@functools.cache
def _compiled() -> Callable[..., Tensor]:
    return torch.compile(GeneralizedCrossEntropyLoss._computed)


def generalized_cross_entropy(
    input: Float[Tensor, "N C *rest"],
    target: Int[Tensor, "*samples"] | Float[Tensor, "N C *rest"],
    *,
    sigma: float | Float[Tensor, ""] = 1.2,
    weight: Float[Tensor, " C"] | None = None,
    ignore_index: int = -100,
    reduction: Reduction = "mean",
) -> Tensor:
    """The loss of :class:`GeneralizedCrossEntropyLoss` as a function.

    Args:
        input, target: as for the module.
        sigma, weight, ignore_index, reduction: as for the module. σ gets no gradient.

    Returns:
        As the module.

    Raises:
        TypeError, ValueError: as the module.

    Example:
        >>> logits, label = torch.tensor([[1.0, 0.0, 2.0]]), torch.tensor([1])
        >>> generalized_cross_entropy(logits, label, sigma=float("inf"))
        tensor(2.4076)
        >>> generalized_cross_entropy(logits, label, sigma=1.0)  # 1 less the probability
        tensor(0.9100)
    """
    refuse_other_reduction(reduction)
    weight = None if weight is None else _class_weights(weight)
    refuse_not_real("input", input, "floating-point logits")
    kappa = _inverse_square(sigma, at_least_float32(input)).to(input.device)
    return _loss(input, target, kappa, weight, ignore_index, reduction)


def graduated_sigma(progress: float, *, start: float = 1.2, end: float = 0.8, until: float = 0.5) -> float:
    """σ at a point of the training: large at first, to learn; smaller later, not to memorise wrong labels.

    1/σ² changes linearly from that of ``start`` to that of ``end`` and stays there. Set ``loss.sigma =
    graduated_sigma(epoch / epochs)`` in each epoch.

    Args:
        progress: share of the training that is done, in [0, 1].
        start: σ at the beginning, in [0.5, inf].
        end: σ from ``until`` on, in [0.5, inf].
        until: the progress at which ``end`` is reached, in (0, 1].

    Returns:
        σ.

    Raises:
        TypeError, ValueError: an argument that is not a number, or out of range.

    References:
        Zhang and Sabuncu (2018) keep q constant; see :class:`GeneralizedCrossEntropyLoss`. The schedule is our own.

    Example:
        >>> [round(graduated_sigma(p), 2) for p in (0.0, 0.25, 0.5, 1.0)]
        [1.2, 0.94, 0.8, 0.8]
    """
    checked_number("progress", progress, 0.0, 1.0, "[]", "pass epoch / epochs")
    checked_number("until", until, 0.0, 1.0, "(]", "0.5 is half of the training")
    start, end = (
        checked_number(name, sigma, SIGMA_LEAST, math.inf, "[]", "1.2 to 0.8 is usual")
        for name, sigma in (("start", start), ("end", end))
    )
    done = min(1.0, progress / until)
    kappa = (1.0 - done) * start**-2 + done * end**-2
    return kappa**-0.5 if kappa > 0.0 else math.inf


def _loss(
    input: Tensor, target: Tensor, kappa: Tensor, weight: Tensor | None, ignore_index: int, reduction: Reduction
) -> Tensor:
    deviance, share, counts = _checked(input, target, weight, ignore_index)
    values = _faded(deviance, kappa.to(deviance.dtype))
    axis = _axis(input)
    if share is not None:
        if weight is not None:
            share = share * weight.to(share.dtype).reshape([-1 if i == axis else 1 for i in range(share.dim())])
        # a class of probability 0 may have the logit -inf
        values = (share * torch.where(share > 0, values, 0.0)).sum(axis)
        if reduction == "none":
            return values
        return values.sum() if reduction == "sum" else values.mean()
    if weight is None:
        values, total = torch.where(counts, values, 0.0), counts.sum()
    else:
        weights = torch.where(counts, weight.to(values.dtype)[torch.where(counts, target, 0).long()], 0.0)
        values, total = weights * torch.where(weights > 0, values, 0.0), weights.sum()
    if reduction == "none":
        return values
    return values.sum() if reduction == "sum" else values.sum() / torch.where(total > 0, total, 1)


def _faded(deviance: Tensor, kappa: Tensor) -> Tensor:
    """``(1 - exp(-kappa l)) / kappa`` of the cross-entropy l, exactly l at kappa = 0."""
    own = torch.where(kappa > 0, kappa, 1.0)
    x = own * deviance
    small = x < NEAR
    near = torch.where(small, x, 0.0)
    # compiled expm1 is exp - 1 on some processors, which is 0 for small x
    head = near * relative_series(near) if torch.compiler.is_compiling() else -torch.expm1(-near)
    # expm1 alone would lose the gradient at large x, exp alone the value at small x
    far = 1.0 - torch.exp(-torch.where(small, 1.0, x))
    return torch.where(kappa > 0, torch.where(small, head, far) / own, deviance)


def _checked(
    input: Tensor, target: Tensor, weight: Tensor | None, ignore_index: int
) -> tuple[Tensor, Tensor | None, Tensor]:
    """Cross-entropy of each label or class, the class probabilities or None, and the mask of labels not ignored."""
    refuse_not_real("input", input, "floating-point logits")
    refuse_no_tensor("target", target, "a tensor of integer labels or floating-point probabilities")
    if target.dtype == torch.bool or target.is_complex():
        raise TypeError(
            f"Expected argument `target` to be integer labels or floating-point probabilities but got {target.dtype}."
        )
    if input.dim() == 0 or input.numel() == 0:
        raise ValueError(
            f"Expected argument `input` of shape (N, C, *) or (C,) with elements but got {tuple(input.shape)}; "
            "skip empty batches."
        )
    axis = _axis(input)
    classes = input.shape[axis]
    if weight is not None and weight.shape != (classes,):
        raise ValueError(f"Expected `weight` of the {classes} classes of `input` but got shape {tuple(weight.shape)}.")
    watched = input.device.type == "cpu" and not torch.compiler.is_compiling()
    logits = input.to(at_least_float32(input))
    if target.is_floating_point():
        if target.shape != input.shape:
            raise ValueError(
                f"Expected probabilities `target` of the shape of `input`, {tuple(input.shape)}, but got "
                f"{tuple(target.shape)}; give labels an integer type, target.long()."
            )
        share = target.to(torch.promote_types(logits.dtype, target.dtype))
        logits = logits.to(share.dtype)
        counts = torch.ones_like(share.select(axis, 0), dtype=torch.bool)
        if watched:
            _refuse_no_probabilities(target, axis)
            _refuse_not_finite(input, counts, axis)
        return -torch.log_softmax(logits, axis), share, counts
    samples = input.shape[:axis] + input.shape[axis + 1 :]
    if target.shape != samples:
        raise ValueError(
            f"Expected labels `target` of shape {tuple(samples)} for `input` {tuple(input.shape)} but got "
            f"{tuple(target.shape)}; the classes are dimension {axis} of `input`, and probabilities of them, one-hot "
            "or soft, need a floating-point type."
        )
    # in uint8 labels, -100 is 156
    target = target.long()
    counts = target != ignore_index
    if watched:
        _refuse_out_of_range(target, counts, classes, ignore_index)
    if not (watched and _refuse_not_finite(input, counts, axis)):
        # zero times NaN would be NaN
        logits = torch.where(counts.unsqueeze(axis), logits, 0.0)
    label = torch.where(counts, target, 0).long().unsqueeze(axis)
    return -torch.log_softmax(logits, axis).gather(axis, label).squeeze(axis), None, counts


def _axis(input: Tensor) -> int:
    return 0 if input.dim() == 1 else 1


def _inverse_square(sigma: float | Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """``1 / sigma^2`` as a scalar tensor; a number is converted to ``dtype``, None being the default dtype."""
    if isinstance(sigma, Tensor) and sigma.requires_grad:
        raise ValueError(
            "Expected argument `sigma` without a gradient but got a tensor with requires_grad=True: the loss is "
            "smallest at the smallest sigma, whatever the data. Pass sigma.detach(); graduated_sigma is a schedule."
        )
    t = initial_numbers("sigma", sigma) if dtype is None else as_numbers("sigma", sigma, dtype)
    t = t.to(at_least_float32(t))
    if t.dim() != 0:
        raise ValueError(f"Expected argument `sigma` to be a single number but got shape {tuple(t.shape)}.")
    if has_values(t) and not torch.compiler.is_compiling():
        try:
            fine = t.item() >= SIGMA_LEAST
        except RuntimeError:  # under vmap values cannot be read
            fine = True
        if not fine:
            raise ValueError(f"Expected argument `sigma` in [{SIGMA_LEAST:g}, inf] but got {sigma}; 1.2 is usual.")
    return t.pow(-2)


def _class_weights(weight: Tensor) -> Tensor:
    t = initial_numbers("weight", weight).detach()
    t = t.to(at_least_float32(t))
    if t.dim() != 1 or t.numel() == 0:
        raise ValueError(f"Expected argument `weight` of shape (C,), one for each class, but got {tuple(t.shape)}.")
    watched = t.device.type == "cpu" and not torch.compiler.is_compiling()
    if watched and not bool(((t >= 0) & torch.isfinite(t)).all() & (t > 0).any()):
        raise ValueError(
            f"Expected argument `weight` to be non-negative and finite, not all 0, but got {t.tolist()}; "
            "leave it out for equal weights."
        )
    return t.clone()


@torch.no_grad()
def _refuse_out_of_range(target: Tensor, counts: Tensor, classes: int, ignore_index: int) -> None:
    wrong = counts & ((target < 0) | (target >= classes))
    if not _any(wrong):
        return
    index = tuple(wrong.nonzero()[0].tolist())
    raise ValueError(
        f"Expected labels `target` in [0, {classes}), the classes of `input`, but got {target[index].item()} at index "
        f"{index} and {int(wrong.sum()) - 1} more out of range; masked labels must be {ignore_index}, "
        "`ignore_index`."
    )


@torch.no_grad()
def _refuse_not_finite(input: Tensor, counts: Tensor, axis: int) -> bool:
    """Raise ValueError on NaN or +inf in unmasked logits; -inf is an impossible class. True if all are finite."""
    total = input.sum()
    try:
        if math.isfinite(total.item()):
            return True
    except RuntimeError:  # under vmap values cannot be read
        return False
    wrong = counts.unsqueeze(axis) & (input.isnan() | (input == torch.inf))
    # every class is impossible
    wrong = wrong | (counts & (input == -torch.inf).all(axis)).unsqueeze(axis)
    if bool(wrong.any()):
        index = tuple(wrong.nonzero()[0].tolist())
        raise ValueError(
            f"Expected logits `input` without NaN, +inf or only -inf but got {input[index].item()} at index {index} "
            f"and {int(wrong.sum()) - 1} more; the network has diverged, or its inputs hold NaN."
        )
    return False


@torch.no_grad()
def _refuse_no_probabilities(target: Tensor, axis: int) -> None:
    total = target.float().sum(axis)
    # NaN fails the comparison
    wrong = ~((total - 1.0).abs() <= _PROBABILITY_SLACK) | (target < 0).any(axis)
    if not _any(wrong):
        return
    index = tuple(wrong.nonzero()[0].tolist())
    raise ValueError(
        f"Expected probabilities `target` to be non-negative with the sum 1 over dimension {axis} but got "
        f"{target.movedim(axis, -1)[index].tolist()} at index {index}; divide by the sum, or pass integer labels."
    )


def _any(wrong: Tensor) -> bool:
    try:
        return bool(wrong.any().item())
    except RuntimeError:  # under vmap values cannot be read
        return False

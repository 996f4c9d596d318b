"""Negative log-likelihood under a loss as a torchmetrics metric: sums add up over batches and processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

try:
    from torchmetrics import Metric
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "mkc_torch.metrics needs torchmetrics, which comes with Lightning: pip install 'mkc-torch[lightning]'"
    ) from error

from mkc_torch._support.arguments import refuse_bad_batch
from mkc_torch.density.energy import energy_value
from mkc_torch.density.normalizer import log_partition
from mkc_torch.losses._checks import checked_weight
from mkc_torch.losses.mkc import MKCLoss, checked_loss

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["MKCNegativeLogLikelihood"]


class MKCNegativeLogLikelihood(Metric):
    """Mean negative log-density of errors under an :class:`MKCLoss`, in nats per element.

    Sums and weights are float64 and are added over processes, so the mean does not depend on the batch size.

    The metric refers to the loss and does not own it. Each batch is evaluated at the loss's σ, d and bound at that
    time. The metric has no parameters. A clone refers to the same loss; a deep copy of a module that contains the loss,
    followed by the metric, refers to the copied loss.

    Compare values at equal bounds only. Beyond the bound the formula of :func:`mkc_torch.functional.mkc_nll` is
    continued.

    Args:
        loss: the loss; its ``normalize`` and ``reduction`` are ignored.
        per_channel: whether ``compute`` returns the mean of each channel, (m,), or the mean over all elements, ().
        kwargs: options of :class:`torchmetrics.Metric`.

    Raises:
        TypeError: ``loss`` is not an MKCLoss.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17).

    Example:
        >>> loss = MKCLoss(2, sigma=3.0, d=1.0, bound=50.0)
        >>> metric = MKCNegativeLogLikelihood(loss)
        >>> metric.update(torch.zeros(4, 2), torch.ones(4, 2))
        >>> metric.update(torch.zeros(1, 2), torch.zeros(1, 2))
        >>> metric.compute()
        tensor(1.3616, dtype=torch.float64)
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

    total: Tensor
    weight: Tensor

    def __init__(self, loss: MKCLoss, *, per_channel: bool = False, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        loss = checked_loss(loss)
        self._loss = _Reference(loss)
        self.per_channel = per_channel
        for name in ("total", "weight"):
            self.add_state(name, torch.zeros(loss.num_channels, dtype=torch.float64), dist_reduce_fx="sum")

    def reset_parameters(self) -> None:
        """Set the sums to 0, also after ``to_empty``; :meth:`reset` needs the memory of the construction."""
        for default in self._defaults.values():
            default.zero_()  # type: ignore[union-attr]
        self.reset()

    def _apply(self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = "", **_: Any) -> Any:  # type: ignore[override]
        return super()._apply(fn, exclude_state)  # torchmetrics lacks the argument that `to_empty` passes

    @property
    def loss(self) -> MKCLoss:
        """The loss whose σ, d and bound are used."""
        return self._loss.loss

    def update(
        self,
        input: Float[Tensor, "*shape"],
        target: Float[Tensor, "*shape"],
        weight: Float[Tensor, "*shape"] | Bool[Tensor, "*shape"] | None = None,
    ) -> None:
        """Add a batch.

        Args:
            input: predictions, as for the loss.
            target: targets of the same shape.
            weight: as for the loss: non-negative weights or a mask, of the shape of ``input`` or without its channels.

        Raises:
            TypeError, ValueError: as the loss does.
        """
        loss = self.loss
        axis = loss._checked_axis(input, target)
        with torch.no_grad():
            input, target = input.double(), target.double()
            error = input - target
            if weight is None:
                weights, counts = torch.ones_like(error), None
            else:
                weights, counts = checked_weight(weight, error, axis)
                error = torch.where(counts, error, 0.0)
            refuse_bad_batch(input, target, counts, error)
            kappa, d, bound = (t.double() for t in (loss.kappa, loss.d, loss.bound))
            shape = [-1 if i == axis else 1 for i in range(error.dim())]
            others = [i for i in range(error.dim()) if i != axis]
            nll = energy_value(error / d.view(shape), kappa.view(shape))
            nll = nll + (torch.log(d) + log_partition(kappa, bound / d)).view(shape)
            total, elements = ((value.sum(others) if others else value) for value in (weights * nll, weights))
        self.total += total.to(self.total)
        self.weight += elements.to(self.weight)

    def compute(self) -> Float[Tensor, ""] | Float[Tensor, " m"]:
        """Weighted mean in nats per element, float64; NaN without any element of positive weight."""
        if self.per_channel:
            return self.total / self.weight
        return self.total.sum() / self.weight.sum()


class _Reference:
    """Reference to a module: outside the holder's parameters and state, and shared by the holder's copies."""

    def __init__(self, loss: MKCLoss) -> None:
        self.loss = loss

    def __deepcopy__(self, memo: dict[int, Any]) -> _Reference:
        return _Reference(memo.get(id(self.loss), self.loss))

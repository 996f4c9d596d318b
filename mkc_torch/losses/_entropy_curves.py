"""Curves of the entropy of relative squares over an error that is added to a batch."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_no_tensor, refuse_not_finite, refuse_not_real
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.losses._curves import Curves

if TYPE_CHECKING:
    from jaxtyping import Float

_REACH = 6.0
"""Half-width of a picture, in robust scales."""

_POINTS = 400
"""Points per curve of a picture: an even number, because the weight is infinite at an error of 0."""

_NORMAL = 200
"""Errors of the default normal batch."""


class EntropyCurves(Curves):
    """Curves of H over an error that is added to a batch, because H depends on all errors together."""

    def rho(self, error: Float[Tensor, "*shape"], batch: Float[Tensor, "*others"]) -> Float[Tensor, "*shape"]:
        """H of a batch with an error added to it, for each error.

        Args:
            error: added errors, any shape.
            batch: errors of the batch, a single population, not all 0.

        Raises:
            TypeError, ValueError: an argument that is not a real tensor; a batch of zeros, or not finite.

        Example:
            >>> from mkc_torch import LELoss
            >>> LELoss().rho(torch.tensor([0.0, 1.0, 100.0]), batch=torch.ones(50))  # the more alike, the larger
            tensor([0.9950, 1.0000, 0.0129])
        """
        square, total, moment, count = _sums(error, batch)
        all_square = total + square
        entropy = all_square.log() - (moment + torch.special.xlogy(square, square)) / all_square
        return entropy / math.log(count)

    def influence(self, error: Float[Tensor, "*shape"], batch: Float[Tensor, "*others"]) -> Float[Tensor, "*shape"]:
        """Derivative of :meth:`rho` with respect to the error; opposite in sign to errors beyond the typical error."""
        square, total, moment, count = _sums(error, batch)
        pull = moment * error.sign() * square.sqrt() - total * _times_log(error, square)
        return 2.0 * pull / ((total + square).square() * math.log(count)) / _unit(batch)

    def weight(self, error: Float[Tensor, "*shape"], batch: Float[Tensor, "*others"]) -> Float[Tensor, "*shape"]:
        """Influence divided by the error: infinite at 0, negative where descent increases the error."""
        square, total, moment, count = _sums(error, batch)
        return 2.0 * (moment - total * square.log()) / ((total + square).square() * math.log(count)) / _unit(batch) ** 2

    def plot(self, batch: Float[Tensor, "*others"] | None = None, axes: Any = None) -> Any:
        """Draw value, influence and weight over an error added to a batch, and return the axes; needs matplotlib.

        All curves are multiplied by the number of errors and drawn in units of the batch's robust scale. The value is
        drawn as its change from the value at an error of 0.

        Args:
            batch: errors; None takes 200 quantiles of a standard normal distribution.
            axes: axes of matplotlib, or None for a new figure.

        Raises:
            TypeError, ValueError: as :meth:`rho`, or more than half of the errors are 0.
            ModuleNotFoundError: matplotlib is not installed; the extra ``cli`` has it.
        """
        if batch is None:
            batch = torch.special.ndtri((torch.arange(_NORMAL, dtype=torch.float64) + 0.5) / _NORMAL)
        with torch.no_grad():
            _unit(batch)
            others = batch.detach().to(torch.promote_types(batch.dtype, torch.float32)).flatten()
            scale = robust_scale(others.unsqueeze(-1)).squeeze(-1)
            if not bool(scale > 0):
                raise ValueError(
                    "Expected argument `batch` with a robust scale but got errors of which more than half are 0; give "
                    "the errors of a batch, or None for a normal batch."
                )
            error = scale * torch.linspace(-_REACH, _REACH, _POINTS, dtype=scale.dtype, device=scale.device)
            count = others.numel() + 1
            curves = {
                f"change of value · {count}": (self.rho(error, others) - self.rho(error.new_zeros(()), others)) * count,
                f"influence · {count} s": self.influence(error, others) * count * scale,
                f"weight · {count} s²": self.weight(error, others) * count * scale.square(),
            }
            title = f"{type(self).__name__}: an error among {others.numel()} of robust scale s = {float(scale):.3g}"
            return self._drawn(axes, error, curves, "error, in the unit of the target", title)


def _unit(batch: Tensor) -> Tensor:
    """Largest absolute error of a batch: the unit in which squares neither overflow nor underflow."""
    refuse_not_real("batch", batch)
    refuse_not_finite("batch", batch, "Leave them out")
    largest = batch.detach().abs().amax() if batch.numel() else torch.zeros(())
    if not bool(largest > 0):
        raise ValueError(
            "Expected argument `batch` to hold an error that is not 0 but got "
            f"{'none' if batch.numel() == 0 else 'only zeros'}; the entropy is that of relative squares."
        )
    return largest


def _sums(error: Tensor, batch: Tensor) -> tuple[Tensor, Tensor, Tensor, int]:
    """In units of the largest error of the batch: e², Σ r² and Σ r² log r² of the batch; and the total count."""
    refuse_no_tensor("error", error, "a real tensor")
    refuse_not_real("error", error)
    unit = _unit(batch)
    dtype = torch.promote_types(torch.promote_types(error.dtype, batch.dtype), torch.float32)
    squares = (batch.to(dtype) / unit).square()
    square = (error.to(dtype) / unit).square()
    return square, squares.sum(), torch.special.xlogy(squares, squares).sum(), batch.numel() + 1


def _times_log(error: Tensor, square: Tensor) -> Tensor:
    """``e log e²``, 0 at 0."""
    return error.sign() * torch.special.xlogy(square.sqrt(), square)

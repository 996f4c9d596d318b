"""Residuals of any number in bounded memory: a histogram per channel that a density can be fitted to.

The bins are a hundredth of the residual's size wide, and each keeps the sum of its weights and of its squares. A bin
then stands for its residuals as one residual of their root mean square, which leaves an error of second order in the
width. Sums of histograms are histograms of all the residuals, so batches, epochs and processes add up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch import distributed as dist

if TYPE_CHECKING:
    from jaxtyping import Float, Int32

_MANTISSA_BITS = 6
_OCTAVES = 27
_INSIDE = _OCTAVES << _MANTISSA_BITS
BINS = _INSIDE + 1
"""Bins of a channel: 64 in each octave from 2⁻²⁷ (7e-9) to 1 times the bound, and one for what lies beyond it."""

# a residual clipped at the bound, a saturated sensor's, lies inside whatever way the division rounds
_REACH = 1.0 + 1e-6


class WeightedResiduals(NamedTuple):
    """Residuals (N, m) and their weights (N, m), float64."""

    error: Float[Tensor, "N m"]
    weight: Float[Tensor, "N m"]


class ResidualHistogram:
    """A histogram of the sizes of residuals for each channel; it keeps float64 sums, however many there are.

    Args:
        bound: half-widths of the domain (m,), in the unit of the residuals.

    Attributes:
        sums: of the weights and of weight times (residual / bound)², (2, m, BINS).
        count: how many residuals of positive weight each channel got, (m,).
        batches: how many batches came, with or without residuals of positive weight, a scalar.

    Example:
        >>> histogram = ResidualHistogram(torch.tensor([10.0]))
        >>> histogram.add(torch.tensor([[1.0], [1.0], [-3.0], [40.0]]))
        >>> histogram.add(torch.tensor([[float("nan")], [3.0]]), torch.tensor([[False], [True]]))
        >>> error, weight = histogram.residuals()
        >>> error.squeeze(-1), weight.squeeze(-1)
        (tensor([ 1.0000,  3.0000, 40.0000], dtype=torch.float64), tensor([2., 2., 1.], dtype=torch.float64))
        >>> histogram.share_beyond()
        tensor([0.2000], dtype=torch.float64)
    """

    bound: Float[Tensor, " m"]
    sums: Float[Tensor, "2 m bins"]
    count: Float[Tensor, " m"]
    batches: Float[Tensor, ""]

    def __init__(self, bound: Float[Tensor, " m"]) -> None:
        self.bound = bound.detach().double().cpu()
        m = self.bound.shape[0]
        self._set(torch.zeros(2 * m * BINS + m + 1, dtype=torch.float64))

    def _set(self, flat: Tensor) -> None:
        """Takes the sums, counts and batches from one tensor, so that one message adds them up over processes."""
        m = self.bound.shape[0]
        self._flat = flat
        self.sums = flat[: 2 * m * BINS].view(2, m, BINS)
        self.count = flat[2 * m * BINS : -1]
        self.batches = flat[-1]

    def to(self, device: torch.device) -> ResidualHistogram:
        """Moves the histogram; to the CPU instead of an MPS device, which has no float64."""
        device = torch.device("cpu") if device.type == "mps" else device
        if self._flat.device != device:
            self.bound = self.bound.to(device)
            self._set(self._flat.to(device))
        return self

    @torch.no_grad()
    def add(self, error: Float[Tensor, "*shape"], weight: Tensor | None = None, channel_dim: int = -1) -> None:
        """Adds a batch.

        Args:
            error: residuals, float32 or float64, whose ``channel_dim`` has size m.
            weight: weights ≥ 0 or a boolean mask of the same shape. What an element of weight 0 holds is not looked at.
            channel_dim: the dimension of the channels.

        Raises:
            ValueError: a residual that counts is not finite, or a weight is negative or not finite.
        """
        axis = channel_dim % error.dim()
        m = self.bound.shape[0]
        with torch.autocast(error.device.type, enabled=False):
            if weight is not None:
                error = torch.where(weight != 0, error, 0.0)
            # a sum says in a fraction of the time that no element is NaN or infinite
            if not bool(torch.isfinite(error.sum())):
                _refuse_by_channel("residuals", error, torch.isfinite(error), axis)
            if weight is not None and not bool((weight >= 0).all() & torch.isfinite(weight.sum())):
                _refuse_by_channel("weights >= 0", weight, torch.isfinite(weight) & (weight >= 0), axis)
            device = self.to(error.device).sums.device
            along = [1] * error.dim()
            along[axis] = m
            reach = (_REACH * self.bound).to(error.dtype).view(along)
            # clamped, so that its square stays finite
            ratio = error.to(device).abs().div_(reach).clamp_(max=1e18).float()
            offset = torch.arange(0, m * BINS, BINS, dtype=torch.int32, device=device)
            index = _bin_of(ratio).add_(offset.view(along)).flatten()
            square = ratio.double().square_()
            if weight is None:
                ones = torch.ones((), dtype=torch.float64, device=device).expand(error.numel())
                self.sums[0].view(-1).index_add_(0, index, ones)
                self.count += error.numel() / m
            else:
                weight = weight.to(device).double()
                others = [i for i in range(error.dim()) if i != axis]
                self.sums[0].view(-1).index_add_(0, index, weight.flatten())
                self.count += (weight > 0).sum(others) if others else (weight > 0)
                square *= weight
            self.sums[1].view(-1).index_add_(0, index, square.flatten())
            self.batches += 1

    def all_reduce(self) -> None:
        """Adds up the histograms of all processes, in each of them; alone it changes nothing."""
        if dist.is_available() and dist.is_initialized():
            dist.all_reduce(self._flat)

    def clear(self) -> None:
        """Empties the histogram."""
        self._flat.zero_()

    def residuals(self) -> WeightedResiduals:
        """One residual for each bin that is filled in any channel: its root mean square and its summed weight."""
        filled = (self.sums[0] > 0).any(0)
        weight, square = self.sums[:, :, filled]
        rms = _REACH * torch.sqrt(square / torch.where(weight > 0, weight, 1.0))
        return WeightedResiduals((rms * self.bound.unsqueeze(-1)).mT, weight.mT)

    def weight(self) -> Float[Tensor, " m"]:
        """The summed weight of each channel."""
        return self.sums[0].sum(-1)

    def share_beyond(self) -> Float[Tensor, " m"]:
        """The share of the weight that lies beyond the bound; 0 for a channel without any."""
        weight = self.weight()
        return self.sums[0, :, -1] / torch.where(weight > 0, weight, 1.0)

    def state_dict(self) -> dict[str, Any]:
        """The sums, on the CPU; None in their place where there are none."""
        return {"sums": self._flat.cpu().clone() if bool(self._flat.any()) else None}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes over the sums of another histogram of as many channels.

        Raises:
            ValueError: it has another number of channels or of bins.
        """
        sums = state["sums"]
        if sums is None:
            self.clear()
            return
        if sums.shape != self._flat.shape:
            raise ValueError(
                f"Expected a histogram of {self._flat.shape[0]} sums but got {sums.shape[0]}; it was saved with "
                "another number of channels, or by another version."
            )
        self._flat.copy_(sums)


def _bin_of(ratio: Float[Tensor, "*shape"]) -> Int32[Tensor, "*shape"]:
    """The bin of sizes ≥ 0 in units of the bound.

    The leading bits of a float32, its exponent and six of its mantissa, count bins that grow with the number: as good
    as a logarithm, and the same on every device.
    """
    leading = ratio.view(torch.int32) >> (23 - _MANTISSA_BITS)
    return leading.sub_((127 - _OCTAVES) << _MANTISSA_BITS).clamp_(0, _INSIDE)


def _refuse_by_channel(what: str, values: Tensor, good: Tensor, axis: int) -> None:
    """Names the channels of the values that are not good, if there are any."""
    if bool(good.all()):
        return
    bad = (~good).movedim(axis, 0).flatten(1).any(1).nonzero().flatten().tolist()
    worst = values[~good].flatten()[0].item()
    raise ValueError(
        f"Expected finite {what} but got {worst} in channel{'s' if len(bad) > 1 else ''} {', '.join(map(str, bad))}; "
        "an element without a value gets the weight 0 or False, as in loss(input, target, torch.isfinite(target))."
    )

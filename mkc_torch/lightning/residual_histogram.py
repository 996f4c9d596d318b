"""Histograms of any number of residuals per channel in bounded memory, to which a density can be fitted.

The width of a bin is about a hundredth of the residual. A bin keeps the sum of its weights and of its weighted squares;
it represents its residuals by their root mean square, with an error of second order in the width. The sum of histograms
is the histogram of all residuals, so batches, epochs and processes add up.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch import distributed as dist

if TYPE_CHECKING:
    from jaxtyping import Float, Int32

_MANTISSA_BITS = 6
"""Leading bits of the mantissa that select a bin: 64 bins per octave."""

_OCTAVES = 27
"""Octaves below the reach."""

_FIRST = (127 - _OCTAVES) << _MANTISSA_BITS
"""Leading bits of the first bin."""

_LAST = 127 << _MANTISSA_BITS
"""Leading bits of the last bin."""

BINS = _LAST - _FIRST + 1
"""Bins per channel: 64 in each octave from 2⁻²⁷ (7e-9) to 1 times the reach, and a bin for residuals beyond it."""

_MARGIN = 1.0 + 1e-6
"""Factor on the bound: a residual clipped at the bound, of a saturated sensor, lies inside for any rounding."""

_MIN_REACH = 2.0**-126
"""Smallest reach: the smallest normal number of float32."""


class ResidualHistogram:
    """Histogram of the absolute residuals of each channel, with float64 sums.

    Args:
        bound: half-widths of the domain (m,), in the unit of the residuals; the bins extend to them. None, or NaN or
            infinity for a channel: the bins extend to 64 to 128 times the largest residual of the first batch that has
            a residual other than 0. Each process has its own reach; ``all_reduce`` takes the largest.
        num_channels: the number of channels m; required if ``bound`` is None.

    Attributes:
        bound: half-widths of the domain, beyond which ``share_beyond`` counts, (m,); NaN where unknown.
        reach: lower end of the last bin, in the unit of the residuals, (m,); 0 where no batch has set it yet.
        sums: sums of the weights and of weight times (residual / reach)², (2, m, BINS).
        count: number of residuals of positive weight in each channel, (m,).
        refused: number of residuals left out, which ``check`` reports, (m,); on the CPU ``add`` raises instead.
        batches: number of batches, with or without residuals of positive weight, a scalar.

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

    def __init__(self, bound: Float[Tensor, " m"] | None = None, *, num_channels: int | None = None) -> None:
        m = num_channels if bound is None else len(bound)
        if m is None:
            raise ValueError("Expected `bound` or `num_channels` but got neither; pass the number of channels.")
        if num_channels not in (None, m):
            raise ValueError(f"Expected `num_channels` to be {m}, as `bound` has channels, but got {num_channels}.")
        flat = torch.zeros(2 * m * BINS + 2 * m + 1, dtype=torch.float64)
        self._begun = False
        self._place(flat, torch.zeros_like(flat[:m]), torch.zeros_like(flat[:m]))
        self.set_bound(flat[:m] * torch.nan if bound is None else bound)

    def _place(self, flat: Tensor, reach: Tensor, bound: Tensor) -> None:
        """Make sums and counts views of a single tensor, so that one reduction adds them up over processes."""
        m = len(bound)
        self._flat, self.reach, self.bound = flat, reach, bound
        self.sums = flat[: 2 * m * BINS].view(2, m, BINS)
        self._counts = flat[2 * m * BINS : -1].view(2, m)  # residuals used, and all residuals of weight other than 0
        self.count = self._counts[0]
        self.batches = flat[-1]
        self._offset = BINS * torch.arange(m, dtype=torch.int32, device=flat.device) - _FIRST

    @property
    def refused(self) -> Float[Tensor, " m"]:
        return self._counts[1] - self._counts[0]

    def set_bound(self, bound: Float[Tensor, " m"]) -> None:
        """Set the bound beyond which ``share_beyond`` counts; NaN for a channel whose bound is unknown.

        Before the first batch this also sets the reach of the bins; later the bins are unchanged.
        """
        self.bound = bound.detach().to(self.reach, copy=True)
        if not self._begun:
            known = torch.isfinite(self.bound) & (self.bound > 0)
            self.reach.copy_(torch.where(known, _MARGIN * self.bound, 0.0))
            self._reach_is_set = bool(known.all())

    def to(self, device: torch.device) -> ResidualHistogram:
        """Move the histogram; to the CPU instead of an MPS device, which lacks float64."""
        device = torch.device("cpu") if device.type == "mps" else device
        if self._flat.device != device:
            parts = (self._flat, self.reach, self.bound)
            self._place(*(t.to(device, non_blocking=not _can_read(device)) for t in parts))
        return self

    @torch.no_grad()
    def add(self, error: Float[Tensor, "*shape"], weight: Tensor | None = None, channel_dim: int = -1) -> None:
        """Add a batch.

        On the CPU it raises ValueError for an unmasked residual that is not finite, and for a weight that is negative
        or not finite. On an accelerator no value is read: such elements are left out, and ``check`` raises the error.
        Overflowed residuals of float16 or bfloat16 are left out on every device, without an error.

        Args:
            error: residuals whose ``channel_dim`` has size m.
            weight: weights ≥ 0 or a boolean mask of the same shape. Elements of weight 0 are ignored.
            channel_dim: the dimension of the channels.
        """
        axis = channel_dim % error.dim()
        if error.dim() == 1:
            axis, error, weight = 1, error.unsqueeze(0), None if weight is None else weight.unsqueeze(0)
        if error.dtype in (torch.float16, torch.bfloat16):
            finite = torch.isfinite(error)
            error, weight = error.float(), finite if weight is None else weight * finite
        device = self.to(error.device).reach.device
        error, weight = error.to(device), None if weight is None else weight.to(device)
        others = [i for i in range(error.dim()) if i != axis]
        if _can_read(device):
            size = _checked_size(error, weight, axis)
            self._counts += error.numel() / len(self.reach) if weight is None else (weight > 0).sum(others)
        else:
            size, weight = self._leave_out(error.abs(), weight, others)
        if not self._reach_is_set and error.numel():
            self._set_reach(size if weight is None else size * (weight > 0), others)
        along = [-1 if i == axis else 1 for i in range(error.dim())]
        # a channel without a reach has had zeros only, and 0 / inf is 0
        unit = self.reach if self._reach_is_set else torch.threshold(self.reach, 0.0, math.inf)
        # clamped, so that its square stays finite
        ratio = size.div_(unit.to(size.dtype).view(along)).clamp_(max=1e18).float()
        index = _leading_bits(ratio).add_(self._offset.view(along))
        square = ratio.double().square_()
        if weight is None:
            weight = torch.ones((), dtype=torch.float64).expand(error.numel())
        else:
            weight = weight.double()
            square *= weight
        self._add_to_bins(index, weight, square)
        self.batches += 1
        self._begun = True

    def _leave_out(self, size: Tensor, weight: Tensor | None, others: list[int]) -> tuple[Tensor, Tensor]:
        """Sizes and weights with 0 for elements that are not finite or of negative weight; counts the elements."""
        counted = size < math.inf  # False for NaN
        if weight is None:
            self._counts[1].add_(size.numel() / len(self.reach))
            weight = counted
        elif weight.dtype == torch.bool:
            self._counts[1].add_(weight.sum(others))
            weight = counted.logical_and_(weight)
        else:
            self._counts[1].add_((weight != 0).sum(others))
            weight = torch.where(counted.logical_and_(weight > 0).logical_and_(weight < math.inf), weight, 0)
        self.count += counted.sum(others)
        return size.nan_to_num_(0.0, posinf=0.0), weight

    def _set_reach(self, size: Tensor, others: list[int]) -> None:
        """Set the reach of channels without a reach that get a residual other than 0."""
        # the power of two below, by masking the mantissa: bins for another reach are the same bins, shifted
        power = (size.amax(others).double().view(torch.int64) & 0x7FF0000000000000).view(torch.float64)
        found = torch.threshold_(128.0 * power, _MIN_REACH, 0.0).clamp_(max=1.0 / _MIN_REACH)
        torch.where(self.reach > 0, self.reach, found, out=self.reach)
        self._reach_is_set = _can_read(self.reach.device) and bool((self.reach > 0).all())

    def _add_to_bins(self, index: Tensor, *values: Tensor) -> None:
        index = index.flatten()
        for sums, added in zip(self.sums, values, strict=True):
            sums.view(-1).index_add_(0, index, added.flatten())

    def check(self) -> None:
        """Raise the ValueError that ``add`` defers on an accelerator; after ``all_reduce`` in every process."""
        refused, reach = torch.stack((self.refused, self.reach)).tolist()
        self._reach_is_set = all(r > 0 for r in reach)
        if any(refused):
            bad = [i for i, n in enumerate(refused) if n]
            raise _refusal("residuals and weights >= 0", f"{sum(refused):.0f} others", bad)

    def all_reduce(self) -> None:
        """Replace the histogram of each process by the sum over all processes; without processes it changes nothing.

        All processes get the largest reach. A process whose reach grows shifts its bins by whole octaves, and moves its
        residuals beyond the old reach to the bin of their root mean square.
        """
        if dist.is_available() and dist.is_initialized():
            reach = self.reach.clone()
            dist.all_reduce(reach, dist.ReduceOp.MAX)
            weight, square = self.sums.clone()
            square *= (self.reach / torch.where(reach > 0, reach, 1.0)).square().unsqueeze(-1)
            index = _leading_bits(_rms(weight, square).float()).add_(self._offset.unsqueeze(-1))
            self.sums.zero_()
            self._add_to_bins(index, weight, square)
            self.reach.copy_(reach)
            dist.all_reduce(self._flat)
            self._begun = True

    def clear(self) -> None:
        """Empty the histogram; the reach is kept."""
        self._flat.zero_()

    def residuals(self) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N m"]]:
        """Root mean square and summed weight of each bin that is not empty in every channel, float64."""
        weight, square = self.sums[:, :, (self.sums[0] > 0).any(0)]
        return (_rms(weight, square) * self.reach.unsqueeze(-1)).mT, weight.mT

    def weight(self) -> Float[Tensor, " m"]:
        """The summed weight of each channel."""
        return self.sums[0].sum(-1)

    def share_beyond(self) -> Float[Tensor, " m"]:
        """Share of the weight beyond the bound; 0 for a channel without weight, NaN for a channel without a bound.

        Exact if the bins extend to the bound. Otherwise the root mean square of a bin decides.
        """
        weight, square = self.sums
        edge = _MARGIN * self.bound / torch.where(self.reach > 0, self.reach, 1.0)
        # the last bin begins at 1; the largest float32 below it is 1 - 6e-8
        beyond = _rms(weight, square) >= (1.0 - 1e-9) * edge.unsqueeze(-1)
        total = self.weight()
        share = torch.where(beyond, weight, 0.0).sum(-1) / torch.where(total > 0, total, 1.0)
        return torch.where(torch.isnan(self.bound), torch.nan, share)

    def state_dict(self) -> dict[str, Any]:
        """The sums and counts (None if all are 0), the reach and the bound, on the CPU."""
        return {
            "sums": self._flat.cpu().clone() if bool(self._flat.any()) else None,
            "reach": self.reach.cpu().clone(),
            "bound": self.bound.cpu().clone(),
            "begun": self._begun,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load the state of another histogram; ValueError if that has other channels or bins."""
        sums, reach = state["sums"], state["reach"]
        if reach.shape != self.reach.shape or (sums is not None and sums.shape != self._flat.shape):
            raise ValueError(
                f"Expected a histogram of {len(self.reach)} channels but got {len(reach)} channels; it was saved with "
                "another number of channels, or by another version."
            )
        self.clear()
        if sums is not None:
            self._flat.copy_(sums)
        self.reach.copy_(reach)
        self.bound = state["bound"].to(self.reach)
        self._begun = state["begun"]
        self._reach_is_set = bool((reach > 0).all())


def _can_read(device: torch.device) -> bool:
    """Whether values can be read without waiting for a device."""
    return device.type == "cpu"


def _rms(weight: Tensor, square: Tensor) -> Tensor:
    """Root mean square of each bin, in units of the reach; 0 for an empty bin."""
    return torch.sqrt(square / torch.where(weight > 0, weight, 1.0))


def _leading_bits(ratio: Float[Tensor, "*shape"]) -> Int32[Tensor, "*shape"]:
    """Bin of each size ≥ 0 in units of the reach, from _FIRST to _LAST.

    The leading bits of a float32, its exponent and six bits of its mantissa, are the bin's number: nearly logarithmic,
    and the same on every device.
    """
    return (ratio.view(torch.int32) >> (23 - _MANTISSA_BITS)).clamp_(_FIRST, _LAST)


def _checked_size(error: Tensor, weight: Tensor | None, axis: int) -> Tensor:
    """Absolute residuals, 0 where masked; ValueError unless residuals and weights are finite and weights >= 0."""
    size = error.abs()
    if weight is not None and not _has_finite_sum(size):
        size = torch.where(weight != 0, size, 0.0)
    if not _has_finite_sum(size):
        _refuse_by_channel("residuals", error, torch.isfinite(size), axis)
    if weight is not None and not (bool((weight >= 0).all()) and _has_finite_sum(weight)):
        _refuse_by_channel("weights >= 0", weight, torch.isfinite(weight) & (weight >= 0), axis)
    return size


def _has_finite_sum(values: Tensor) -> bool:
    """Whether the sum is finite: a fast check for NaN and infinity; False also if the sum overflows."""
    return math.isfinite(values.sum().item())


def _refuse_by_channel(what: str, values: Tensor, good: Tensor, axis: int) -> None:
    """Raise ValueError with the channels of values that are not ``good``, if any."""
    if bool(good.all()):
        return
    bad = (~good).movedim(axis, 0).flatten(1).any(1).nonzero().flatten().tolist()
    raise _refusal(what, values[~good].flatten()[0].item(), bad)


def _refusal(what: str, got: object, channels: list[int]) -> ValueError:
    named = f"channel{'s' if len(channels) > 1 else ''} {', '.join(map(str, channels))}"
    hint = "mask missing values by the weight 0 or False, as in loss(input, target, torch.isfinite(target))."
    return ValueError(f"Expected finite {what} but got {got} in {named}; {hint}")

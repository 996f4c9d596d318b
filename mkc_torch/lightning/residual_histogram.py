"""Residuals of any number in bounded memory: a histogram per channel that a density can be fitted to.

The bins are a hundredth of the residual's size wide, and each keeps the sum of its weights and of its squares. A bin
then stands for its residuals as one residual of their root mean square, which leaves an error of second order in the
width. Sums of histograms are histograms of all the residuals, so batches, epochs and processes add up.
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
_OCTAVES = 27
_FIRST, _LAST = (127 - _OCTAVES) << _MANTISSA_BITS, 127 << _MANTISSA_BITS
BINS = _LAST - _FIRST + 1
"""Bins of a channel: 64 in each octave from 2⁻²⁷ (7e-9) to 1 times the reach, and one for what lies beyond it."""

# a residual clipped at the bound, a saturated sensor's, lies inside whatever way the division rounds
_MARGIN = 1.0 + 1e-6
_MIN_REACH = 2.0**-126  # of the normal numbers of float32


class ResidualHistogram:
    """A histogram of the sizes of residuals for each channel; it keeps float64 sums, however many there are.

    Args:
        bound: half-widths of the domain (m,), in the unit of the residuals. The bins reach up to them. None, or NaN or
            infinity for a channel: the bins reach 64 to 128 times as far as the largest residual of the first batch
            with a residual other than 0; each process takes its own reach, and ``all_reduce`` the largest of them.
        num_channels: the number of channels m; needed where ``bound`` is None.

    Attributes:
        bound: half-widths of the domain, beyond which ``share_beyond`` counts, (m,); NaN where unknown.
        reach: the size at which the last bin begins, (m,); 0 where no batch has set it yet.
        sums: of the weights and of weight times (residual / reach)², (2, m, BINS).
        count: how many residuals of positive weight each channel got, (m,).
        refused: how many residuals were left out for ``check`` to report, (m,); on the CPU ``add`` raises at once.
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

    def __init__(self, bound: Float[Tensor, " m"] | None = None, *, num_channels: int | None = None) -> None:
        m = num_channels if bound is None else len(bound)
        if m is None or num_channels not in (None, m):
            raise ValueError(f"Expected `bound` or `num_channels`, or both alike, but got {bound} and {num_channels}.")
        flat = torch.zeros(2 * m * BINS + 2 * m + 1, dtype=torch.float64)
        self._begun = False
        self._place(flat, torch.zeros_like(flat[:m]), torch.zeros_like(flat[:m]))
        self.set_bound(flat[:m] * torch.nan if bound is None else bound)

    def _place(self, flat: Tensor, reach: Tensor, bound: Tensor) -> None:
        """Takes the sums and counts from one tensor, so that one message adds them up over processes."""
        m = len(bound)
        self._flat, self.reach, self.bound = flat, reach, bound
        self.sums = flat[: 2 * m * BINS].view(2, m, BINS)
        self._counts = flat[2 * m * BINS : -1].view(2, m)  # of residuals counted, and of all with a weight other than 0
        self.count = self._counts[0]
        self.batches = flat[-1]
        self._offset = BINS * torch.arange(m, dtype=torch.int32, device=flat.device) - _FIRST

    @property
    def refused(self) -> Float[Tensor, " m"]:
        return self._counts[1] - self._counts[0]

    def set_bound(self, bound: Float[Tensor, " m"]) -> None:
        """Sets the bound beyond which ``share_beyond`` counts; NaN for a channel whose bound is unknown.

        Before the first batch it is the reach of the bins as well; afterwards they stay as they are.
        """
        self.bound = bound.detach().to(self.reach, copy=True)
        if not self._begun:
            known = torch.isfinite(self.bound) & (self.bound > 0)
            self.reach.copy_(torch.where(known, _MARGIN * self.bound, 0.0))
            self._reach_is_set = bool(known.all())

    def to(self, device: torch.device) -> ResidualHistogram:
        """Moves the histogram; to the CPU instead of an MPS device, which has no float64."""
        device = torch.device("cpu") if device.type == "mps" else device
        if self._flat.device != device:
            parts = (self._flat, self.reach, self.bound)
            self._place(*(t.to(device, non_blocking=not _can_read(device)) for t in parts))
        return self

    @torch.no_grad()
    def add(self, error: Float[Tensor, "*shape"], weight: Tensor | None = None, channel_dim: int = -1) -> None:
        """Adds a batch.

        On the CPU it raises a ValueError if a residual that counts, or a weight, is not finite, or a weight negative.
        On an accelerator no value is read: such elements are left out, and ``check`` raises the error. Residuals of
        float16 or bfloat16 that overflowed are left out on every device, without an error.

        Args:
            error: residuals whose ``channel_dim`` has size m.
            weight: weights ≥ 0 or a boolean mask of the same shape. What an element of weight 0 holds is not looked at.
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
        # a channel without a reach got nothing but zeros, and 0 / inf is 0
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
        """Sizes and weights with 0 in place of what is not finite and of negative weights; counts the elements."""
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
        """Sets the reach of the channels that have none and get a residual other than 0."""
        # the power of two below, a float64 without its other bits: bins of another reach are the same bins, moved on
        power = (size.amax(others).double().view(torch.int64) & 0x7FF0000000000000).view(torch.float64)
        found = torch.threshold_(128.0 * power, _MIN_REACH, 0.0).clamp_(max=1.0 / _MIN_REACH)
        torch.where(self.reach > 0, self.reach, found, out=self.reach)
        self._reach_is_set = _can_read(self.reach.device) and bool((self.reach > 0).all())

    def _add_to_bins(self, index: Tensor, *values: Tensor) -> None:
        index = index.flatten()
        for sums, added in zip(self.sums, values, strict=True):
            sums.view(-1).index_add_(0, index, added.flatten())

    def check(self) -> None:
        """Raises the ValueError that ``add`` did not raise on an accelerator; after ``all_reduce`` in every process."""
        refused, reach = torch.stack((self.refused, self.reach)).tolist()
        self._reach_is_set = all(r > 0 for r in reach)
        if any(refused):
            bad = [i for i, n in enumerate(refused) if n]
            raise _refusal("residuals and weights >= 0", f"{sum(refused):.0f} others", bad)

    def all_reduce(self) -> None:
        """Adds up the histograms of all processes, in each of them; alone it changes nothing.

        The largest reach becomes that of all. A process whose reach grows moves its bins by whole octaves, and what it
        had beyond its reach, to the bin of its root mean square.
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
        """Empties the histogram; the reach stays."""
        self._flat.zero_()

    def residuals(self) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N m"]]:
        """Root mean square and summed weight of each bin that is filled in any channel, float64."""
        weight, square = self.sums[:, :, (self.sums[0] > 0).any(0)]
        return (_rms(weight, square) * self.reach.unsqueeze(-1)).mT, weight.mT

    def weight(self) -> Float[Tensor, " m"]:
        """The summed weight of each channel."""
        return self.sums[0].sum(-1)

    def share_beyond(self) -> Float[Tensor, " m"]:
        """The share of the weight beyond the bound; 0 for a channel without weight, NaN for one without a bound.

        Exact where the bins reach up to the bound. Else a bin counts as its root mean square does.
        """
        weight, square = self.sums
        edge = _MARGIN * self.bound / torch.where(self.reach > 0, self.reach, 1.0)
        # the last bin begins at 1, and the largest float32 below 1 is 6e-8 less
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
        """Takes over the state of another histogram; raises a ValueError if that has other channels or bins."""
        sums, reach = state["sums"], state["reach"]
        if reach.shape != self.reach.shape or (sums is not None and sums.shape != self._flat.shape):
            raise ValueError(
                f"Expected a histogram of {len(self.reach)} channels but got one of {len(reach)}; it was saved with "
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
    """The bin of sizes ≥ 0 in units of the reach, counted from _FIRST to _LAST.

    The leading bits of a float32, its exponent and six of its mantissa, count bins that grow with the number: as good
    as a logarithm, and the same on every device.
    """
    return (ratio.view(torch.int32) >> (23 - _MANTISSA_BITS)).clamp_(_FIRST, _LAST)


def _checked_size(error: Tensor, weight: Tensor | None, axis: int) -> Tensor:
    """Sizes of the residuals that count; raises an error unless they and the weights are finite, and weights >= 0."""
    size = error.abs()
    if weight is not None and not _has_finite_sum(size):
        size = torch.where(weight != 0, size, 0.0)
    if not _has_finite_sum(size):
        _refuse_by_channel("residuals", error, torch.isfinite(size), axis)
    if weight is not None and not (bool((weight >= 0).all()) and _has_finite_sum(weight)):
        _refuse_by_channel("weights >= 0", weight, torch.isfinite(weight) & (weight >= 0), axis)
    return size


def _has_finite_sum(values: Tensor) -> bool:
    """Whether no value is NaN or infinite, in a fraction of the time; False also where the sum overflows."""
    return math.isfinite(values.sum().item())


def _refuse_by_channel(what: str, values: Tensor, good: Tensor, axis: int) -> None:
    """Names the channels of the values that are not good, if there are any."""
    if bool(good.all()):
        return
    bad = (~good).movedim(axis, 0).flatten(1).any(1).nonzero().flatten().tolist()
    raise _refusal(what, values[~good].flatten()[0].item(), bad)


def _refusal(what: str, got: object, channels: list[int]) -> ValueError:
    named = f"channel{'s' if len(channels) > 1 else ''} {', '.join(map(str, channels))}"
    hint = "an element without a value gets the weight 0 or False, as in loss(input, target, torch.isfinite(target))."
    return ValueError(f"Expected finite {what} but got {got} in {named}; {hint}")

"""Noise whose spread depends on the input, distinguished from outliers by the inner errors alone.

A mixture of Gaussians of different spread has heavy tails too. Outliers that are independent of the input leave the
inner 40 % of the errors alike at every input; a spread that depends on the input does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from mkc_torch.density.tails import ChannelTails, Tails, assess_tails, percent_with_error

if TYPE_CHECKING:
    from jaxtyping import Float

INNER = 0.4
"""Share of the absolute errors that is inner: below 0.5, because half of the targets may be wrong."""

NORMAL_INNER = 0.5244005
"""The ``INNER`` quantile of the absolute value of a standard normal variable."""

MOST_BINS = 8
"""Groups of neighbouring inputs, at most."""

ROWS_IN_BIN = 40
"""Errors in a group, at least."""

LEVEL = 1e-4
"""p-value, corrected for the number of columns, below which the spread depends on a column."""

LEAST_RATIO = 2.0
"""Ratio of the largest and the smallest spread of the groups from which a dependence is reported. Of 600 errors of
equal noise the ratio is 1.5 in the median and 2.2 in one of a hundred draws; ``LEVEL`` rejects those. Both were set
on the first five shapes of examples/lightning/noise_over_input.py and on wrong targets of five kinds."""


LEAST_OUTLIERS = 0.04
"""Share of the errors beyond 3 local scales from which outliers are reported: groups that are too coarse for the spread
leave up to 3 %. Set on the same draws."""


class NoiseSpread(NamedTuple):
    """Dependence of a channel's noise on a column.

    Attributes:
        column: name of the column on which the spread depends most clearly.
        least, most: smallest and largest robust standard deviation of the errors over the column's groups, in the unit
            of the error.
        p_value: of equal spread everywhere, corrected for the number of columns.
        tails: test of the errors divided by their local spread: whether outliers remain.

    Example:
        >>> print(NoiseSpread("feature 3", 0.06, 0.81, 1e-20, ChannelTails(1.3, 0.0027, 0.0014)))
        noise depends on feature 3 (spread 0.06 to 0.81), no outliers; use MKCHead
    """

    column: str
    least: float
    most: float
    p_value: float
    tails: ChannelTails

    @property
    def has_outliers(self) -> bool:
        """Whether errors are far outside the spread at their input."""
        return not self.tails.is_gaussian and self.tails.share_beyond > LEAST_OUTLIERS

    def __str__(self) -> str:
        outliers = "no outliers"
        if self.has_outliers:
            outliers = (
                f"{percent_with_error(self.tails.share_beyond, self.tails.share_error)} of the errors beyond 3 local d"
            )
        spread = f"spread {self.least:.2g} to {self.most:.2g}"
        return f"noise depends on {self.column} ({spread}), {outliers}; use MKCHead"


@dataclass(frozen=True)
class TailsOverInput(Tails):
    """Test of residuals for heavy tails, and for noise that depends on the input.

    ``str`` has a line for each channel.

    Attributes:
        spread: of each channel, the dependence of its noise on the predictions or features; None if there is none.
    """

    spread: tuple[NoiseSpread | None, ...] = ()

    def __str__(self) -> str:
        lines = [str(own or channel) for own, channel in zip(self.spread, self.channels, strict=True)]
        if len(lines) == 1:
            return lines[0]
        return "\n".join(f"channel {k}: {line}" for k, line in enumerate(lines))


def spread_over(
    error: Float[np.ndarray, " N"],
    weight: Float[np.ndarray, " N"],
    columns: Sequence[tuple[str, Float[np.ndarray, " N"]]],
) -> NoiseSpread | None:
    """The dependence of the spread of errors on the column on which it depends most clearly, or None.

    In each of up to eight groups of neighbouring values of a column, the share of errors within the overall 40 %
    quantile of their size is compared by Pearson's chi-square test.

    Args:
        error: residuals of a channel.
        weight: non-negative weights; errors of weight 0 are ignored.
        columns: names and values of the columns.

    Example:
        >>> random = np.random.default_rng(0)
        >>> x = random.uniform(size=1000)
        >>> spread_over((0.1 + x) * random.normal(size=1000), np.ones(1000), [("feature 0", x)]).column
        'feature 0'
    """
    used = weight > 0
    error, weight = error[used].astype(np.float64), weight[used].astype(np.float64)
    size = np.abs(error)
    bins = min(len(size) // ROWS_IN_BIN, MOST_BINS)
    if bins < 2:
        return None
    inner = size <= weighted_quantile(size, weight, INNER)
    best, found = 0.0, None
    for name, values in columns:
        group = _groups(values[used], bins)
        count = int(group.max()) + 1
        if count < 2:
            continue
        sums = np.bincount(group, weight)
        share = weight[inner].sum() / weight.sum()
        shares = np.bincount(group, weight * inner) / sums
        # the effective number of errors in all groups together (Kish)
        number = weight.sum() / np.square(weight).sum() * sums
        statistic = float((number * (shares - share) ** 2).sum() / max(share * (1.0 - share), 1e-12))
        half_freedom = torch.tensor(0.5 * (count - 1), dtype=torch.float64)
        p_value = len(columns) * float(torch.special.gammaincc(half_freedom, torch.tensor(0.5 * statistic).double()))
        spread = _spread(size, weight, group)
        if p_value < LEVEL and statistic - count > best and spread.min() > 0 and _ratio(spread) > LEAST_RATIO:
            best, found = statistic - count, (name, group, spread, min(p_value, 1.0), values[used])
    if found is None:
        return None
    name, group, spread, p_value, values = found
    local = error / _local(values, group, spread)
    tails = assess_tails(torch.from_numpy(local)[:, None], torch.from_numpy(weight)[:, None]).channels[0]
    return NoiseSpread(name, float(spread.min()), float(spread.max()), p_value, tails)


def _ratio(spread: np.ndarray) -> float:
    return float(spread.max() / spread.min())


def weighted_quantile(values: Float[np.ndarray, " N"], weight: Float[np.ndarray, " N"], level: float) -> float:
    """The smallest value up to which a share ``level`` of the weight lies."""
    order = np.argsort(values, kind="stable")
    cumulated = weight[order].cumsum()
    return float(values[order][np.searchsorted(cumulated, level * cumulated[-1]).clip(max=len(values) - 1)])


def _groups(values: np.ndarray, bins: int) -> np.ndarray:
    """Groups of neighbouring values, of about the same size where values differ; numbered from 0 without gaps."""
    edges = np.unique(np.quantile(values, np.arange(1, bins) / bins))
    group: np.ndarray = np.unique(np.searchsorted(edges, values), return_inverse=True)[1]
    return group


def _spread(size: np.ndarray, weight: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Robust standard deviation of the errors in each group."""
    own = [weighted_quantile(size[group == k], weight[group == k], INNER) for k in range(int(group.max()) + 1)]
    return np.array(own) / NORMAL_INNER


def _local(values: np.ndarray, group: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Spread at each value, interpolated between the groups on the ranks of the values."""
    ordered = np.sort(values)
    rank = 0.5 * (np.searchsorted(ordered, values) + np.searchsorted(ordered, values, side="right"))
    centre = np.bincount(group, rank) / np.bincount(group)
    local: np.ndarray = np.exp(np.interp(rank, centre, np.log(spread)))
    return local

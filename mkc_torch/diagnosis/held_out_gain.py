"""The gain of a finding on held-out blocks: likelihood, and residuals with and without the finding."""

from __future__ import annotations

import math
from typing import Literal

from mkc_torch.diagnosis.parts import HeldOut
from mkc_torch.diagnosis.thresholds import SMALL

Confirmation = Literal["surely", "probably", "not shown", "worse"]

_NORMAL_95 = 1.96
"""Half-width of a 95 % interval in standard errors."""


def confirmation(gain: float, interval: tuple[float, float]) -> Confirmation:
    """Classify a gain on held-out blocks by its 95 % interval.

    "probably": a gain above its standard error whose interval contains 0.

    Example:
        >>> confirmation(0.3, (0.2, 0.4)), confirmation(0.13, (-0.02, 0.28)), confirmation(0.01, (-0.1, 0.1))
        ('surely', 'probably', 'not shown')
        >>> confirmation(-0.3, (-0.4, -0.2)), confirmation(0.3, (float("nan"), float("nan")))
        ('worse', 'not shown')
    """
    low, high = interval
    if low > 0.0:
        return "surely"
    if high < 0.0:
        return "worse"
    error = (high - low) / (2.0 * _NORMAL_95)
    return "probably" if math.isfinite(error) and gain > error else "not shown"


def better_on_average(held_out: HeldOut) -> bool:
    """Whether likelihood and residual on held-out blocks are better in the mean, whatever the interval of the gain."""
    return held_out.log_likelihood_gain > 0.0 and mean_ratio(held_out) <= 1.0 - SMALL


def rejects(held_out: HeldOut) -> bool:
    """Whether held-out blocks reject a finding: a larger open-loop residual, or a smaller likelihood without gain.

    Several outputs are combined by the geometric mean of their residual ratios.

    Example:
        >>> from mkc_torch.diagnosis.parts import ResidualSizes
        >>> each = {"angle": ResidualSizes(2.0, 1.8, "rad"), "speed": ResidualSizes(2.0, 3.0, "rad/s")}
        >>> rejects(HeldOut(0.0, (-0.1, 0.1), 2.0, 1.8, "", each))
        True
        >>> rejects(HeldOut(0.0, (-0.1, 0.1), 2.0, 1.0, "m")), rejects(HeldOut(0.0, (-0.1, 0.1), 2.0, 2.2, "m"))
        (False, True)
    """
    less = 1.0 - mean_ratio(held_out)
    worse = confirmation(held_out.log_likelihood_gain, held_out.confidence_interval) == "worse"
    return less < -SMALL or (worse and less < SMALL)


def mean_ratio(held_out: HeldOut) -> float:
    """Return the geometric mean over the outputs of the ratio of residuals with and without the finding."""
    ratios = [_ratio(*pair) for pair in _sizes(held_out)]
    return math.exp(sum(map(math.log, ratios)) / len(ratios))


def change(held_out: HeldOut) -> float:
    """Return the largest relative reduction of an output's residual; 0 if unknown.

    Example:
        >>> round(change(HeldOut(0.3, (0.2, 0.4), 2.0, 1.5, "µT")), 3)
        0.25
        >>> from mkc_torch.diagnosis.parts import ResidualSizes
        >>> each = {"angle": ResidualSizes(0.2, 0.1, "rad"), "speed": ResidualSizes(3.0, 3.0, "rad/s")}
        >>> change(HeldOut(0.3, (0.2, 0.4), 3.0, 3.0, "", each))
        0.5
    """
    return 1.0 - min(_ratio(*pair) for pair in _sizes(held_out))


def _sizes(held_out: HeldOut) -> list[tuple[float, float]]:
    """Return residual before and after of each output."""
    each = [(output.before, output.after) for output in held_out.outputs.values()]
    return each or [(held_out.rmse_before, held_out.rmse_after)]


def _ratio(before: float, after: float) -> float:
    """Return the ratio of residuals after and before; 1 if unknown."""
    return after / before if before > 0.0 and 0.0 < after / before < math.inf else 1.0

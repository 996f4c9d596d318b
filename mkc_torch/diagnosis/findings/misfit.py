"""Whether the open-loop simulation predicts each output better than the output's mean."""

from __future__ import annotations

from mkc_torch.diagnosis.environment import GoodnessOfFit, NoiseEnvironment

__all__ = ["follows", "follows_all"]

_FLOOR = 2.0
"""Residual, in noise floors, up to which an output that hardly varies counts as fitted."""


def follows(fit: GoodnessOfFit) -> bool:
    """Whether the residual of an output is smaller than that of its mean, or at the sensor's noise.

    Example:
        >>> still = GoodnessOfFit("angle", "rad", 0.0051, 0.005, -0.04, 0.005, "declared", 0.005, 0.007)
        >>> lost = GoodnessOfFit("angle", "rad", 0.36, 0.35, -0.06, 0.005, "declared", 0.35, 0.02)
        >>> follows(still), follows(lost)
        (True, False)
    """
    return fit.residual < fit.rmse_of_mean or fit.residual <= _FLOOR * fit.noise_floor


def follows_all(environment: NoiseEnvironment) -> bool:
    """Whether :func:`follows` holds for each output."""
    return all(follows(fit) for fit in environment.goodness_of_fit)

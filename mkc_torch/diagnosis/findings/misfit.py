"""Whether a simulation's free run is of more use than a trivial prediction, output by output."""

from __future__ import annotations

from mkc_torch.diagnosis.environment import GoodnessOfFit, NoiseEnvironment

__all__ = ["follows", "follows_all"]

_FLOOR = 2.0
"""Times the sensor's noise floor up to which a residual is as good as noise: an output that hardly varies beyond its
noise is predicted by its mean as well, and no simulation is worse for that."""


def follows(one: GoodnessOfFit) -> bool:
    """Whether an output is followed: better than by its mean, or down to the sensor's noise.

    Example:
        >>> still = GoodnessOfFit("angle", "rad", 0.0051, 0.005, -0.04, 0.005, "declared", 0.005, 0.007)
        >>> lost = GoodnessOfFit("angle", "rad", 0.36, 0.35, -0.06, 0.005, "declared", 0.35, 0.02)
        >>> follows(still), follows(lost)
        (True, False)
    """
    return one.residual < one.rmse_of_mean or one.residual <= _FLOOR * one.noise_floor


def follows_all(world: NoiseEnvironment) -> bool:
    """Whether each output is that is known of."""
    return all(follows(fit) for fit in world.goodness_of_fit)

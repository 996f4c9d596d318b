"""The MKC density: energy, normaliser, distribution, fit to residuals, test of their tails, robustness."""

from mkc_torch.density.distribution import MKCDistribution
from mkc_torch.density.fit import DensityFit, fit_density
from mkc_torch.density.many_kernels import KernelsFit, fit_kernels
from mkc_torch.density.noise_spread import NoiseSpread, TailsOverInput
from mkc_torch.density.robustness import (
    bandwidth_for_efficiency,
    breakdown_point,
    error_bound,
    error_bound_slope,
    gaussian_breakdown,
    gaussian_efficiency,
    least_bandwidth,
)
from mkc_torch.density.tails import ChannelTails, Tails, assess_tails

__all__ = [
    "ChannelTails",
    "DensityFit",
    "KernelsFit",
    "MKCDistribution",
    "NoiseSpread",
    "Tails",
    "TailsOverInput",
    "assess_tails",
    "bandwidth_for_efficiency",
    "breakdown_point",
    "error_bound",
    "error_bound_slope",
    "fit_density",
    "fit_kernels",
    "gaussian_breakdown",
    "gaussian_efficiency",
    "least_bandwidth",
]

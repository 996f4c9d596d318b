"""Robust losses for networks, and inlier weights, outliers and intervals from a trained loss."""

from mkc_torch.losses.entropy_like import LELoss, entropy_like, least_entropy_like
from mkc_torch.losses.generalized_cross_entropy import GeneralizedCrossEntropyLoss, graduated_sigma
from mkc_torch.losses.heteroscedastic import HeteroscedasticMKCLoss, MKCConvHead, MKCHead, MKCHeadOutput
from mkc_torch.losses.mkc import MKCLoss
from mkc_torch.losses.uncertainty import beyond_bound, inlier_weight, outliers, predictive_interval

__all__ = [
    "GeneralizedCrossEntropyLoss",
    "HeteroscedasticMKCLoss",
    "LELoss",
    "MKCConvHead",
    "MKCHead",
    "MKCHeadOutput",
    "MKCLoss",
    "beyond_bound",
    "entropy_like",
    "graduated_sigma",
    "inlier_weight",
    "least_entropy_like",
    "outliers",
    "predictive_interval",
]

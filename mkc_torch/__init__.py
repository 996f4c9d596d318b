"""Multi-kernel correntropy in PyTorch: robust likelihoods, regression and sensor calibration."""

from importlib.metadata import version

from mkc_torch import functional, linear
from mkc_torch.classification import GeneralizedCrossEntropyLoss, graduated_sigma
from mkc_torch.density_fit import DensityFit, fit_density
from mkc_torch.diagnosis import Diagnosis, diagnose
from mkc_torch.distribution import MKCDistribution
from mkc_torch.ellipsoid import EllipsoidFit, NotIdentifiableError
from mkc_torch.entropy_like import LELoss, least_entropy_like
from mkc_torch.heteroscedastic import HeteroscedasticMKCLoss, MKCHead
from mkc_torch.losses import MKCLoss
from mkc_torch.recording import Recording
from mkc_torch.uncertainty import beyond_bound, inlier_weight, outliers, predictive_interval

__version__ = version("mkc-torch")

__all__ = [
    "DensityFit",
    "Diagnosis",
    "EllipsoidFit",
    "GeneralizedCrossEntropyLoss",
    "HeteroscedasticMKCLoss",
    "LELoss",
    "MKCDistribution",
    "MKCHead",
    "MKCLoss",
    "NotIdentifiableError",
    "Recording",
    "beyond_bound",
    "diagnose",
    "fit_density",
    "functional",
    "graduated_sigma",
    "inlier_weight",
    "least_entropy_like",
    "linear",
    "outliers",
    "predictive_interval",
]

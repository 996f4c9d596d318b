"""Multi-kernel correntropy in PyTorch: robust likelihoods, regression and sensor calibration."""

from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from typing import TYPE_CHECKING

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

if TYPE_CHECKING:
    from mkc_torch import functional, linear
    from mkc_torch.classification import GeneralizedCrossEntropyLoss, graduated_sigma
    from mkc_torch.density_fit import DensityFit, fit_density
    from mkc_torch.diagnosis.diagnose import diagnose
    from mkc_torch.diagnosis.result import Diagnosis
    from mkc_torch.distribution import MKCDistribution
    from mkc_torch.ellipsoid import EllipsoidFit, NotIdentifiableError
    from mkc_torch.entropy_like import LELoss, least_entropy_like
    from mkc_torch.heteroscedastic import HeteroscedasticMKCLoss, MKCHead
    from mkc_torch.losses import MKCLoss
    from mkc_torch.recording import Recording
    from mkc_torch.uncertainty import beyond_bound, inlier_weight, outliers, predictive_interval
else:
    _HOMES = {
        "DensityFit": "density_fit",
        "Diagnosis": "diagnosis",
        "EllipsoidFit": "ellipsoid",
        "GeneralizedCrossEntropyLoss": "classification",
        "HeteroscedasticMKCLoss": "heteroscedastic",
        "LELoss": "entropy_like",
        "MKCDistribution": "distribution",
        "MKCHead": "heteroscedastic",
        "MKCLoss": "losses",
        "NotIdentifiableError": "ellipsoid",
        "Recording": "recording",
        "beyond_bound": "uncertainty",
        "diagnose": "diagnosis",
        "fit_density": "density_fit",
        "graduated_sigma": "classification",
        "inlier_weight": "uncertainty",
        "least_entropy_like": "entropy_like",
        "outliers": "uncertainty",
        "predictive_interval": "uncertainty",
    }

    def __getattr__(name):
        # torch takes seconds to import; until then the command line has to be able to say that it was interrupted
        if name in _HOMES:
            value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
        elif not name.startswith("_") and find_spec(f"{__name__}.{name}") is not None:
            value = import_module(f"{__name__}.{name}")
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value
        return value

    def __dir__():
        return sorted({*globals(), *__all__})

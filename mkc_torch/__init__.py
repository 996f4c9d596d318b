"""Multi-kernel correntropy in PyTorch: robust likelihoods, regression and sensor calibration."""

from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import TYPE_CHECKING

__all__ = [
    "DensityFit",
    "Diagnosis",
    "EllipsoidFit",
    "GeneralizedCrossEntropyLoss",
    "HeteroscedasticMKCLoss",
    "KernelsFit",
    "LELoss",
    "MKCConvHead",
    "MKCDistribution",
    "MKCHead",
    "MKCLoss",
    "NotIdentifiableError",
    "Recording",
    "RecordingCheck",
    "beyond_bound",
    "check",
    "diagnose",
    "fit_density",
    "fit_kernels",
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
    from mkc_torch.calibration import EllipsoidFit, NotIdentifiableError
    from mkc_torch.density import DensityFit, KernelsFit, MKCDistribution, fit_density, fit_kernels
    from mkc_torch.diagnosis.diagnose import diagnose
    from mkc_torch.diagnosis.result import Diagnosis
    from mkc_torch.diagnosis.validation.check import check
    from mkc_torch.diagnosis.validation.result import RecordingCheck
    from mkc_torch.losses import (
        GeneralizedCrossEntropyLoss,
        HeteroscedasticMKCLoss,
        LELoss,
        MKCConvHead,
        MKCHead,
        MKCLoss,
        beyond_bound,
        graduated_sigma,
        inlier_weight,
        least_entropy_like,
        outliers,
        predictive_interval,
    )
    from mkc_torch.recording import Recording

    __version__: str
else:
    _HOMES = {
        "calibration": ("EllipsoidFit", "NotIdentifiableError"),
        "density": ("DensityFit", "KernelsFit", "MKCDistribution", "fit_density", "fit_kernels"),
        "diagnosis": ("Diagnosis", "RecordingCheck", "check", "diagnose"),
        "losses": (
            "GeneralizedCrossEntropyLoss",
            "HeteroscedasticMKCLoss",
            "LELoss",
            "MKCConvHead",
            "MKCHead",
            "MKCLoss",
            "beyond_bound",
            "graduated_sigma",
            "inlier_weight",
            "least_entropy_like",
            "outliers",
            "predictive_interval",
        ),
        "recording": ("Recording",),
    }

    def __getattr__(name):
        # torch takes seconds to import; an interrupt before that must still reach the command line's handler
        if name == "__version__":
            from importlib.metadata import version

            globals()[name] = version("mkc-torch")
            return globals()[name]
        home = next((room for room, names in _HOMES.items() if name in names), None)
        if home is not None:
            value = getattr(import_module(f"{__name__}.{home}"), name)
        elif not name.startswith("_") and find_spec(f"{__name__}.{name}") is not None:
            value = import_module(f"{__name__}.{name}")
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value
        return value

    def __dir__():
        rooms = {room.name for room in iter_modules(__path__) if not room.name.startswith("_")}
        return sorted(rooms | set(__all__))

"""Table II of Li et al. (2023), an ellipsoid fit while a magnet disturbs the sensor: simulated, and a real recording.

    python examples/paper/table_2.py
    python examples/paper/table_2.py broad_28_stationary_magnet.csv broad_02_undisturbed.csv

The simulated sensor is that of ``mkc demo``; its truth is least squares on the samples that the magnet leaves alone. Of
the recordings the first one is disturbed; the second, of the same sensor, is not, and serves as the truth by least
squares. Both are trials of the BROAD data set (Laidig et al., "BROAD", Data 6(7):72, 2021, CC BY 4.0) as tables with
the columns mag_x, mag_y, mag_z in µT.
"""

from __future__ import annotations

import argparse

import torch
from rich.console import Console
from rich.table import Table
from sklearn.linear_model import Lasso as SklearnLasso
from torch import Tensor

from mkc_torch import EllipsoidFit, Recording
from mkc_torch._support.arrays import Data
from mkc_torch.linear import FixedPointLinear, LeastAbsoluteDeviations, LeastSquares, MKCRegression, Ridge
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.recording.demonstration import simulated_recording


class Lasso(LinearEstimator):
    """scikit-learn's Lasso under the vocabulary of the ellipsoid fit."""

    def __init__(self, alpha: float) -> None:
        super().__init__()
        self.alpha = alpha

    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> Lasso:
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        model = SklearnLasso(alpha=self.alpha, fit_intercept=False, max_iter=100_000)
        model.fit(X.squeeze(-2).numpy(), Y.squeeze(-1).numpy(), sample_weight=sample_weight)
        self.coef_ = torch.from_numpy(model.coef_)
        self.weights_ = torch.ones_like(Y)
        return self


PAPER = {  # errors of the coefficients, the centre and the semi-axes
    "LS": (2.97e-3, 6.329, 17.034),
    "Ridge": (1.16e-3, 2.096, 12.905),
    "Lasso": (2.95e-3, 3.662, 8.384),
    "LAD": (3.18e-4, 0.307, 0.411),
    "MKC": (6.45e-4, 0.955, 5.170),
    "MKC-EM": (1.14e-4, 0.100, 0.136),
}


def points(path: str) -> Tensor:
    """Magnetometer readings (N, 3) in µT."""
    return Recording.read(path).finite("mag_x", "mag_y", "mag_z").magnetometer()


def simulated() -> tuple[Tensor, Tensor]:
    """Readings of a simulated sensor, all of them and those without disturbance."""
    recording, truth = simulated_recording()
    time, readings = recording["time"], recording.magnetometer()
    return readings, readings[(time < truth.disturbed[0]) | (time > truth.disturbed[1])]


def compared(title: str, disturbed: Tensor, undisturbed: Tensor) -> Table:
    """Errors of the estimators against least squares without disturbance."""
    truth = EllipsoidFit(LeastSquares()).fit(undisturbed)
    # a residual of the algebraic fit is about twice the relative error of the norm
    estimators: dict[str, LinearEstimator] = {
        "LS": LeastSquares(),
        "Ridge": Ridge(alpha=1.0),
        "Lasso": Lasso(alpha=1e-4),
        "LAD": LeastAbsoluteDeviations(),
        "MKC": FixedPointLinear(sigma=2.0, d=0.05),
        "MKC-EM": MKCRegression(),
    }
    table = Table(title=f"{title}: errors (the paper's own sensor and recording in brackets)")
    for heading in ("", "coefficients of (36)", "centre, µT", "semi-axes, µT", "semi-axes found, µT"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, estimator in estimators.items():
        fit = EllipsoidFit(estimator).fit(disturbed)
        errors = [float((getattr(fit, a) - getattr(truth, a)).norm()) for a in ("coef_", "center_", "semi_axes_")]
        printed = PAPER[name]
        table.add_row(
            name,
            f"{errors[0]:.2e} ({printed[0]:.2e})",
            f"{errors[1]:.3f} ({printed[1]:.3f})",
            f"{errors[2]:.3f} ({printed[2]:.3f})",
            ", ".join(f"{v:.2f}" for v in fit.semi_axes_.tolist()),
        )
    table.add_row("truth", "", "", "", ", ".join(f"{v:.2f}" for v in truth.semi_axes_.tolist()))
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("disturbed", nargs="?")
    parser.add_argument("undisturbed", nargs="?")
    arguments = parser.parse_args()
    console = Console(width=120)
    console.print(compared("simulated sensor", *simulated()))
    if arguments.disturbed is None:
        return
    if arguments.undisturbed is None:
        parser.error("the undisturbed recording is missing; give both, or none for the simulated sensor alone")
    console.print(compared("recording", points(arguments.disturbed), points(arguments.undisturbed)))


if __name__ == "__main__":
    main()

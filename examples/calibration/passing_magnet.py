"""The README's picture: a magnetometer that passes a magnet, calibrated by least squares and by MKC-EM.

    python examples/calibration/passing_magnet.py broad_28_stationary_magnet.csv --output passing_magnet.png

The recording is a trial of the BROAD data set (Laidig et al., Data 6(7):72, 2021, CC BY 4.0) as a table.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.stats import norm
from torch import Tensor

from mkc_torch import EllipsoidFit, Recording
from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.functional import mkc_nll
from mkc_torch.linear import LeastSquares, MKCRegression

USED, REJECTED, GAUSSIAN = "#0072b2", "#d55e00", "#555555"


def outline(fit: EllipsoidFit) -> np.ndarray:
    """Return the outline (361, 2) of the ellipsoid in the x-z plane through its centre."""
    angle = np.linspace(0, 2 * np.pi, 361)
    circle = np.stack([np.cos(angle), 0 * angle, np.sin(angle)])
    shape = (fit.calibration_matrix_ / fit.radius_).numpy()
    radius = 1 / np.linalg.norm(shape @ circle, axis=0)
    return np.asarray((fit.center_.numpy()[:, None] + radius * circle)[[0, 2]].T)


def draw_cut(axes: Any, points: np.ndarray, rejected: np.ndarray, robust: EllipsoidFit, squares: EllipsoidFit) -> None:
    near = np.abs(points[:, 1] - float(robust.center_[1])) < 6
    for mask, colour, label in ((near & ~rejected, USED, "samples in use"), (near & rejected, REJECTED, "rejected")):
        axes.plot(points[mask, 0], points[mask, 2], ".", color=colour, ms=2, label=label)
    axes.plot(*outline(squares).T, "--", color=GAUSSIAN, lw=1.4, label="least squares")
    axes.plot(*outline(robust).T, color="black", lw=1.4, label="MKC-EM")
    axes.set(title="samples near the x-z plane", xlabel="x (µT)", ylabel="z (µT)", aspect="equal")
    axes.legend(loc="center", fontsize=8, frameon=False, markerscale=3)


def draw_residual(axes: Any, time: np.ndarray, residual: np.ndarray, rejected: np.ndarray) -> None:
    for mask, colour in ((~rejected, USED), (rejected, REJECTED)):
        axes.plot(time[mask], residual[mask], ".", color=colour, ms=2)
    axes.set(title="length of the calibrated field minus its mean", xlabel="time (s)", ylabel="residual (µT)")


def draw_density(axes: Any, residual: Tensor, sigma: float, d: float, bound: float) -> None:
    axes.hist(residual.numpy(), bins=160, density=True, color="#c8d4de", label="samples")
    grid = torch.linspace(float(residual.min()), float(residual.max()), 1500, dtype=torch.float64)
    axes.plot(grid, torch.exp(-mkc_nll(grid, sigma, d, bound)), color="black", lw=1.4, label=f"MKC, σ = {sigma:.2f}")
    axes.plot(grid, norm.pdf(grid, scale=residual.std()), "--", color=GAUSSIAN, lw=1.4, label="Gaussian")
    axes.set(title="density of the residual", xlabel="(length / mean length)² − 1", yscale="log", ylim=(2e-3, 30))
    axes.legend(fontsize=8, frameon=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--output", default=str(Path(__file__).with_suffix(".png")))
    arguments = parser.parse_args()
    recording = Recording.read(arguments.recording).finite("time", "mag_x", "mag_y", "mag_z")
    points = recording.magnetometer()
    robust = EllipsoidFit(MKCRegression()).fit(points)
    squares = EllipsoidFit(LeastSquares()).fit(points)
    rejected = (robust.weights_ < 0.5).numpy()
    result = calibrate(recording)
    figure = Figure(figsize=(12.5, 4.1), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=[1, 1.25, 1.1])
    for axes in (left, middle, right):
        axes.spines[["top", "right"]].set_visible(False)
    draw_cut(left, points.numpy(), rejected, robust, squares)
    draw_residual(middle, recording["time"].numpy(), robust.residual_.numpy(), rejected)
    draw_density(right, (1 + robust.residual_ / robust.radius_).square() - 1, result.sigma, result.d, result.bound)
    figure.savefig(arguments.output, dpi=110)


if __name__ == "__main__":
    main()

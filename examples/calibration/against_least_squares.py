"""Compare MKC-EM with least squares on any recordings: the cost of robustness without disturbances.

python examples/calibration/against_least_squares.py RECORDING.csv ...
"""

from __future__ import annotations

import argparse

from rich.console import Console
from rich.table import Table
from torch import Tensor

from mkc_torch import EllipsoidFit, NotIdentifiableError, Recording
from mkc_torch.linear import LeastSquares, MKCRegression


def listed(values: Tensor) -> str:
    return ", ".join(f"{v:.2f}" for v in values.tolist())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+")
    arguments = parser.parse_args()
    table = Table()
    for heading in ("recording", "σ", "centre", "semi-axes", "largest difference to least squares"):
        table.add_column(heading)
    refused = []
    for path in arguments.recordings:
        recording = Recording.read(path).finite("mag_x", "mag_y", "mag_z")
        points = recording.magnetometer()
        try:
            fit = EllipsoidFit(MKCRegression(covariance="hac")).fit(points)
            squares = EllipsoidFit(LeastSquares(covariance="hac")).fit(points)
        except NotIdentifiableError as error:
            refused.append(f"{recording.name}: {error}")
            continue
        largest = max(float((getattr(fit, a) - getattr(squares, a)).abs().max()) for a in ("center_", "semi_axes_"))
        share = largest / float(fit.radius_)
        sigma = f"{float(fit.estimator_.sigma_):.1f}"
        table.add_row(
            recording.name,
            sigma,
            listed(fit.center_),
            listed(fit.semi_axes_),
            f"{largest:.3f} ({share:.2%} of the radius)",
        )
    console = Console(width=130)
    console.print(table)
    for line in refused:
        console.print(line, soft_wrap=True)


if __name__ == "__main__":
    main()

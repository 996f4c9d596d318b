"""Table 5 and Figure 9 of Indiveri (2009): the data of Hawkins, Bradu and Kass, without an intercept.

    python examples/paper/lel_table_5.py --output lel_table_5.png

G. Indiveri, "An Entropy-Like Estimator for Robust Parameter Identification", Entropy 11 (2009) 560-585. The data are
those of D. M. Hawkins, D. Bradu, G. V. Kass, "Location of several outliers in multiple-regression data using elemental
sets", Technometrics 26 (1984) 197-208: rows 1 to 10 are bad leverage points, rows 11 to 14 good ones.
"""

from __future__ import annotations

import argparse

import torch
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from torch import Tensor

from mkc_torch.linear import LeastEntropyLike, LeastMedianOfSquares, LeastSquares
from mkc_torch.losses.entropy_like import entropy_like

DATA = """
10.1 19.6 28.3 9.7; 9.5 20.5 28.9 10.1; 10.7 20.2 31 10.3; 9.9 21.5 31.7 9.5; 10.3 21.1 31.1 10; 10.8 20.4 29.2 10;
10.5 20.9 29.1 10.8; 9.9 19.6 28.8 10.3; 9.7 20.7 31 9.6; 9.3 19.7 30.3 9.9; 11 24 35 -0.2; 12 23 37 -0.4;
12 26 34 0.7; 11 34 34 0.1; 3.4 2.9 2.1 -0.4; 3.1 2.2 0.3 0.6; 0 1.6 0.2 -0.2; 2.3 1.6 2 0; 0.8 2.9 1.6 0.1;
3.1 3.4 2.2 0.4; 2.6 2.2 1.9 0.9; 0.4 3.2 1.9 0.3; 2 2.3 0.8 -0.8; 1.3 2.3 0.5 0.7; 1 0 0.4 -0.3; 0.9 3.3 2.5 -0.8;
3.3 2.5 2.9 -0.7; 1.8 0.8 2 0.3; 1.2 0.9 0.8 0.3; 1.2 0.7 3.4 -0.3; 3.1 1.4 1 0; 0.5 2.4 0.3 -0.4;
1.5 3.1 1.5 -0.6; 0.4 0 0.7 -0.7; 3.1 2.4 3 0.3; 1.1 2.2 2.7 -1; 0.1 3 2.6 -0.6; 1.5 1.2 0.2 0.9; 2.1 0 1.2 -0.7;
0.5 2 1.2 -0.5; 3.4 1.6 2.9 -0.1; 0.3 1 2.7 -0.7; 0.1 3.3 0.9 0.6; 1.8 0.5 3.2 -0.7; 1.9 0.1 0.6 -0.5;
1.8 0.5 3 -0.4; 3 0.1 0.8 -0.9; 3.1 1.6 3 0.1; 3.1 2.5 1.9 0.9; 2.1 2.8 2.9 -0.4; 2.3 1.5 0.4 0.7;
3.3 0.6 1.2 -0.5; 0.3 0.4 3.3 0.7; 1.1 3 0.3 0.7; 0.5 2.4 0.9 0; 1.8 3.2 0.9 0.1; 1.8 0.7 0.7 0.7;
2.4 3.4 1.5 -0.1; 1.6 2.1 3 -0.3; 0.3 1.5 3.3 -0.9; 0.4 3.4 3 -0.3; 0.9 0.1 0.3 0.6; 1.1 2.7 0.2 -0.3;
2.8 3 2.9 -0.5; 2 0.7 2.7 0.6; 0.2 1.8 0.8 -0.9; 1.6 2 1.2 -0.7; 0.1 0 1.1 0.6; 2 0.6 0.3 0.2; 1 2.2 2.9 0.7;
2.2 2.5 2.3 0.2; 0.6 2 1.5 -0.2; 0.3 1.7 2.2 0.4; 0 2.2 1.6 -0.9; 0.3 0.4 2.6 0.2
"""  # x1, x2, x3, y
PAPER = {  # θ, median of r², H
    "LS": ((0.08, -0.36, 0.44), 0.68, 0.6532),
    "LEL-A/B": ((-0.33, 0.33, 0.23), 0.53, 0.4290),
    "LEL-C": ((-0.0043, 0.05, -0.05), 0.31, 0.5600),
}


def data() -> tuple[Tensor, Tensor]:
    """X (75, 3) and y (75,)."""
    rows = torch.tensor([[float(v) for v in row.split()] for row in DATA.strip().split(";")], dtype=torch.float64)
    return rows[:, :3], rows[:, 3]


def estimates(X: Tensor, y: Tensor) -> dict[str, Tensor]:
    """Least squares and the distinct minima of H that the three starts lead to, the least H first."""
    fit = LeastEntropyLike().fit(X, y)
    found = {"LS": LeastSquares().fit(X, y).coef_}
    order = fit.minima_entropy_.argsort()
    names = iter(("LEL-A/B", "LEL-C", "LEL, a third"))
    last = None
    for theta in fit.minima_[order]:
        if last is None or float((theta - last).norm()) > 1e-6:
            found[next(names)] = theta
        last = theta
    return found


def scaled(residual: Tensor) -> Tensor:
    """Residuals over their median absolute deviation, (20)-(21)."""
    return residual / (residual - residual.quantile(0.5)).abs().quantile(0.5)


def picture(path: str, X: Tensor, y: Tensor, found: dict[str, Tensor]) -> None:
    figure = Figure(figsize=(7.5, 7.0), layout="constrained")
    for axes, (name, theta) in zip(figure.subplots(len(found), sharex=True), found.items(), strict=True):
        r = scaled(y - X @ theta).numpy()
        index = range(1, len(r) + 1)
        axes.axhspan(-2.5, 2.5, color="0.93")
        for rows, colour, label in (
            (slice(0, 10), "tab:red", "bad leverage points 1 to 10"),
            (slice(10, 14), "tab:blue", "good leverage points 11 to 14"),
            (slice(14, None), "0.35", "the others"),
        ):
            axes.vlines(index[rows], 0.0, r[rows], color=colour, linewidth=1.0)
            axes.plot(index[rows], r[rows], "o", markersize=4, color=colour, label=label)
        axes.axhline(0.0, color="0.35", linewidth=0.8)
        h = float(entropy_like(y - X @ theta))
        axes.set_title(f"{name}: H = {h:.4f}", loc="left", fontsize=10)
        axes.set_ylabel("residual / MAD")
    figure.axes[0].legend(loc="lower right", fontsize=8, frameon=False)
    figure.axes[-1].set_xlabel("row (band: ±2.5)")
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", metavar="PICTURE.png", help="Figure 9")
    parser.add_argument("--starts", type=int, default=300, help="random starts that look for other minima")
    options = parser.parse_args()
    console = Console(width=120)
    X, y = data()
    found = estimates(X, y)
    table = Table(title="Table 5: Hawkins, Bradu and Kass without an intercept (the paper's values in brackets)")
    for heading in ("estimate", "θ", "median r²", "H"):
        table.add_column(heading, justify="left" if heading == "estimate" else "right")
    for name, theta in found.items():
        r = y - X @ theta
        printed, median, entropy = PAPER.get(name, ((), float("nan"), float("nan")))
        table.add_row(
            name,
            f"{', '.join(f'{v:.4f}' for v in theta.tolist())} ({', '.join(f'{v:g}' for v in printed)})",
            f"{float(r.square().median()):.4f} ({median:.2f})",
            f"{float(entropy_like(r)):.6f} ({entropy:.4f})",
        )
    lms = LeastMedianOfSquares().fit(X, y).coef_
    r = y - X @ lms
    table.add_row(
        "LMS, for comparison",
        ", ".join(f"{v:.4f}" for v in lms.tolist()),
        f"{float(r.square().median()):.4f}",
        f"{float(entropy_like(r)):.6f}",
    )
    console.print(table)
    fit = LeastEntropyLike().fit(X, y)
    ends = ", ".join(f"{h:.4f}" for h in fit.minima_entropy_.tolist())
    console.print(
        f"The three starts, least squares and Gram and Schmidt's from the axes, end at H = {ends} after at most "
        f"{int(fit.n_iter_)} steps; which start leads where depends on the choice of the orthogonal ones, which the "
        "paper does not give."
    )
    length = float(torch.linalg.vector_norm(found["LS"]))
    generator = torch.Generator().manual_seed(0)
    starts = torch.randn(options.starts, 3, generator=generator, dtype=torch.float64) * 3.0 * length
    many = LeastEntropyLike(starts=starts).fit(X, y).minima_entropy_
    values, counts = many.mul(1e6).round().div(1e6).unique(return_counts=True)
    console.print(
        f"{options.starts} random starts find: "
        + "; ".join(f"H = {v:.6f} in {c}" for v, c in zip(values.tolist(), counts.tolist(), strict=True))
        + "."
    )
    if options.output:
        picture(options.output, X, y, found)
        console.print(f"Figure 9 is in {options.output}.")


if __name__ == "__main__":
    main()

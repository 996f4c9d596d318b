"""Figures 1 to 8 of Indiveri (2009): the cost functions of a line, and fits of four amplitudes of sines.

    python examples/paper/lel_figures.py --output FOLDER

G. Indiveri, "An Entropy-Like Estimator for Robust Parameter Identification", Entropy 11 (2009) 560-585. The paper shows
one draw of each; the numbers printed are over many draws, the pictures show one.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from torch import Tensor

from mkc_torch.linear import LeastEntropyLike, LeastSquares
from mkc_torch.losses.entropy_like import entropy_like

BLUE, RED, GREEN = "tab:blue", "tab:red", "tab:green"


def line(draws: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """x and y (D, 125) of Figure 1: 100 values on y = x with unit noise, and 25 outliers about (5, 10)."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    x = torch.linspace(-10, 10, 100, dtype=torch.float64).expand(draws, 100)
    x = torch.cat([x, 5.0 + normal(draws, 25)], 1)
    return x, torch.cat([x[:, :100] + normal(draws, 100), 10.0 + normal(draws, 25)], 1)


def costs(x: Tensor, y: Tensor, theta: Tensor) -> dict[str, Tensor]:
    """(54)-(56) of one draw at slopes (K,)."""
    r = y - theta.unsqueeze(1) * x
    square = r.square()
    least = (y - (x @ y) / (x @ x) * x).square().sum()
    return {"LMS": square.median(-1).values, "LS": square.sum(-1) / least, "LEL": entropy_like(r, -1)}


def turning_points(values: Tensor) -> int:
    """How often a sampled curve turns from falling to rising."""
    rise = values.diff() > 0
    return int((~rise[:-1] & rise[1:]).sum())


def show_line(console: Console, draws: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    x, y = line(draws, generator)
    ls = LeastSquares().fit(x.unsqueeze(-1).unsqueeze(-1), y.unsqueeze(-1)).coef_[:, 0]
    starts = torch.linspace(-5, 5, 41, dtype=torch.float64).unsqueeze(1)
    fit = LeastEntropyLike(starts=starts).fit(x.unsqueeze(-1).unsqueeze(-1), y.unsqueeze(-1))
    # of the minima of each draw the nearest to 1 and to 2
    minima, entropy = fit.minima_[..., 0], fit.minima_entropy_
    near = [minima.gather(1, (minima - v).abs().argmin(1, keepdim=True))[:, 0] for v in (1.0, 2.0)]
    grid = torch.linspace(-10, 10, 10_000, dtype=torch.float64)
    turns = [{k: turning_points(v) for k, v in costs(x[i], y[i], grid).items()} for i in range(min(draws, 20))]
    table = Table(title=f"Figures 1 and 2: y = θ x over {draws} draws, mean ± standard deviation")
    for heading in ("", "paper", "here"):
        table.add_column(heading, justify="right" if heading else "left")
    second = (near[1] - 2.0).abs() < 0.5
    table.add_row("θ of least squares, (53)", "1.16", f"{ls.mean():.3f} ± {ls.std():.3f}")
    table.add_row("sharp minimum of H at θ =", "1", f"{near[0].mean():.3f} ± {near[0].std():.3f}")
    table.add_row("another one at θ =", "close to 2", f"{near[1][second].mean():.3f} ± {near[1][second].std():.3f}")
    table.add_row("draws that have the second", "1 of 1", f"{int(second.sum())} of {draws}")
    best = minima.gather(1, entropy.argmin(1, keepdim=True))[:, 0]
    table.add_row("draws in which H is least at the first", "", f"{int(((best - 1.0).abs() < 0.2).sum())} of {draws}")
    for name in ("LMS", "LEL", "LS"):
        text = {"LMS": "erratic", "LEL": "regular", "LS": "1"}[name]
        mean = float(np.mean([t[name] for t in turns]))
        table.add_row(f"local minima of the {name} cost on 10⁴ slopes", text, f"{mean:.1f}")
    console.print(table)
    return x[0], y[0]


def picture_line(path: Path, x: Tensor, y: Tensor) -> None:
    figure = Figure(figsize=(11.0, 6.5), layout="constrained")
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(1.0, 1.25)))
    axes = left.subplots()
    axes.plot(x[:100].numpy(), y[:100].numpy(), "o", markersize=4, color=BLUE, label="y = x + noise")
    axes.plot(x[100:].numpy(), y[100:].numpy(), "D", markersize=5, color=RED, label="outliers")
    slope = float((x @ y) / (x @ x))
    lel = float(LeastEntropyLike().fit(x.unsqueeze(1), y).coef_)
    ends = np.array([-10.5, 10.5])
    axes.plot(ends, slope * ends, "--", color="0.4", label=f"LS, θ = {slope:.2f}")
    axes.plot(ends, lel * ends, color="black", label=f"LEL, θ = {lel:.2f}")
    axes.set(xlabel="x", ylabel="y", title="Figure 1")
    axes.legend(frameon=False)
    panels = right.subplots(3, 2, sharex="col")
    right.suptitle("Figure 2", fontsize=12)
    for column, (low, high) in enumerate(((-10.0, 10.0), (0.0, 3.0))):
        grid = torch.linspace(low, high, 10_000, dtype=torch.float64)
        for row, (name, values) in enumerate(costs(x, y, grid).items()):
            panel = panels[row, column]
            panel.plot(grid.numpy(), values.numpy(), color=(GREEN, "0.4", "black")[row], linewidth=1.0)
            panel.grid(alpha=0.3)
            if column == 0:
                panel.set_ylabel(name)
        panels[-1, column].set_xlabel("θ")
    figure.savefig(path, dpi=150)


def sines(samples: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """x, G of (59) and the values of Cases 1 and 2."""
    x = torch.linspace(-10, 10, samples, dtype=torch.float64)
    G = torch.stack([x.sin(), x.cos(), (2 * x).sin(), (2 * x).cos()], -1)
    y = G @ torch.tensor([63.0, 2.0, 11.0, -29.0], dtype=torch.float64)
    y = y + math.sqrt(10.0) * torch.randn(samples, generator=generator, dtype=torch.float64)
    chosen = torch.randperm(samples, generator=generator)[: samples // 10]
    corrupted = y.clone()
    corrupted[chosen] *= 10.0 * torch.rand(len(chosen), generator=generator, dtype=torch.float64)
    return x, G, y, corrupted


def sorted_errors(axes: Axes, G: Tensor, y: Tensor, fits: dict[str, Tensor], part: slice, title: str) -> None:
    rank = np.arange(1, len(y) + 1)[part]
    for (name, theta), style in zip(fits.items(), ("--", "-"), strict=True):
        axes.plot(rank, (y - G @ theta).abs().sort().values.numpy()[part], style, color="black", label=name)
    axes.set(xlabel="rank", ylabel="|residual|, sorted", title=title)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)


def picture_sines(path: Path, console: Console, samples: int, generator: torch.Generator) -> None:
    x, G, y, corrupted = sines(samples, generator)
    first = LeastEntropyLike().fit(G, y)
    fits = [{"LS": LeastSquares().fit(G, v).coef_, "LEL": LeastEntropyLike().fit(G, v).coef_} for v in (y, corrupted)]
    figure = Figure(figsize=(11.0, 12.0), layout="constrained")
    axes: dict[str, Axes] = figure.subplot_mosaic([["3a", "3b"], ["4", "4"], ["5", "6"], ["7", "8"]])

    def cloud(panel: Axes, values: Tensor, colour: str = "0.7", label: str | None = None) -> None:
        panel.plot(x.numpy(), values.numpy(), ".", markersize=1.5, color=colour, rasterized=True, label=label)
        panel.set(xlabel="x", ylabel="y")

    def curve(panel: Axes, name: str, theta: Tensor, colour: str, style: str = "-") -> None:
        panel.plot(x.numpy(), (G @ theta).numpy(), style, color=colour, linewidth=1.2, label=name)

    cloud(axes["3a"], y)
    curve(axes["3a"], "LS", fits[0]["LS"], RED)
    curve(axes["3a"], f"LEL, H = {float(first.entropy_):.4f}", fits[0]["LEL"], "black", "--")
    axes["3a"].set_title("Figure 3: Case 1")
    cloud(axes["3b"], y)
    others = [m for m in first.minima_ if float((m - first.coef_).norm()) > 1.0]
    for theta, colour in zip(_distinct(others), (BLUE, GREEN, RED), strict=False):
        curve(axes["3b"], f"LEL, H = {float(entropy_like(y - G @ theta)):.4f}", theta, colour)
    axes["3b"].set_title("Figure 3: Case 1, the other minima of H")
    cloud(axes["4"], corrupted, RED, "Case 2, corrupted")
    cloud(axes["4"], y, BLUE, "Case 1")
    axes["4"].set_title("Figure 4: the data of Case 2")
    cloud(axes["6"], corrupted)
    curve(axes["6"], "LS", fits[1]["LS"], RED)
    curve(axes["6"], "LEL", fits[1]["LEL"], "black")
    axes["6"].set(ylim=(-220.0, 220.0), title="Figure 6: Case 2")
    for name in ("3a", "3b", "4", "6"):
        scale = 6.0 if name == "4" else 1.0
        axes[name].legend(loc="upper right", ncols=2, markerscale=scale, framealpha=0.9, fontsize=9)
        low, high = axes[name].get_ylim()
        axes[name].set_ylim(low, high + 0.2 * (high - low))  # room for the legend
    most = samples * 9 // 10
    sorted_errors(axes["5"], G, y, fits[0], slice(None), "Figure 5: Case 1")
    sorted_errors(axes["7"], G, corrupted, fits[1], slice(0, most), "Figure 7: Case 2, nine tenths")
    sorted_errors(axes["8"], G, corrupted, fits[1], slice(most, None), "Figure 8: Case 2, the last tenth")
    figure.savefig(path, dpi=150)
    errors = [(corrupted - G @ fits[1][name]).abs().sort().values for name in ("LS", "LEL")]
    console.print(
        f"Case 2: the sorted |residual| of LEL is below that of LS at {int((errors[1] < errors[0]).sum())} "
        f"of {samples} ranks (paper: about nine tenths)."
    )


def _distinct(thetas: list[Tensor]) -> list[Tensor]:
    found: list[Tensor] = []
    for theta in thetas:
        if all(float((theta - other).norm()) > 1e-3 * float(theta.norm()) for other in found):
            found.append(theta)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--samples", type=int, default=10_000, help="of the sines")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", metavar="FOLDER", type=Path, help="for figures_1_2.png and figures_3_to_8.png")
    options = parser.parse_args()
    console = Console(width=120)
    generator = torch.Generator().manual_seed(options.seed)
    x, y = show_line(console, options.draws, generator)
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
        picture_line(options.output / "figures_1_2.png", x, y)
        picture_sines(options.output / "figures_3_to_8.png", console, options.samples, generator)
        console.print(f"The pictures are in {options.output}.")


if __name__ == "__main__":
    main()

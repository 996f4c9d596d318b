"""Figures 2 and 3 of Li et al. (2023): the MKC density, and its likelihood on Gaussian residuals with outliers.

    python examples/paper/figures_2_3.py --output FOLDER

"Multi-kernel Correntropy Regression" (2023), (17) and (20). The caption of Figure 3 prints means of densities as
log-likelihoods; they are means of log-densities here. The paper gives no domain for it: [-20, 20] holds all residuals.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from scipy.stats import kurtosis
from torch import Tensor

from mkc_torch import MKCDistribution, fit_density
from mkc_torch.functional import mkc_nll

BOUND_2, BOUND_3 = 10.0, 20.0
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
SHARES = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.49)
INF = math.inf


def residuals(share: float, draws: int, samples: int, generator: torch.Generator) -> Tensor:
    """(20): ``(1 - p) N(0, 1) + p U(-20, 20)``, (draws, samples, 1)."""
    shape = (draws, samples, 1)
    clean = torch.randn(shape, generator=generator, dtype=torch.float64)
    wide = BOUND_3 * (2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1)
    return torch.where(torch.rand(shape, generator=generator, dtype=torch.float64) < share, wide, clean)


def mean_log_density(e: Tensor, sigma: Tensor | float) -> Tensor:
    """With d = 1 over samples, for σ that broadcasts to e's batch."""
    return -mkc_nll(e[..., 0], sigma, 1.0, BOUND_3).mean(-1)


def entropy(share: float) -> float:
    """Of (20), with the sign changed: the greatest expected log-likelihood that any density has."""
    e = np.linspace(-BOUND_3, BOUND_3, 40_001)
    p = (1 - share) * np.exp(-0.5 * e**2) / math.sqrt(2 * math.pi) + share / (2 * BOUND_3)
    return float(np.trapezoid(p * np.log(np.maximum(p, 1e-300)), e))


def show_figure_2(console: Console) -> None:
    table = Table(title="Figure 2: the density (17) on [-10, 10]")
    for heading in ("d", "σ", "c", "p(0)", "p(10)", "standard deviation", "excess kurtosis"):
        table.add_column(heading, justify="right")
    for d in (0.5, 1.0, 2.0):
        for sigma in (1.0, 2.0, 3.0, INF):
            p = MKCDistribution(torch.tensor(sigma, dtype=torch.float64), d, BOUND_2)
            ends = [float(p.log_prob(torch.tensor(v, dtype=torch.float64)).exp()) for v in (0.0, BOUND_2)]
            q = (torch.arange(20_000, dtype=torch.float64) + 0.5) / 20_000
            cells = [d * ends[0], *ends, float(p.variance.sqrt()), float(kurtosis(p.icdf(q).numpy()))]
            table.add_row(f"{d}", "∞" if sigma == INF else f"{sigma:g}", *(f"{c:.4g}" for c in cells))
    console.print(table)
    console.print(
        "Paper: d shapes the head and σ the tail, and the density nears the Gaussian for wide σ. Here: at d = 1 the "
        f"largest difference to the Gaussian is {gap(3.0):.1e} at σ = 3, {gap(10.0):.1e} at 10, {gap(100.0):.1e} at "
        "100.\n"
    )


def gap(sigma: float) -> float:
    e = torch.linspace(-BOUND_2, BOUND_2, 2001, dtype=torch.float64)
    return float((torch.exp(-mkc_nll(e, sigma, 1.0, BOUND_2)) - torch.exp(-mkc_nll(e, INF, 1.0, BOUND_2))).abs().max())


def picture_2(path: Path) -> None:
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    e = torch.linspace(-BOUND_2, BOUND_2, 2001, dtype=torch.float64)
    for axes, pairs in (
        (left, [(1.0, 1.0), (1.0, 2.0), (1.0, 3.0), (1.0, INF)]),
        (right, [(0.5, 2.0), (1.0, 2.0), (2.0, 2.0), (1.0, INF)]),
    ):
        for (d, sigma), colour in zip(pairs, (*COLOURS[:3], "black"), strict=True):
            label = f"Gaussian, d = {d:g}" if sigma == INF else f"d = {d:g}, σ = {sigma:g}"
            density = torch.exp(-mkc_nll(e, sigma, d, BOUND_2))
            axes.plot(e.numpy(), density.numpy(), "--" if sigma == INF else "-", color=colour, label=label)
        axes.set(xlabel="e", yscale="log", ylim=(1e-6, 2.0), xlim=(-BOUND_2, BOUND_2))
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=9, loc="upper right")
    left.set(ylabel="density", title="Figure 2: σ shapes the tail")
    right.set(title="d shapes the head")
    figure.savefig(path, dpi=150)


def show_figure_3(console: Console, draws: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """σ and the curves of 3(a), (2, σ), and those of 3(b), (shares, 4), in nats per sample."""
    sigmas = torch.logspace(math.log10(0.1), 3, 61, dtype=torch.float64)
    e = residuals(0.2, draws, 1000, generator)
    gaussian = mean_log_density(e, INF)
    by_sigma = torch.stack([mean_log_density(e, s) for s in sigmas]).mean(-1)
    rows, best_sigma = [], []
    for share in SHARES:
        e = residuals(share, draws, 1000, generator)
        # at a domain of its own, which holds what it is compared on
        fit = fit_density(e, d=1.0, bound=BOUND_3)
        fair = -0.5 * torch.log(2 * math.pi * math.e * e.square().mean(-2))
        found = (mean_log_density(e, INF), mean_log_density(e, fit.sigma), fair)
        rows.append([*(float(v.mean()) for v in found), entropy(share)])
        best_sigma.append(float(fit.sigma.median()))
    curve = torch.tensor(rows)
    table = Table(title=f"Figure 3: mean log-likelihood in nats per sample, d = 1, N = 1000, {draws} draws")
    for heading in ("p", "WLS", "MKC, best σ", "gain", "WLS, best d", "greatest possible", "median best σ"):
        table.add_column(heading, justify="right")
    for share, (wls, mkc, own, best), sigma in zip(SHARES, rows, best_sigma, strict=True):
        shown = "∞" if sigma == INF else f"{sigma:.2f}"
        cells = [f"{v:.3f}" for v in (wls, mkc, mkc - wls, own, best)]
        table.add_row(f"{share:g}", *cells, shown)
    console.print(table)
    gain = by_sigma - gaussian.mean()
    lost = curve[:, 1] < curve[:, 0] - 1e-9
    console.print(
        f"3(a), p = 0.2. Paper: better than WLS at every σ. Here: the least gain for σ in [0.1, 1000] is "
        f"{float(gain.min()):.2e} nats, at σ = {float(sigmas[gain.argmin()]):.3g}; the greatest is "
        f"{float(gain.max()):.3f}, at σ = {float(sigmas[gain.argmax()]):.2f}.\n"
        f"3(b). Paper: never worse than WLS at the best σ, and the gain grows with p. Here: worse at {int(lost.sum())} "
        f"of {len(SHARES)} shares; the gain grows from {float(curve[0, 1] - curve[0, 0]):.3f} to "
        f"{float(curve[-1, 1] - curve[-1, 0]):.3f} nats"
        f"{'' if bool(((curve[:, 1] - curve[:, 0]).diff() > 0).all()) else ', not at every step'}."
    )
    return sigmas, torch.stack([by_sigma, gaussian.mean().expand_as(by_sigma)]), curve


def picture_3(path: Path, sigmas: Tensor, by_sigma: Tensor, curve: Tensor) -> None:
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.semilogx(sigmas.numpy(), by_sigma[0].numpy(), color=COLOURS[0], label="MKC")
    left.semilogx(sigmas.numpy(), by_sigma[1].numpy(), "--", color="black", label="WLS")
    left.set(xlabel="σ", ylabel="nats per sample", title="Figure 3(a): outliers in 20 %, d = 1")
    right.plot(SHARES, curve[:, 3].numpy(), color="0.8", lw=6, label="greatest possible")
    right.plot(SHARES, curve[:, 1].numpy(), "o-", ms=4, color=COLOURS[0], label="MKC, best σ")
    right.plot(SHARES, curve[:, 0].numpy(), "s--", ms=4, color="black", label="WLS")
    right.plot(SHARES, curve[:, 2].numpy(), "^-.", ms=4, color=COLOURS[1], label="WLS, best d")
    right.set(xlabel="share p of outliers", title="Figure 3(b)")
    for axes, place in ((left, "upper right"), (right, "lower left")):
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, loc=place)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", metavar="FOLDER", type=Path, help="for figure_2.png and figure_3.png")
    options = parser.parse_args()
    console = Console(width=120)
    show_figure_2(console)
    found = show_figure_3(console, options.draws, torch.Generator().manual_seed(options.seed))
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
        picture_2(options.output / "figure_2.png")
        picture_3(options.output / "figure_3.png", *found)
        console.print(f"The pictures are in {options.output}.")


if __name__ == "__main__":
    main()

"""Every linear estimator side by side: efficiency on good data, breakdown, bias under outliers, time, and advice.

    python examples/paper/comparison.py --output FOLDER
    python examples/paper/comparison.py --output FOLDER --draws 5000

N = 200 samples, n = 4 coefficients of 1 (an intercept and three Gaussian regressors), noise of standard deviation 1.
Efficiency is the mean squared error of least squares over that of the estimator, on the same draws. Outliers replace a
share of the samples: in y alone, all 30 too high; or at leverage, in a cluster near 8 in every regressor and -40 in y.
An estimator has broken down at the first share whose median error |θ - θ°| exceeds 1. All times are of the same run,
one thread. RANSAC is scikit-learn's; Hough voting, which finds lines in images, has two coefficients and is compared on
a line of its own where scikit-image is installed.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from sklearn.linear_model import LinearRegression, RANSACRegressor
from torch import Tensor

from mkc_torch.density.robustness import bandwidth_for_efficiency
from mkc_torch.linear import (
    FixedPointLinear,
    GeneralizedMaximumEntropy,
    LeastAbsoluteDeviations,
    LeastEntropyLike,
    LeastMedianOfSquares,
    LeastSquares,
    LeastTrimmedSquares,
    MEstimator,
    MinimumEntropy,
    MKCRegression,
    MMRegression,
    ReweightedLeastSquares,
    Ridge,
    SRegression,
)
from mkc_torch.linear._estimator import LinearEstimator

SAMPLES, COEFFICIENTS = 200, 4
SHARES = tuple(0.05 * k for k in range(11))
KINDS = ("in y", "at leverage")
BROKEN = 1.0
CHUNK = 50
WIDTH_95 = float(bandwidth_for_efficiency(0.95))

Fit = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Entry:
    """An estimator as a function of X (D, N, n) and Y (D, N) to coefficients (D, n), and when to take it."""

    name: str
    fit: Fit
    advice: str
    group: int


def library(estimator: LinearEstimator) -> Fit:
    # one channel, said by its own dimension, whatever the sizes
    return lambda X, Y: estimator.fit(X.unsqueeze(-2), Y.unsqueeze(-1)).coef_


def ransac(X: Tensor, Y: Tensor) -> Tensor:
    """Consensus within 2.5 standard deviations of the noise, which has to be known."""
    found = []
    for x, y in zip(X.numpy(), Y.numpy(), strict=True):
        model = RANSACRegressor(
            LinearRegression(fit_intercept=False),
            min_samples=COEFFICIENTS,
            residual_threshold=2.5,
            max_trials=500,
            random_state=0,
        )
        found.append(model.fit(x, y).estimator_.coef_)
    return torch.from_numpy(np.stack(found))


ENTRIES = (
    Entry("LeastSquares", library(LeastSquares()), "the best on clean Gaussian data; one outlier ruins it", 0),
    Entry("Ridge, α = 1", library(Ridge(1.0)), "for nearly dependent columns, not for outliers", 0),
    Entry(
        "LeastAbsoluteDeviations",
        library(LeastAbsoluteDeviations()),
        "outliers in y, no tuning, convex; costs a third of the data on clean ones",
        0,
    ),
    Entry("MEstimator huber", library(MEstimator("huber")), "some outliers in y; convex, so that no start matters", 0),
    Entry("MEstimator hampel", library(MEstimator("hampel")), "as tukey; falls off in a line", 0),
    Entry(
        "MEstimator tukey",
        library(MEstimator("tukey")),
        "gross outliers anywhere, from its robust start; quick in a batch",
        0,
    ),
    Entry("MEstimator andrews", library(MEstimator("andrews")), "as tukey", 0),
    Entry("MEstimator welsch", library(MEstimator("welsch")), "as tukey; the MKC kernel on a scale of its own", 0),
    Entry(
        "LeastMedianOfSquares",
        library(LeastMedianOfSquares()),
        "to see outliers, not to report coefficients: very inefficient",
        1,
    ),
    Entry("LeastTrimmedSquares", library(LeastTrimmedSquares()), "a start for others; robust and inefficient", 1),
    Entry(
        "ReweightedLeastSquares",
        library(ReweightedLeastSquares()),
        "outliers anywhere, with a yes or no for each sample",
        1,
    ),
    Entry("SRegression", library(SRegression()), "a robust scale; its coefficients are a start for MM", 1),
    Entry("MMRegression", library(MMRegression()), "outliers anywhere at a known price on clean data, 5 %", 1),
    Entry("RANSAC (scikit-learn)", ransac, "when the noise is known and speed counts; random, and inefficient", 1),
    Entry(
        "MinimumEntropy",
        library(MinimumEntropy()),
        "noise of unknown shape; outliers on one side shift its intercept",
        2,
    ),
    Entry(
        "GeneralizedMaximumEntropy",
        library(GeneralizedMaximumEntropy(20.0)),
        "fewer samples than coefficients, with limits known; not for outliers",
        2,
    ),
    Entry(
        "LeastEntropyLike",
        library(LeastEntropyLike()),
        "gross outliers without any scale, and only if there are some; look at all its minima",
        2,
    ),
    Entry(
        f"FixedPointLinear, σ = {WIDTH_95:.2f}, d = 1",
        library(FixedPointLinear(sigma=WIDTH_95, d=1.0)),
        "noise level known; fast, and a layer that differentiates",
        2,
    ),
    Entry(
        "MKCRegression (MKC-EM)",
        library(MKCRegression()),
        "the default: nothing to set, next to nothing lost on clean data; from a tight cluster of 30 % at leverage "
        "on its likelihood prefers the cluster: take MM or FixedPointLinear there",
        2,
    ),
)


def draw(draws: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """X (D, N, 4) with an intercept, and Y (D, N) at coefficients of 1."""
    z = torch.randn(draws, SAMPLES, COEFFICIENTS - 1, generator=generator, dtype=torch.float64)
    X = torch.cat([torch.ones(draws, SAMPLES, 1, dtype=torch.float64), z], -1)
    return X, X.sum(-1) + torch.randn(draws, SAMPLES, generator=generator, dtype=torch.float64)


def contaminated(X: Tensor, Y: Tensor, share: float, kind: str, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """The first samples replaced by outliers."""
    X, Y = X.clone(), Y.clone()
    count = round(share * SAMPLES)
    if kind == "in y":
        Y[:, :count] += 30.0
    else:
        around = torch.randn(len(X), count, COEFFICIENTS, generator=generator, dtype=torch.float64)
        X[:, :count, 1:] = 8.0 + 0.3 * around[..., 1:]
        Y[:, :count] = -40.0 + around[..., 0]
    return X, Y


def errors(entry: Entry, X: Tensor, Y: Tensor) -> Tensor:
    """|θ - θ°|² of each draw."""
    parts = [entry.fit(x, y) for x, y in zip(X.split(CHUNK), Y.split(CHUNK), strict=True)]
    return (torch.cat(parts) - 1.0).square().sum(-1)


@dataclass(frozen=True)
class Result:
    entry: Entry
    efficiency: float
    error: float
    bias: dict[str, list[float]]  # median |θ - θ°| at each of SHARES
    alone: float  # ms of one fit at a time
    together: float  # ms of each of many in one call

    def breakdown(self, kind: str) -> str:
        broken = [share for share, value in zip(SHARES, self.bias[kind], strict=True) if value > BROKEN]
        return f"{100 * broken[0]:.0f} %" if broken else "> 50 %"

    def cells(self) -> list[str]:
        return [
            self.entry.name,
            f"{100 * self.efficiency:.1f} ± {100 * self.error:.1f}",
            *(self.breakdown(kind) for kind in KINDS),
            f"{self.bias['at leverage'][4]:.2f}",
            f"{self.alone:.2g}" if self.alone < 10 else f"{self.alone:.0f}",
            f"{self.together:.2g}" if self.together < 10 else f"{self.together:.0f}",
            self.entry.advice,
        ]


HEADINGS = (
    "estimator",
    "efficiency, %",
    "breaks, y",
    "breaks, leverage",
    "error at 20 % leverage",
    "ms alone",
    "ms in a batch",
    "advice",
)


def measure(entry: Entry, data: tuple[Tensor, Tensor], least: Tensor, curve_draws: int, seed: int) -> Result:
    X, Y = data
    entry.fit(X[:1], Y[:1])
    times = []
    for x, y in zip(X[:5], Y[:5], strict=True):
        start = time.perf_counter()
        entry.fit(x.unsqueeze(0), y.unsqueeze(0))
        times.append(time.perf_counter() - start)
    start = time.perf_counter()
    square = errors(entry, X, Y)
    together = (time.perf_counter() - start) / len(X)
    efficiency = float(least.mean() / square.mean())
    # of a ratio of means over the same draws
    spread = (least - efficiency * square).std() / (len(X) ** 0.5 * square.mean())
    bias: dict[str, list[float]] = {}
    for kind in KINDS:
        generator = torch.Generator().manual_seed(seed + 1)
        x, y = draw(curve_draws, generator)
        bias[kind] = [
            float(errors(entry, *contaminated(x, y, s, kind, generator)).sqrt().quantile(0.5)) for s in SHARES
        ]
    return Result(entry, efficiency, float(spread), bias, 1e3 * sorted(times)[len(times) // 2], 1e3 * together)


def print_table(console: Console, results: list[Result], draws: int) -> None:
    table = Table(title=f"N = {SAMPLES}, n = {COEFFICIENTS}, {draws} draws")
    for heading in HEADINGS[:-1]:
        table.add_column(heading, justify="left" if heading == "estimator" else "right", no_wrap=heading == "estimator")
    for result in results:
        table.add_row(*result.cells()[:-1])
    console.print(table)
    for result in results:
        console.print(f"{result.entry.name}: {result.entry.advice}.")


def sentence(results: list[Result]) -> str:
    em = next(r for r in results if "MKC-EM" in r.entry.name)
    low = 100 * (em.efficiency - 2 * em.error)
    verdict = "met" if em.efficiency >= 0.99 else "not met"
    return (
        f"MKC-EM's Gaussian efficiency at N = {SAMPLES}, n = {COEFFICIENTS}: {100 * em.efficiency:.2f} ± "
        f"{100 * em.error:.2f} % (two standard errors below: {low:.2f} %); at least 99 % is {verdict}."
    )


def markdown(results: list[Result], draws: int, curve_draws: int, hough: str) -> str:
    lines = ["# Linear estimators side by side", ""]
    lines += [
        f"N = {SAMPLES}, n = {COEFFICIENTS}, {draws} draws for the efficiency, {curve_draws} for each point below.",
        "",
    ]
    lines += ["| " + " | ".join(HEADINGS) + " |", "|---|" + "---:|" * (len(HEADINGS) - 2) + "---|"]
    lines += ["| " + " | ".join(r.cells()) + " |" for r in results]
    lines += ["", sentence(results), "", hough, "", "![bias over the share of outliers](comparison.png)", ""]
    assert __doc__ is not None
    lines += [__doc__.split("\n\n", 2)[2].strip().replace("\n", " "), ""]
    for kind in KINDS:
        lines += ["", f"Median error |θ − θ°|, outliers {kind}:", ""]
        lines += [
            "| estimator | " + " | ".join(f"{100 * s:.0f} %" for s in SHARES) + " |",
            "|---|" + "---:|" * len(SHARES),
        ]
        lines += [f"| {r.entry.name} | " + " | ".join(f"{v:.2f}" for v in r.bias[kind]) + " |" for r in results]
    return "\n".join(lines) + "\n"


def picture(path: Path, results: list[Result]) -> None:
    figure = Figure(figsize=(12.5, 11.0), layout="constrained")
    panels = figure.subplots(3, 3, width_ratios=(1, 1, 0.42), sharex=False)
    colours = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#8c564b")
    marks = "osD^v<>P"
    em = results[-1]
    for group in range(3):
        shown = [r for r in results if r.entry.group == group and r is not em]
        for column, kind in enumerate(KINDS):
            axes = panels[group, column]
            for i, r in enumerate(shown):
                axes.plot(SHARES, r.bias[kind], marks[i] + "-", ms=4, lw=1.2, color=colours[i], label=r.entry.name)
            axes.plot(SHARES, em.bias[kind], color="black", lw=2.2, label=em.entry.name)
            axes.axhline(BROKEN, color="0.6", ls=":", lw=1)
            axes.set(yscale="log", ylim=(0.08, 120.0))
            axes.xaxis.set_major_formatter(lambda v, _: f"{100 * v:.0f} %")
            axes.grid(alpha=0.3)
        panels[group, 0].set_ylabel("median |θ − θ°|")
        panels[group, 2].axis("off")
        panels[group, 2].legend(
            *panels[group, 0].get_legend_handles_labels(), loc="center left", frameon=False, fontsize=9
        )
    for column, kind in enumerate(KINDS):
        panels[0, column].set_title(f"outliers {kind}")
        panels[2, column].set_xlabel("share of outliers")
    figure.savefig(path, dpi=130)


def hough_line(x: Tensor, y: Tensor) -> tuple[float, float]:
    """Intercept and slope of the line with most votes in an image of 512 by 512 pixels."""
    transform = importlib.import_module("skimage.transform")
    pixels = 511
    size = torch.stack([x.max() - x.min(), y.max() - y.min()]) / pixels
    columns, rows = ((v - v.min()) / s for v, s in ((x, size[0]), (y, size[1])))
    image = np.zeros((pixels + 1, pixels + 1), dtype=bool)
    image[rows.round().long().numpy(), columns.round().long().numpy()] = True
    votes, angles, distances = transform.hough_line(image, np.linspace(-np.pi / 2, np.pi / 2, 1800, endpoint=False))
    row, column = np.unravel_index(int(votes.argmax()), votes.shape)
    # column cos + row sin = distance
    sine, cosine = math.sin(angles[column]), math.cos(angles[column])
    slope = -cosine / sine * float(size[1] / size[0])
    at_zero = float(distances[row]) / sine * float(size[1]) + float(y.min())
    return at_zero - slope * float(x.min()), slope


def compare_hough(draws: int, generator: torch.Generator) -> str:
    if importlib.util.find_spec("skimage") is None:
        return "Hough voting: left out, scikit-image is not installed."
    X, Y = draw(draws, generator)
    X, Y = X[..., :2], Y - X[..., 2] - X[..., 3]
    Y[:, :40] += 30.0
    start = time.perf_counter()
    found = torch.tensor([hough_line(x[:, 1], y) for x, y in zip(X, Y, strict=True)])
    seconds = (time.perf_counter() - start) / draws
    em = MKCRegression().fit(X.unsqueeze(-2), Y.unsqueeze(-1)).coef_
    hough, mkc = (float((c - 1).norm(dim=-1).median()) for c in (found, em))
    return (
        f"Hough voting (scikit-image) on a line with 20 % outliers in y: median error {hough:.2f}, MKC-EM's {mkc:.2f}; "
        f"{1e3 * seconds:.0f} ms a fit. For lines in images: its precision is that of its pixels and angles."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=500, help="for the efficiency, at least 2; 5000 for the full one")
    parser.add_argument("--curve-draws", type=int, default=20, help="for each point of the curves")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", metavar="FOLDER", type=Path, help="for comparison.md and comparison.png")
    options = parser.parse_args()
    if options.draws < 2 or options.curve_draws < 1:
        parser.error("expected --draws of at least 2 and --curve-draws of at least 1")
    torch.set_num_threads(1)
    console = Console(width=120)
    data = draw(options.draws, torch.Generator().manual_seed(options.seed))
    least = errors(ENTRIES[0], *data)
    results = [measure(entry, data, least, options.curve_draws, options.seed) for entry in ENTRIES]
    hough = compare_hough(min(options.draws, 20), torch.Generator().manual_seed(options.seed + 2))
    print_table(console, results, options.draws)
    console.print(sentence(results))
    console.print(hough)
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
        text = markdown(results, options.draws, options.curve_draws, hough)
        (options.output / "comparison.md").write_text(text, encoding="utf-8")
        picture(options.output / "comparison.png", results)
        console.print(f"The page is {options.output / 'comparison.md'}.")


if __name__ == "__main__":
    main()

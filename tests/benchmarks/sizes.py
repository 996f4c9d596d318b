"""Cost of a fit and of a diagnosis over size, as a picture: `python -m tests.benchmarks.sizes --output sizes.png`.

CPU seconds of one thread over rows (in memory, and streamed from a file), over columns, over problems in one call, over
ranks, over candidates and over the samples of a diagnosis. A curve ends before the first point that is expected to take
longer than `--seconds`, or whose file exceeds `--bytes`. The points are printed at once.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.linear import MKCRegression
from mkc_torch.linear.streaming import StreamedMKCRegression
from mkc_torch.simulation import Magnetometer, Simulation
from mkc_torch.simulation.load import load_simulation
from tests.benchmarks import diagnosis, streaming
from tests.benchmarks.small_fits import sample

Work = Callable[[], object]


@dataclass(frozen=True)
class Limits:
    """Limits of a point: CPU seconds, and bytes of memory or of a file."""

    seconds: float
    bytes: float


@dataclass
class Curve:
    """CPU seconds over sizes."""

    name: str
    panel: str
    sizes: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def measure(self, sizes: Iterable[int], work_of: Callable[[int], Work | None], limit: float) -> Curve:
        """Add a point for each size. ``work_of`` prepares the work, untimed; None from it ends the curve."""
        for size in sizes:
            if self._expected(size) > limit:
                break
            work = work_of(size)
            if work is None:
                break
            begin = time.process_time()
            work()
            self.sizes.append(float(size))
            self.seconds.append(time.process_time() - begin)
            print(f"{self.panel:<32}{self.name:<34}{size:>12,}{self.seconds[-1]:>12.3f} s", flush=True)
        return self

    def _expected(self, size: int) -> float:
        """Expected seconds, extrapolated from the last two points with an exponent of at least 1."""
        if len(self.sizes) < 2:
            return 0.0
        (a, b), (s, t) = self.sizes[-2:], self.seconds[-2:]
        power = max(1.0, math.log(t / s) / math.log(b / a)) if s > 0 and t > s else 1.0
        return t * (size / b) ** power


def powers(least: float, most: float, each: int = 2) -> list[int]:
    """``each`` numbers a decade, the powers of ten among them."""
    low, high = round(each * math.log10(least)), round(each * math.log10(most))
    return [round(10 ** (k / each)) for k in range(low, high + 1)]


def fit_of(rows: int, columns: int) -> Work:
    X, y = sample(0, rows, columns)
    return lambda: MKCRegression().fit(X, y)


def least_squares_of(rows: int, columns: int) -> Work:
    X, y = sample(0, rows, columns)
    return lambda: torch.linalg.lstsq(X, y.unsqueeze(-1)).solution


def of_rows(limits: Limits, folder: Path) -> list[Curve]:
    panel, columns = "rows", 9
    most = min(1e8, limits.bytes / (8 * (columns + 1)))

    def streamed(rows: int) -> Work | None:
        if rows * 36 > limits.bytes:
            return None
        path = folder / "rows.f32"
        streaming.write_table(path, rows)
        batches = streaming.batches_of(path)
        return lambda: StreamedMKCRegression().fit(batches)

    sizes = powers(1e3, most)
    return [
        Curve("MKCRegression, 9 columns", panel).measure(sizes, lambda N: fit_of(N, columns), limits.seconds),
        Curve("torch.linalg.lstsq", panel).measure(sizes, lambda N: least_squares_of(N, columns), limits.seconds),
        Curve("streamed from a file, 8 columns", panel).measure(powers(1e5, 1e8), streamed, limits.seconds),
    ]


def of_columns(limits: Limits) -> list[Curve]:
    panel, rows = "columns, of 20,000 rows", 20_000
    sizes = (3, 10, 30, 100, 300)
    return [
        Curve("MKCRegression", panel).measure(sizes, lambda n: fit_of(rows, n), limits.seconds),
        Curve("torch.linalg.lstsq", panel).measure(sizes, lambda n: least_squares_of(rows, n), limits.seconds),
    ]


def of_problems(limits: Limits) -> list[Curve]:
    def many(B: int) -> Work:
        X, y = sample(1, B, 100, 2)
        return lambda: MKCRegression().fit(X, y)

    return [Curve("MKCRegression", "problems of 100 × 2, one call").measure(powers(1, 1e5, 1), many, limits.seconds)]


def of_ranks(limits: Limits, folder: Path) -> list[Curve]:
    rows = int(min(1e7, limits.bytes / 36))
    path = folder / "ranks.f32"
    streaming.write_table(path, rows)
    curve = Curve(f"{rows:,} rows, by the clock", "ranks of one thread")
    for ranks in (1, 2):
        wall, _ = streaming.of_ranks(ranks, path, 2)["whole fit"]
        curve.sizes.append(float(ranks))
        curve.seconds.append(wall)
        print(f"{curve.panel:<32}{curve.name:<34}{ranks:>12,}{wall:>12.3f} s", flush=True)
    return [curve]


def of_candidates(limits: Limits, folder: Path) -> list[Curve]:
    """A diagnosis of a recording with an increasing number of candidate columns."""
    recording = Recording.read(diagnosis.sensor(folder / "candidates.csv", 20, 60, 0))
    random = np.random.default_rng(0)
    curve = Curve("60 s at 20 Hz", "candidates of a diagnosis")
    for drivers in (1, 3, 10, 30, 100, 300):
        more = {
            f"current_{k}": torch.from_numpy(np.cumsum(random.standard_normal(len(recording)))) for k in range(drivers)
        }
        wide = Recording({name: recording[name] for name in recording.names} | more)
        simulation = Magnetometer()
        prepared = simulation.prepare(wide)
        roles = frozenset(role for effect in CATALOGUE for role in effect.roles)
        found = find_drivers(prepared.recording, simulation.columns, Settings().drivers, roles)
        candidates = len(candidate_terms(prepared, found.drivers, CATALOGUE))
        count = len(curve.sizes)
        curve.measure([candidates], lambda _, wide=wide: lambda: diagnose(Magnetometer(), wide), limits.seconds)
        if len(curve.sizes) == count:
            break
    return [curve]


def of_samples(limits: Limits, folder: Path) -> list[Curve]:
    def sensor(samples: int) -> Work:
        recording = Recording.read(diagnosis.sensor(folder / f"length_{samples}.csv", 50, samples / 50, 0))
        return lambda: diagnose(Magnetometer(), recording)

    file = folder / "cart.py"
    file.write_text(diagnosis.CART)

    def cart(samples: int) -> Work:
        recording = Recording.read(diagnosis.cart(folder / f"cart_{samples}.csv", samples))
        simulation: Simulation = load_simulation(f"{file}:Cart")
        return lambda: diagnose(simulation, recording)

    panel = "samples of a diagnosis"
    return [
        Curve("magnetometer, 50 Hz", panel).measure(powers(3162, 1e5), sensor, limits.seconds),
        Curve("three states, 50 Hz", panel).measure(powers(1e3, 1e5), cart, limits.seconds),
    ]


def picture(curves: list[Curve], path: Path) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    panels = list(dict.fromkeys(curve.panel for curve in curves))
    figure = Figure(figsize=(12, 7.5), layout="constrained")
    axes = figure.subplots(2, 3)
    for ax, panel in zip(axes.flat, panels, strict=True):
        mine = [curve for curve in curves if curve.panel == panel]
        for curve in mine:
            ax.loglog(curve.sizes, curve.seconds, "o-", markersize=4, label=curve.name)
        ends = [math.log10(size) for curve in mine for size in curve.sizes]
        ax.set_xlim(10 ** math.floor(min(ends)) / 1.2, 10 ** math.ceil(max(ends)) * 1.2)
        ax.xaxis.set_minor_formatter(NullFormatter())
        if panel.startswith("ranks"):
            ax.set_xscale("linear")
            ax.set_xlim(0.9, 2.1)
            ax.set_yscale("linear")
            ax.set_xticks([1, 2])
            ax.set_ylim(bottom=0.0)
        ax.set_xlabel(panel)
        ax.set_ylabel("seconds by the clock" if panel.startswith("ranks") else "CPU seconds")
        ax.grid(which="both", alpha=0.2)
        ax.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True, help="file of the picture")
    parser.add_argument("--seconds", type=float, default=60.0, help="largest CPU seconds of a point")
    parser.add_argument("--bytes", type=float, default=4e9, help="largest bytes of memory, or of a file, of a point")
    options = parser.parse_args()
    limits = Limits(options.seconds, options.bytes)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        curves = of_rows(limits, folder) + of_columns(limits) + of_problems(limits) + of_ranks(limits, folder)
        curves += of_candidates(limits, folder) + of_samples(limits, folder)
    picture(curves, options.output)


if __name__ == "__main__":
    main()

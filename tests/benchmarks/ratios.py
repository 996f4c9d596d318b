"""Speed of fits and losses as ratios to a reference in the same run, compared with the stored ratios:

    python -m tests.benchmarks.ratios             # exit 1 if a ratio is three times the stored ratio
    python -m tests.benchmarks.ratios --store     # replace the stored ratios, on an idle machine

Wall-clock times with all cores, the least of several in turn. Ratios differ between machines by up to a factor of two.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import nn

from mkc_torch import MKCLoss
from mkc_torch.calibration import EllipsoidFit
from mkc_torch.linear import LeastTrimmedSquares, MKCRegression, MMRegression
from tests.benchmarks import large_fits, small_fits

STORED = Path(__file__).with_name("ratios.json")

SLOWER = 3.0
"""Factor on a stored ratio that fails: machines differ by up to two."""

SECONDS = 2.0
"""Shortest time of all runs of a pair."""

FEWEST = 3


class Pair(NamedTuple):
    """A work, and the reference that its time is divided by."""

    name: str
    work: Callable[[], object]
    reference: Callable[[], object]


def pairs() -> list[Pair]:
    """All pairs; the data are the same in every run."""
    X, y = large_fits.sample(1_000_000)
    small, small_y = small_fits.sample(0, 300, 6)
    many, many_y = small_fits.sample(1, 1000, 100, 2)
    sphere = nn.functional.normalize(torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0)).double(), dim=1)
    fits = [
        Pair("MKCRegression, 1,000,000 x 9", lambda: MKCRegression().fit(X, y), _lstsq(X, y)),
        Pair("MKCRegression, 300 x 6", lambda: MKCRegression().fit(small, small_y), _lstsq(small, small_y)),
        Pair("MMRegression, 300 x 6", lambda: MMRegression().fit(small, small_y), _lstsq(small, small_y)),
        Pair("LeastTrimmedSquares, 300 x 6", lambda: LeastTrimmedSquares().fit(small, small_y), _lstsq(small, small_y)),
        Pair("MKCRegression, 1000 fits of 100 x 2", lambda: MKCRegression().fit(many, many_y), _lstsq(many, many_y)),
        Pair("EllipsoidFit, 20,000 x 3", lambda: EllipsoidFit().fit(sphere), _lstsq(sphere, sphere[:, 0])),
    ]
    losses = [
        ("MKCLoss, 256 x 4", MKCLoss(4), 256),
        ("MKCLoss, given d, 256 x 4", MKCLoss(4, d=1.0), 256),
        ("MKCLoss, 1,000,000 x 4", MKCLoss(4), 1_000_000),
        ("MKCLoss, nothing learned, 1,000,000 x 4", MKCLoss(4, d=1.0, learn_sigma=False, learn_d=False), 1_000_000),
    ]
    return fits + [Pair(name, _step(loss, rows), _step(nn.HuberLoss(), rows)) for name, loss, rows in losses]


def _lstsq(X: torch.Tensor, y: torch.Tensor) -> Callable[[], object]:
    return partial(torch.linalg.lstsq, X, y.unsqueeze(-1))


def _step(loss: nn.Module, rows: int) -> Callable[[], object]:
    """A forward and a backward pass of a loss."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(rows, 4, generator=generator).requires_grad_()
    y = torch.randn(rows, 4, generator=generator)
    inputs = [x, *loss.parameters()]
    return lambda: torch.autograd.grad(loss(x, y), inputs)


def ratio_of(pair: Pair) -> float:
    """The least time of the work over that of the reference, timed in turn after a run of each."""
    least = [float("inf"), float("inf")]
    works = (pair.work, pair.reference)
    for work in works:
        work()
    begin, repeats = time.perf_counter(), 0
    while repeats < FEWEST or time.perf_counter() - begin < SECONDS:
        for k, work in enumerate(works):
            start = time.perf_counter()
            work()
            least[k] = min(least[k], time.perf_counter() - start)
        repeats += 1
    return least[0] / least[1]


def outgrown(found: Mapping[str, float], stored: Mapping[str, float]) -> list[str]:
    """Names of the ratios that are at least three times the stored ratio.

    Example:
        >>> outgrown({"a": 2.9, "b": 3.1, "new": 9.0}, {"a": 1.0, "b": 1.0})
        ['b']
    """
    return [name for name, ratio in found.items() if name in stored and ratio >= SLOWER * stored[name]]


def main(arguments: list[str] | None = None) -> int:
    """Print each ratio next to the stored ratio. Returns 1 if any has outgrown it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", action="store_true", help="replace the stored ratios")
    options = parser.parse_args(arguments)
    stored = json.loads(STORED.read_text(encoding="utf-8")) if STORED.is_file() else {}
    found = {}
    print(f"{'time over that of its reference':<44}{'now':>8}{'stored':>8}")
    for pair in pairs():
        found[pair.name] = round(ratio_of(pair), 2)
        print(f"{pair.name:<44}{found[pair.name]:>8.2f}{stored.get(pair.name, float('nan')):>8.2f}", flush=True)
    if options.store:
        STORED.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        return 0
    slower = outgrown(found, stored)
    for name in slower:
        print(f"{name}: {SLOWER:g} times as slow as stored, or more")
    return int(bool(slower))


if __name__ == "__main__":
    sys.exit(main())

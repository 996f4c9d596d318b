"""CPU time and memory of one large robust fit compared with least squares, scikit-learn and statsmodels, in one run:

    python -m tests.benchmarks.large_fits

Data of 9 columns with 10 % outliers, in one thread; times are CPU milliseconds, the least of several. Prints how many
times the data are read, how long that takes at the rate at which the machine reads and sums memory, and the peak memory
of a process that holds the data and fits them. Packages that are not installed are left out.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mkc_torch.linear import MKCRegression, _rows
from tests.benchmarks.small_fits import milliseconds, peers

COLUMNS = 9

REPEATS = 7
"""Number of timings; the least is printed."""


def sample(N: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """X (N, 9) with an intercept, and y whose first tenth lies 20 higher."""
    generator = torch.Generator().manual_seed(seed)
    X = torch.randn(N, COLUMNS, generator=generator, dtype=torch.float64)
    X[:, 0] = 1.0
    y = X.sum(-1) + torch.randn(N, generator=generator, dtype=torch.float64)
    y[: N // 10] += 20.0
    return X, y


def least_milliseconds(works: dict[str, Callable[[], object]]) -> dict[str, float]:
    """The least CPU time of each work in ms, timed in turn: other load of the machine affects all alike."""
    times = {name: milliseconds(work, 1) for name, work in works.items()}
    for _ in range(REPEATS):
        for name, work in works.items():
            times[name] = min(times[name], milliseconds(work, 1))
    return times


def bytes_read(X: Tensor, y: Tensor) -> int:
    """Bytes of X and y that a fit reads."""
    read = 0
    blocks = _rows.blocks

    def counted(*given: Tensor | None, **options: object) -> Iterator[object]:
        nonlocal read
        for block in blocks(*given, **options):
            read += block.y.numel() * (COLUMNS + 1) * y.element_size()
            yield block

    _rows.blocks = counted
    try:
        MKCRegression().fit(X, y)
    finally:
        _rows.blocks = blocks
    # the check of every value in addition
    return read + X.nbytes + y.nbytes


def difference_in_standard_errors(fit: MKCRegression, X: Tensor, y: Tensor) -> float:
    """Largest distance of the coefficients from the converged coefficients on the same domain, in standard errors."""
    converged = MKCRegression(bound=fit.bound_, start=fit.coef_).fit(X.clone().requires_grad_(), y)
    return float(((fit.coef_ - converged.coef_.detach()) / fit.standard_error_).abs().max())


def peak(N: int) -> float:
    """Peak memory, without the code, of a process that fits N rows, as a multiple of the data."""
    with tempfile.TemporaryDirectory() as folder:
        X, y = sample(N)
        np.save(Path(folder) / "X.npy", X.numpy())
        np.save(Path(folder) / "y.npy", y.numpy())
        del X, y
        done = subprocess.run(
            [sys.executable, "-m", "tests.benchmarks.large_fits", folder], capture_output=True, text=True, check=True
        )
        return float(done.stdout)


def print_own_peak(folder: str) -> None:
    """Load and fit the data in ``folder``, and print the peak memory of this process as a multiple of the data."""
    MKCRegression().fit(*sample(25_000))
    before = memory("VmRSS")
    X, y = (torch.from_numpy(np.load(Path(folder) / f"{name}.npy")) for name in "Xy")
    MKCRegression().fit(X, y)
    print((memory("VmHWM") - before) / (X.nbytes + y.nbytes))


def memory(name: str) -> int:
    """Bytes of this process by the name in Linux' status file; the peak of rusage may be that of the parent."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))


def main() -> None:
    torch.set_num_threads(1)
    if len(sys.argv) > 1:
        print_own_peak(sys.argv[1])
        return
    X, y = sample(1_000_000)
    print(f"one fit of {X.shape[0]} × {COLUMNS}, 10 % outliers{'ms':>12}{'ratio':>8}")
    works = {
        "torch.linalg.lstsq": lambda: torch.linalg.lstsq(X, y[:, None]),
        "MKCRegression": lambda: MKCRegression().fit(X, y),
        "read and sum X, y": lambda: X.sum() + y.sum(),
    }
    times = least_milliseconds(works)
    for name, taken in times.items():
        print(f"  {name:<36}{taken:>9.1f}{taken / times['torch.linalg.lstsq']:>8.2f}", flush=True)
    passes = bytes_read(X, y) / (X.nbytes + y.nbytes)
    limit = passes * times["read and sum X, y"]
    rate = (X.nbytes + y.nbytes) / times["read and sum X, y"] / 1e6
    print(f"  data read {passes:.1f} times; at {rate:.1f} GB/s that is {limit:.0f} ms", flush=True)
    print(f"  peak of memory {peak(X.shape[0]):.2f} × the data", flush=True)
    X, y = sample(200_000)
    print(f"one fit of {X.shape[0]} × {COLUMNS}, 10 % outliers{'ms':>13}{'ratio':>8}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        others = peers(X.numpy(), y.numpy())
        others.pop("statsmodels RLMDetSMM", None)  # for small fits only
        times = least_milliseconds({"MKCRegression": lambda: MKCRegression().fit(X, y), **others})
    for name, taken in times.items():
        print(f"  {name:<36}{taken:>9.1f}{taken / times['MKCRegression']:>8.2f}", flush=True)
    print(
        f"  from fully converged: {difference_in_standard_errors(MKCRegression().fit(X, y), X, y):.0e} standard errors"
    )


if __name__ == "__main__":
    main()

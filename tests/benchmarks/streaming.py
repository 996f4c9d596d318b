"""A streamed fit of a table on disk compared with reading the table, with one rank and with two:

    python -m tests.benchmarks.streaming --rows 10000000 --folder /tmp

Writes rows of nine float32, eight columns and a target of which a fifth is wrong, to a file of 36 bytes a row, and
removes it at the end. Prints:

- nanoseconds a row of each pass, and of reading and summing the same file, warm, of one thread, the least of several;
- seconds of a whole fit, and its resident memory: anonymous memory, and pages of the file in the cache;
- wall and CPU seconds of passes and of a fit with one rank and with two, of the slower rank. CPU time is the fairer
  measure if the processors have other work.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import distributed as dist

from mkc_torch._support.ranks import Ranks
from mkc_torch.linear._blocks import Density, flat_length
from mkc_torch.linear.streaming import MemmapBatches, StreamedMKCRegression, from_memmap
from mkc_torch.linear.streaming._batches import Shape
from mkc_torch.linear.streaming._reservoir import Reservoir
from mkc_torch.linear.streaming._rows import Wanted, sums_pass
from mkc_torch.linear.streaming._survey import survey_rows

COLUMNS = 8
WRITTEN = 1_000_000
"""Rows that are drawn and written at once."""

READ = 65_536
"""Rows that are summed at once: the fastest power of two."""

SHAPE = Shape(1, COLUMNS, True, False)

POINT = (torch.ones(COLUMNS).double(), Density(torch.tensor([0.25]).double(), torch.tensor([0.5]).double()))


def write_table(path: Path, rows: int) -> None:
    """Rows of eight standard normal columns, and their sum with noise of 0.5, a fifth of it up to 20 higher."""
    random = np.random.default_rng(0)
    with path.open("wb") as file:
        for first in range(0, rows, WRITTEN):
            block = random.standard_normal((min(WRITTEN, rows - first), COLUMNS + 1), dtype=np.float32)
            block[:, COLUMNS] = block[:, :COLUMNS].sum(1) + 0.5 * block[:, COLUMNS]
            wrong = random.random(len(block)) < 0.2
            block[wrong, COLUMNS] += random.uniform(0.0, 20.0, wrong.sum()).astype(np.float32)
            block.tofile(file)


def table_of(path: Path) -> np.ndarray:
    return np.memmap(path, np.float32, mode="r").reshape(-1, COLUMNS + 1)


def batches_of(path: Path, shard: tuple[int, int] | None = None) -> MemmapBatches:
    table = table_of(path)
    return from_memmap(table[:, :COLUMNS], table[:, COLUMNS], shard=shard)


def read_and_sum(table: np.ndarray) -> float:
    return sum(float(table[first : first + READ].sum()) for first in range(0, len(table), READ))


def passes(batches: MemmapBatches) -> dict[str, Callable[[], object]]:
    def one_pass(**wanted: bool) -> Callable[[], object]:
        return lambda: sums_pass(batches, SHAPE, None, *POINT, Wanted(**wanted))

    return {
        "gradient in float32": one_pass(rough=True),
        "gradient": one_pass(),
        "gradient and range of residuals": one_pass(with_range=True),
        "the last, with the covariance": one_pass(with_curvature=True),
        "the first, with a sample": lambda: survey_rows(batches, Reservoir(50_000, 0, rows=batches.rows)),
    }


def seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def least_seconds_in_turn(work: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """The least seconds of each work; the works are timed in turn, ``repeats`` times."""
    best = dict.fromkeys(work, math.inf)
    for _ in range(repeats):
        for name, run in work.items():
            best[name] = min(best[name], seconds(run))
    return best


def resident() -> dict[str, float]:
    """Megabytes of memory of this process by kind, on Linux."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return {line.split(":")[0]: int(line.split()[1]) / 1e3 for line in lines if line.startswith(("RssAnon", "RssFile"))}


@contextmanager
def peak_memory() -> Iterator[dict[str, float]]:
    """The peak of resident memory within the context, in MB."""
    most, over = resident(), threading.Event()

    def look() -> None:
        while not over.wait(0.02):
            for name, value in resident().items():
                most[name] = max(most[name], value)

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield most
    finally:
        over.set()
        thread.join()


def rank_main(rank: int, ranks: int, port: int, path: Path, repeats: int, results: Any) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", f"tcp://127.0.0.1:{port}", rank=rank, world_size=ranks)
    batches, best = batches_of(path, (rank, ranks)), {}
    group, length = Ranks(), 1 + flat_length(1, COLUMNS, with_curvature=False)
    # a pass for the gradient includes its sum over ranks
    work: dict[str, Callable[[], object]] = {
        "gradient": lambda: group.sum_of(lambda: sums_pass(batches, SHAPE, None, *POINT, Wanted()), length),
        "whole fit": lambda: StreamedMKCRegression().fit(batches),
    }
    for _ in range(repeats):
        for name, run in work.items():
            dist.barrier()
            begin = time.process_time()
            wall = seconds(run)
            # all ranks wait for the slowest
            slowest = torch.tensor([wall, time.process_time() - begin])
            dist.all_reduce(slowest, dist.ReduceOp.MAX)
            best[name] = [min(pair) for pair in zip(best.get(name, [math.inf] * 2), slowest.tolist(), strict=True)]
    if rank == 0:
        results.put(best)
    dist.destroy_process_group()


def of_ranks(ranks: int, path: Path, repeats: int) -> dict[str, list[float]]:
    """Wall and CPU seconds of two passes and of a fit with ``ranks`` processes of one thread."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    context = multiprocessing.get_context("spawn")
    results = context.SimpleQueue()
    processes = [
        context.Process(target=rank_main, args=(rank, ranks, port, path, repeats, results)) for rank in range(ranks)
    ]
    for process in processes:
        process.start()
    best: dict[str, list[float]] = results.get()
    for process in processes:
        process.join()
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=10_000_000)
    parser.add_argument("--folder", type=Path, default=None, help="folder of the file")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path = Path(folder) / "table.f32"
        write_table(path, options.rows)
        table, batches = table_of(path), batches_of(path)
        read_and_sum(table)
        with peak_memory() as most:
            taken = seconds(lambda: StreamedMKCRegression().fit(batches))
        fit = StreamedMKCRegression().fit(batches)
        print(f"{options.rows} rows of {COLUMNS} columns and a target, float32, {path.stat().st_size / 1e9:.2f} GB")
        print(f"whole fit, {fit.n_iter_} passes: {taken:.1f} s, off by {float((fit.coef_ - 1).abs().max()):.1e}")
        print(f"resident: anonymous {most['RssAnon']:.0f} MB, pages of the file {most['RssFile']:.0f} MB")
        best = least_seconds_in_turn({"read and sum": lambda: read_and_sum(table), **passes(batches)}, options.repeats)
        print(f"{'a pass':<32}{'ns a row':>10}{'of the rate of read and sum':>30}")
        for name, time_taken in best.items():
            print(f"  {name:<30}{1e9 * time_taken / options.rows:>10.2f}{best['read and sum'] / time_taken:>29.0%}")
        single, double = (of_ranks(ranks, path, max(2, options.repeats // 2)) for ranks in (1, 2))
        print(f"{'ranks of one thread':<32}{'one, s':>10}{'two, s':>10}{'ratio':>10}{'ratio of CPU time':>20}")
        for name in single:
            (wall, cpu), (wall_of_two, cpu_of_two) = single[name], double[name]
            ratios = f"{wall / wall_of_two:>10.2f}{cpu / cpu_of_two:>20.2f}"
            print(f"  {name:<30}{wall:>10.2f}{wall_of_two:>10.2f}{ratios}")


if __name__ == "__main__":
    main()

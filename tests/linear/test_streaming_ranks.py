"""Streamed fits of a process group: two ranks give the results of one rank; an error or loss of a rank fails all."""

import multiprocessing
import os
import signal
import socket
import time
from datetime import timedelta
from pathlib import Path

import pytest
import torch
from torch import distributed as dist

from mkc_torch._support.ranks import Ranks, RanksError
from mkc_torch.linear.streaming import StreamedMKCRegression, from_memmap
from tests.linear.test_streaming import problem

ROWS = 3000
FIELDS = ("coef_", "sigma_", "d_", "bound_", "covariance_", "log_likelihood_", "history_")


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def run_ranks(work, folder, ranks=2):
    """Run ``work(rank, folder)`` in a process for each rank; return their exit codes once all have ended."""
    context, port = multiprocessing.get_context("spawn"), free_port()
    processes = [context.Process(target=_process, args=(work, rank, ranks, port, str(folder))) for rank in range(ranks)]
    for process in processes:
        process.start()
    end = time.monotonic() + 50
    for process in processes:
        process.join(max(0.0, end - time.monotonic()))
    codes = [process.exitcode for process in processes]
    for process in processes:
        process.kill()
    return codes


def _process(work, rank, ranks, port, folder):
    torch.set_num_threads(1)
    dist.init_process_group(
        "gloo", f"tcp://127.0.0.1:{port}", rank=rank, world_size=ranks, timeout=timedelta(seconds=40)
    )
    work(rank, folder)
    dist.destroy_process_group()


def table():
    X, Y = problem(0, N=ROWS)
    return X.numpy(), Y.numpy()


def fitted(fit):
    return {name: getattr(fit, name) for name in FIELDS}


class UncountedBatches:
    """Batches of an unknown number of rows."""

    def __init__(self, batches):
        self.batches = batches

    def __iter__(self):
        return iter(self.batches)


def _fit_on_rank(rank, folder):
    X, Y = table()
    arguments = {"pilot": 300}
    results = {
        "shards": StreamedMKCRegression(**arguments).fit(from_memmap(X, Y, rows=100, shard=(rank, 2))),
        "uneven": StreamedMKCRegression(**arguments).fit(from_memmap(*((X[:7], Y[:7]), (X[7:], Y[7:]))[rank])),
        "empty": StreamedMKCRegression(**arguments).fit(from_memmap(*((X, Y), (X[:0], Y[:0]))[rank])),
        "uncounted": StreamedMKCRegression(bound=30.0, **arguments).fit(
            UncountedBatches([(X[rank::2][i : i + 100], Y[rank::2][i : i + 100]) for i in range(0, ROWS // 2, 100)])
        ),
        "group": StreamedMKCRegression(**arguments).fit(
            from_memmap(X, Y, shard=(rank, 2)), group=dist.new_group([0, 1])
        ),
        "checkpoint": StreamedMKCRegression(**arguments).fit(
            from_memmap(X, Y, shard=(rank, 2)), checkpoint=f"{folder}/fit.pt"
        ),
    }
    torch.save({name: fitted(fit) for name, fit in results.items()}, f"{folder}/{rank}.pt")
    assert Path(folder, "fit.pt").exists()
    again = StreamedMKCRegression(**arguments).fit(from_memmap(X, Y, shard=(rank, 2)), checkpoint=f"{folder}/fit.pt")
    assert torch.equal(again.coef_, results["checkpoint"].coef_)
    assert again.n_iter_ == results["checkpoint"].n_iter_
    _check_errors_of_fits(rank)


def _check_errors_of_fits(rank):
    """An error on a rank raises on both ranks, which can be used afterwards."""
    X, Y = table()
    bad = Y.copy()
    bad[-3] = float("nan")
    fit = StreamedMKCRegression(pilot=300)
    message = "Rank 1 failed.*`Y` .*finite" if rank == 0 else "finite"
    with pytest.raises(RanksError if rank == 0 else ValueError, match=message):
        fit.fit(from_memmap(X, bad, shard=(rank, 2)))
    with pytest.raises(ValueError if rank == 0 else RanksError, match=r"every rank.*same columns"):
        fit.fit(from_memmap(X if rank == 0 else X[:, :2], Y, shard=(rank, 2)))
    with pytest.raises(RanksError if rank == 0 else TypeError, match="can be read once"):
        fit.fit(iter([(X, Y)]) if rank == 1 else [(X, Y)])


def _check_errors_of_ranks(rank, folder):
    ranks = Ranks()

    def work():
        if rank == 1:
            raise KeyError("lost")
        return torch.ones(2).double()

    for call in (lambda: ranks.sum_of(work, 2), lambda: ranks.gathered(work)):
        with pytest.raises(RanksError if rank == 0 else KeyError, match="lost"):
            call()
    ranks_of = Ranks(dist.new_group([1, 0]))

    def first():
        raise KeyError("lost")

    with pytest.raises(KeyError if ranks_of.rank == 0 else RanksError, match="lost"):
        ranks_of.from_first(first)
    assert ranks.sum_of(lambda: torch.tensor([rank + 1.0, 1.0]).double(), 2).tolist() == [3.0, 2.0]
    assert ranks.gathered(lambda: rank) == [0, 1]
    assert ranks.from_first(lambda: f"of {rank}") == "of 0"
    assert folder


@pytest.mark.process
def test_fits_on_two_ranks_equal_a_fit_on_one(tmp_path):
    assert run_ranks(_fit_on_rank, tmp_path) == [0, 0]
    reference, other = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    for name, fields in reference.items():
        assert all(torch.equal(value, other[name][field]) for field, value in fields.items()), name
    X, Y = table()
    alone = fitted(StreamedMKCRegression(pilot=300).fit(from_memmap(X, Y)))
    given = fitted(StreamedMKCRegression(pilot=300, bound=30.0).fit(from_memmap(X, Y)))
    for name, fields in reference.items():
        for field in FIELDS[:-1]:
            expected = (given if name == "uncounted" else alone)[field]
            # the covariance is that of the last pass, which other blocks leave at another place near the maximum
            near = 1e-7 if field == "covariance_" else 1e-8
            close = float(expected.abs().max()) * near if expected.numel() else 0.0
            torch.testing.assert_close(fields[field], expected, rtol=1e-8, atol=close, msg=f"{name} {field}")


@pytest.mark.process
def test_an_error_on_a_rank_is_raised_on_all_ranks_of_its_group(tmp_path):
    assert run_ranks(_check_errors_of_ranks, tmp_path) == [0, 0]


class KilledBatches:
    """Batches whose process is killed in the third pass."""

    def __init__(self, batches):
        self.batches, self.passes = batches, 0

    def __iter__(self):
        self.passes += 1
        for number, batch in enumerate(self.batches):
            if self.passes == 3 and number == 1:
                os.kill(os.getpid(), signal.SIGKILL)
            yield batch


def _fit_killed_batches(rank, folder):
    X, Y = table()
    batches = from_memmap(X, Y, rows=100, shard=(rank, dist.get_world_size()))
    last = dist.get_world_size() - 1
    begin = time.monotonic()
    try:
        StreamedMKCRegression(pilot=300).fit(KilledBatches(batches) if rank == last else batches)
    except RanksError as error:
        Path(folder, str(rank)).write_text(f"{time.monotonic() - begin} {error}", encoding="utf-8")
        os._exit(7)


@pytest.mark.process
@pytest.mark.parametrize("ranks", [2, 3])
def test_a_killed_rank_raises_an_error_on_all_ranks(ranks, tmp_path):
    assert run_ranks(_fit_killed_batches, tmp_path, ranks) == [7] * (ranks - 1) + [-signal.SIGKILL]
    for rank in range(ranks - 1):
        seconds, _, message = (tmp_path / str(rank)).read_text(encoding="utf-8").partition(" ")
        assert float(seconds) < 30
        assert message.startswith("Another process of the group is gone")


def test_a_group_without_this_process_is_refused(monkeypatch):
    monkeypatch.setattr(dist, "get_world_size", lambda _: 2)
    monkeypatch.setattr(dist, "get_rank", lambda _: -1)
    with pytest.raises(ValueError, match="`group` to contain this process"):
        Ranks(object())

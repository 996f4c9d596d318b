"""The recipes of docs/large_data.md: what needs no further package is run, the rest is compiled."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import distributed as dist

from mkc_torch.linear.streaming import StreamedMKCRegression, from_memmap
from tests.docs.pages import ROOT, blocks
from tests.linear.test_streaming import problem
from tests.linear.test_streaming_ranks import run_ranks

PAGE = ROOT / "docs" / "large_data.md"


def table() -> np.ndarray:
    X, Y = problem(0, N=4000)
    return torch.cat([X, Y[:, None]], 1).float().numpy()


def fit_part_text() -> str:
    return next(block.text for block in blocks(PAGE) if block.text.startswith("# fit_part.py\n"))


def test_recipes_for_other_packages_compile():
    needs = [block.needs for block in blocks(PAGE) if block.needs is not None]
    assert set(needs) == {"pyspark", "ray", "distributed", "duckdb"}
    for block in blocks(PAGE):
        if block.needs is not None:
            compile(block.text, str(PAGE), "exec")


def _fit_part_on_rank(rank: int, folder: str) -> None:
    sys.path.insert(0, folder)
    from fit_part import fit_part

    torch.save(fit_part(f"{folder}/table.npy"), f"{folder}/{rank}.pt")
    assert dist.get_world_size() == 2


@pytest.mark.process
def test_the_recipe_on_two_ranks_equals_a_fit_of_all_rows(tmp_path: Path):
    (tmp_path / "fit_part.py").write_text(fit_part_text(), encoding="utf-8")
    np.save(tmp_path / "table.npy", table())
    assert run_ranks(_fit_part_on_rank, tmp_path) == [0, 0]
    mine, other = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    assert mine == other
    alone = StreamedMKCRegression().fit(from_memmap(table()[:, :3], table()[:, 3]))
    assert mine["rows"] == 4000
    assert mine["coef"] == pytest.approx(alone.coef_.tolist(), abs=1e-8)


def test_a_function_that_yields_batches_is_called_in_every_pass():
    rows, calls = table(), []

    def batches():
        calls.append(1)
        for part in np.array_split(rows, 7):
            yield part[:, :3], part[:, 3]

    fit = StreamedMKCRegression(pilot=500).fit(batches)
    assert len(calls) == fit.n_iter_
    again = StreamedMKCRegression(pilot=500).fit([(rows[:, :3], rows[:, 3])])
    torch.testing.assert_close(fit.coef_, again.coef_, rtol=1e-8, atol=0.0)

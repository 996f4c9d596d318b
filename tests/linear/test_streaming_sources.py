"""Tables on disk: the same results from a memmap, from Parquet and from tensors; shares of ranks; refusals."""

import builtins
import sys

import numpy as np
import pytest
import torch

from mkc_torch.linear.streaming import StreamedMKCRegression, from_memmap, from_parquet
from tests.linear.test_streaming import problem, split_into_batches

ROWS = 1000


@pytest.fixture
def table(tmp_path):
    """A file of float32 with three columns of X and one of Y, opened from disk."""
    X, Y = problem(0, N=ROWS)
    np.save(tmp_path / "table.npy", torch.cat([X, Y[:, None]], 1).float().numpy())
    return np.load(tmp_path / "table.npy", mmap_mode="r")


@pytest.fixture
def parquet(table, tmp_path):
    """The same table as two Parquet files of several row groups each."""
    pa = pytest.importorskip("pyarrow")
    from pyarrow.parquet import write_table

    whole = pa.table({name: table[:, i] for i, name in enumerate("abcy")} | {"w": np.linspace(0.5, 1.5, ROWS)})
    paths = [tmp_path / "first.parquet", tmp_path / "second.parquet"]
    write_table(whole.slice(0, 600), paths[0], row_group_size=250)
    write_table(whole.slice(600), paths[1], row_group_size=300)
    return paths


def coefficients(batches, **arguments):
    return StreamedMKCRegression(pilot=100, **arguments).fit(batches).coef_


def test_fits_from_disk_equal_fits_in_memory(table, parquet):
    rows = torch.from_numpy(table.copy())
    tensors = coefficients(split_into_batches(rows[:, :3], rows[:, 3]))
    memmap = coefficients(from_memmap(table[:, :3], table[:, 3], rows=333))
    files = from_parquet(parquet, ["a", "b", "c"], "y", rows=100)
    torch.testing.assert_close(memmap, tensors, rtol=1e-10, atol=0)
    torch.testing.assert_close(coefficients(files), tensors, rtol=1e-10, atol=0)
    assert files.rows == ROWS


def test_weights_and_channels_are_read_from_disk(table, parquet):
    rows = torch.from_numpy(table.copy()).double()
    weight = torch.linspace(0.5, 1.5, ROWS).double()
    tensors = coefficients(split_into_batches(rows[:, :3], rows[:, 3], weight))
    memmap = coefficients(from_memmap(table[:, :3], table[:, 3], np.linspace(0.5, 1.5, ROWS)))
    files = coefficients(from_parquet(parquet, ["a", "b", "c"], "y", weight="w"))
    torch.testing.assert_close(memmap, tensors, rtol=1e-6, atol=0)
    torch.testing.assert_close(files, tensors, rtol=1e-6, atol=0)
    channels = from_parquet(parquet, [["a", "b"], ["c", "a"]], ["y", "b"])
    X, Y = next(iter(channels))
    assert X.shape == (250, 2, 2)
    assert (X[:, 1] == table[:250, [2, 0]]).all()
    assert (table[:250, [3, 1]] == Y).all()


def test_columns_have_the_names_of_the_file(parquet):
    fit = StreamedMKCRegression().fit(from_parquet(parquet[0], ["a", "b", "c"], "y"))
    assert fit.feature_names_in_ == ("a", "b", "c")
    assert [row.name for row in fit.summary().coefficients] == ["a", "b", "c"]


@pytest.mark.parametrize("ranks", [1, 3, 7])
def test_shards_partition_the_rows_in_order(ranks, table, parquet):
    for make in (
        lambda shard: from_memmap(table[:, :3], table[:, 3], rows=70, shard=shard),
        lambda shard: from_parquet(parquet, ["a", "b", "c"], "y", shard=shard),
    ):
        parts = [make((rank, ranks)) for rank in range(ranks)]
        assert sum(part.rows for part in parts) == ROWS
        assert [part.first for part in parts] == list(np.cumsum([0, *(part.rows for part in parts[:-1])]))
        found = np.concatenate([X for part in parts for X, _ in part])
        assert (found == table[:, :3]).all()


def test_missing_values_and_bad_columns_of_parquet_are_refused(tmp_path):
    pa = pytest.importorskip("pyarrow")
    from pyarrow.parquet import write_table

    gap = pa.table({"a": [1.0, 2.0, None, 4.0], "y": [1, 2, 3, 5], "name": list("wxyz")})
    write_table(gap, tmp_path / "gap.parquet")
    with pytest.raises(ValueError, match=r"`X` .*finite.* got nan in row 2 of batch 0"):
        StreamedMKCRegression().fit(from_parquet(tmp_path / "gap.parquet", ["a"], "y"))
    with pytest.raises(TypeError, match=r"column `name` .*real numbers.* got string"):
        from_parquet(tmp_path / "gap.parquet", ["name"], "y")
    with pytest.raises(ValueError, match=r"column `b` .*got `a`, `y`, `name`"):
        from_parquet(tmp_path / "gap.parquet", ["b"], "y")


def test_missing_and_damaged_files_are_refused(tmp_path):
    pytest.importorskip("pyarrow")
    (tmp_path / "text.parquet").write_text("no table")
    with pytest.raises(ValueError, match="is not a Parquet file"):
        from_parquet(tmp_path / "text.parquet", ["a"], "y")
    with pytest.raises(FileNotFoundError):
        from_parquet(tmp_path / "absent.parquet", ["a"], "y")


def test_bad_column_arguments_are_refused(tmp_path):
    path = tmp_path / "table.parquet"
    with pytest.raises(TypeError, match=r"write \('a',\)"):
        from_parquet(path, "a", "y")
    with pytest.raises(TypeError, match=r"names .*1 targets"):
        from_parquet(path, ["a"], ["y"])
    with pytest.raises(ValueError, match="2 lists of equal length"):
        from_parquet(path, [["a"], ["a", "b"]], ["y", "z"])
    with pytest.raises(ValueError, match="at least one column"):
        from_parquet(path, [], "y")


def test_without_pyarrow_the_extra_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name.startswith("pyarrow"):
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    for name in [name for name in sys.modules if name.startswith("pyarrow")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(ImportError, match=r"mkc-torch\[parquet\]"):
        from_parquet(tmp_path / "table.parquet", ["a"], "y")


def test_bad_array_arguments_are_refused(table):
    with pytest.raises(TypeError, match=r"`Y` .*NumPy array.*memmap"):
        from_memmap(table, torch.ones(3))
    with pytest.raises(ValueError, match=r"`Y` .*rows.*`X`, 1000, .*got 999"):
        from_memmap(table[:, :3], table[1:, 3])
    with pytest.raises(ValueError, match="`rows`"):
        from_memmap(table[:, :3], table[:, 3], rows=0)
    for shard in ((2, 2), (0.0, 1), 3):
        with pytest.raises(ValueError, match="`shard` to be"):
            from_memmap(table[:, :3], table[:, 3], shard=shard)

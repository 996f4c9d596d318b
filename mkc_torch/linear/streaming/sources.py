"""Tables on disk as batches that are read again in every pass: memory-mapped arrays, and Parquet by row groups."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mkc_torch._support.arguments import checked_whole, format_value, refuse_text

if TYPE_CHECKING:
    from jaxtyping import Shaped

_ROWS = 65_536
"""Default number of rows of a batch: half a megabyte per float64 column."""


class MemmapBatches:
    """Batches of arrays on disk or in memory; see :func:`from_memmap`.

    Attributes:
        rows: number of rows of all batches.
        first: index of their first row in the arrays.

    Example:
        >>> batches = MemmapBatches(np.ones((5, 2)), np.ones(5), rows=4)
        >>> [len(X) for X, Y in batches], batches.rows
        ([4, 1], 5)
    """

    def __init__(
        self,
        X: Shaped[np.ndarray, N * rest],
        Y: Shaped[np.ndarray, N * channels],
        weight: Shaped[np.ndarray, N * channels] | None = None,
        *,
        rows: int = _ROWS,
        shard: tuple[int, int] | None = None,
    ) -> None:
        self._arrays = [X, Y] if weight is None else [X, Y, weight]
        for name, array in zip(("X", "Y", "weight"), self._arrays, strict=False):
            if not isinstance(array, np.ndarray) or array.ndim == 0:
                raise TypeError(
                    f"Expected argument `{name}` to be a NumPy array or memmap but got {format_value(array)}; "
                    "np.load(path, mmap_mode='r') opens one on disk."
                )
            if len(array) != len(X):
                raise ValueError(
                    f"Expected argument `{name}` of as many rows as `X`, {len(X)}, but got {len(array)}; pass one row "
                    "for each sample."
                )
        self._step = checked_whole("rows", rows, 1, "65536 is usual")
        self.first, end = _share(len(X), shard)
        self.rows = end - self.first

    def __iter__(self) -> Iterator[tuple[np.ndarray, ...]]:
        end = self.first + self.rows
        for first in range(self.first, end, self._step):
            yield tuple(array[first : min(first + self._step, end)] for array in self._arrays)


def from_memmap(
    X: Shaped[np.ndarray, N * rest],
    Y: Shaped[np.ndarray, N * channels],
    weight: Shaped[np.ndarray, N * channels] | None = None,
    *,
    rows: int = _ROWS,
    shard: tuple[int, int] | None = None,
) -> MemmapBatches:
    """Return batches of arrays on disk, read again in every pass.

    Split a table in one file into X and Y by columns, ``from_memmap(table[:, :8], table[:, 8])``: adjacent columns are
    read together.

    Args:
        X: (N, n), or (N, m, n) for m channels; ``np.memmap``, ``np.load(path, mmap_mode="r")``, or an array.
        Y: (N,), or (N, m).
        weight: (N,) or (N, m), non-negative.
        rows: number of rows of a batch.
        shard: (rank, ranks) takes a rank's contiguous share of the rows; None takes all.

    Raises:
        TypeError: not a NumPy array.
        ValueError: different numbers of rows, or no such shard.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from mkc_torch.linear.streaming import StreamedMKCRegression
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     table = np.random.default_rng(0).standard_normal((1000, 3), dtype=np.float32)
        ...     table[:, 2] = 0.1 * table[:, 2] + table[:, 0] - table[:, 1]
        ...     np.save(Path(folder) / "table.npy", table)
        ...     table = np.load(Path(folder) / "table.npy", mmap_mode="r")
        ...     StreamedMKCRegression().fit(from_memmap(table[:, :2], table[:, 2])).coef_.round(decimals=2)
        tensor([ 1., -1.], dtype=torch.float64)
    """
    return MemmapBatches(X, Y, weight, rows=rows, shard=shard)


class ParquetBatches:
    """Batches of Parquet files, row group by row group; see :func:`from_parquet`.

    Attributes:
        rows: number of rows of all batches.
        first: index of their first row in the files.
        column_names: column names of X.

    Example:
        >>> import tempfile, pyarrow
        >>> from pyarrow.parquet import write_table
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     table = pyarrow.table({"a": [1.0, 2.0, 3.0], "b": [2.0, 4.0, 6.0]})
        ...     write_table(table, f"{folder}/table.parquet", row_group_size=2)
        ...     [len(X) for X, Y in ParquetBatches(f"{folder}/table.parquet", ["a"], "b")]
        [2, 1]
    """

    def __init__(
        self,
        path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
        inputs: Sequence[str] | Sequence[Sequence[str]],
        targets: str | Sequence[str],
        *,
        weight: str | None = None,
        rows: int = _ROWS,
        shard: tuple[int, int] | None = None,
    ) -> None:
        self._paths = [path] if isinstance(path, (str, os.PathLike)) else list(path)
        self._inputs, self._targets, self._weight = _checked_columns(inputs, targets), targets, weight
        self._step = checked_whole("rows", rows, 1, "65536 is usual")
        named = [name for channel in self._inputs for name in channel]
        named += [targets] if isinstance(targets, str) else list(targets)
        self._columns = list(dict.fromkeys([*named, weight] if weight is not None else named))
        self.column_names = tuple(self._inputs[0]) if isinstance(targets, str) else None
        groups = [(at, group, count) for at, path in enumerate(self._paths) for group, count in self._groups(path)]
        start, end = _share(len(groups), shard)
        self._mine = groups[start:end]
        self.first = sum(count for _, _, count in groups[:start])
        self.rows = sum(count for _, _, count in self._mine)

    def _groups(self, path: str | os.PathLike[str]) -> list[tuple[int, int]]:
        """Index and number of rows of each row group of a file."""
        with _opened(path) as file:
            arrow = _pyarrow()
            for name in self._columns:
                if name not in file.schema_arrow.names:
                    known = ", ".join(f"`{column}`" for column in file.schema_arrow.names)
                    raise ValueError(f"Expected {path} to have a column `{name}` but got {known}; use a listed name.")
                kind = file.schema_arrow.field(name).type
                if not (arrow.types.is_integer(kind) or arrow.types.is_floating(kind) or arrow.types.is_boolean(kind)):
                    raise TypeError(f"Expected column `{name}` of {path} to hold real numbers but got {kind}.")
            return [(i, file.metadata.row_group(i).num_rows) for i in range(file.num_row_groups)]

    def __iter__(self) -> Iterator[tuple[np.ndarray, ...]]:
        for at, path in enumerate(self._paths):
            groups = [group for where, group, _ in self._mine if where == at]
            if groups:
                with _opened(path) as file:
                    for group in groups:
                        for part in file.iter_batches(self._step, row_groups=[group], columns=self._columns):
                            yield self._arrays(part)

    def _arrays(self, part: Any) -> tuple[np.ndarray, ...]:
        # a missing value is NaN, which the fit reports by batch and row
        found = {name: part.column(name).to_numpy(zero_copy_only=False) for name in self._columns}
        found = {
            name: array if array.dtype == np.float32 else array.astype(np.float64) for name, array in found.items()
        }
        channels = [np.stack([found[name] for name in names], axis=-1) for names in self._inputs]
        if isinstance(self._targets, str):
            arrays = [channels[0], found[self._targets]]
        else:
            arrays = [np.stack(channels, axis=1), np.stack([found[name] for name in self._targets], axis=-1)]
        return (*arrays, found[self._weight]) if self._weight is not None else tuple(arrays)


def from_parquet(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    inputs: Sequence[str] | Sequence[Sequence[str]],
    targets: str | Sequence[str],
    *,
    weight: str | None = None,
    rows: int = _ROWS,
    shard: tuple[int, int] | None = None,
) -> ParquetBatches:
    """Return batches of Parquet files; one batch at a time is in memory.

    Args:
        path: path of a file, or of several files with the same columns.
        inputs: column names of X; for m channels a list of names for each channel.
        targets: column name of Y; for m channels a list of m names.
        weight: column name of the weights.
        rows: largest number of rows of a batch; a batch also ends with its row group.
        shard: (rank, ranks) takes a rank's contiguous share of the row groups; None takes all.

    Raises:
        ImportError: pyarrow is not installed.
        FileNotFoundError, ValueError, TypeError: no such file, not a Parquet file, no such columns, columns that are
            not numeric, or no such shard.

    Example:
        >>> import tempfile, pyarrow
        >>> from pyarrow.parquet import write_table
        >>> from mkc_torch.linear.streaming import StreamedMKCRegression
        >>> speed = np.arange(100.0)
        >>> drag = 2.0 * speed + np.sin(speed)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_table(pyarrow.table({"speed": speed, "drag": drag}), f"{folder}/table.parquet")
        ...     StreamedMKCRegression().fit(from_parquet(f"{folder}/table.parquet", ["speed"], "drag")).coef_
        tensor([1.9998], dtype=torch.float64)
    """
    return ParquetBatches(path, inputs, targets, weight=weight, rows=rows, shard=shard)


def _checked_columns(inputs: Any, targets: Any) -> list[list[str]]:
    """Column names of each channel."""
    if isinstance(targets, str):
        refuse_text("inputs", inputs, "a list of column names")
        channels = [list(inputs)]
    else:
        refuse_text("targets", targets, "a column name, or a list of column names")
        if isinstance(inputs, str) or not all(isinstance(names, (list, tuple)) for names in inputs):
            raise TypeError(
                f"Expected argument `inputs` to be a list of names for each of the {len(targets)} targets but got "
                f"{format_value(inputs)}; a single target is a name, targets={targets[0]!r}."
            )
        channels = [list(names) for names in inputs]
        if len(channels) != len(targets) or len({len(names) for names in channels}) > 1:
            raise ValueError(
                f"Expected argument `inputs` to be {len(targets)} lists of equal length, one for each target, but got "
                f"lengths {[len(names) for names in channels]}."
            )
    if not channels or not channels[0]:
        raise ValueError("Expected argument `inputs` to name at least one column but got none.")
    return channels


def _share(count: int, shard: tuple[int, int] | None) -> tuple[int, int]:
    """First and end index of a rank's contiguous share of ``count`` items."""
    if shard is None:
        return 0, count
    good = isinstance(shard, (tuple, list)) and len(shard) == 2 and all(isinstance(number, int) for number in shard)
    if not good or not 0 <= shard[0] < shard[1]:
        raise ValueError(
            f"Expected argument `shard` to be (rank, ranks) with 0 <= rank < ranks but got {format_value(shard)}; pass "
            "(dist.get_rank(), dist.get_world_size())."
        )
    rank, ranks = shard
    return count * rank // ranks, count * (rank + 1) // ranks


def _pyarrow() -> Any:
    try:
        import pyarrow
    except ImportError as error:
        raise ImportError("Reading Parquet files needs pyarrow; run pip install 'mkc-torch[parquet]'.") from error
    return pyarrow


def _opened(path: str | os.PathLike[str]) -> Any:
    arrow = _pyarrow()
    from pyarrow.parquet import ParquetFile

    try:
        return ParquetFile(os.fspath(path), pre_buffer=False)
    except arrow.ArrowInvalid as error:
        raise ValueError(f"{path} is not a Parquet file, or is damaged: {str(error).splitlines()[0]}") from error

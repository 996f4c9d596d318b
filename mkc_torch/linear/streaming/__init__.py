"""Regression on more rows than memory holds, from batches that are read again in every pass, on one machine or many."""

from mkc_torch._support.ranks import RanksError
from mkc_torch.linear.streaming.regression import StreamChangedError, StreamedMKCRegression
from mkc_torch.linear.streaming.sources import MemmapBatches, ParquetBatches, from_memmap, from_parquet

__all__ = [
    "MemmapBatches",
    "ParquetBatches",
    "RanksError",
    "StreamChangedError",
    "StreamedMKCRegression",
    "from_memmap",
    "from_parquet",
]

"""Where the problems of a batch are computed side by side: everywhere but on a CPU.

On a CPU a few problems at a time stay in the cache, LAPACK factorises small matrices one after the other, and a value
is read at no cost. A GPU wants all problems in every operation, and waits whenever the host reads a value. Every choice
between the two is made here.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch import Tensor

_STEPS = 4
"""Iterations between two tests of convergence off the CPU."""

_TEMPORARIES = 10
"""Copies of the largest tensor that a computation holds at once."""

_MEMORY = 1 << 30
"""Bytes to work in on a device whose free memory is unknown, and where the choice is forced."""

_ELEMENTS = 1 << 30
"""Most elements of one tensor: some kernels count in 32 bits."""

_forced = False


def side_by_side(tensor: Tensor) -> bool:
    """Whether problems on the device of ``tensor`` are computed side by side."""
    return _forced or tensor.device.type != "cpu"


@contextlib.contextmanager
def forced() -> Iterator[None]:
    """Compute side by side on the CPU too, for tests of that path."""
    global _forced
    before, _forced = _forced, True
    try:
        yield
    finally:
        _forced = before


def steps_between_tests(tensor: Tensor) -> int:
    """Iterations between two tests of convergence, each of which waits for the device: 1 on a CPU."""
    return _STEPS if side_by_side(tensor) else 1


def at_once(tensor: Tensor, values: int, on_cpu: int) -> int:
    """Number of items of ``values`` numbers each that are computed at once, at least 1.

    Args:
        tensor: a tensor of the dtype and on the device of the computation.
        values: numbers of one item in its largest tensor.
        on_cpu: numbers held at once on a CPU, so that they stay in its cache; elsewhere half of the free memory counts.
    """
    if not side_by_side(tensor):
        return max(1, on_cpu // values)
    numbers = _free_bytes(tensor.device) // (2 * _TEMPORARIES * 8)
    return max(1, min(numbers, _ELEMENTS) // values)


def _free_bytes(device: torch.device) -> int:
    if device.type != "cuda":
        return _MEMORY
    # as memory_reserved and memory_allocated, which take a millisecond to flatten all statistics
    statistics = torch.cuda.memory_stats_as_nested_dict(device)
    reserved, allocated = (
        statistics[name]["all"]["current"] if statistics else 0 for name in ("reserved_bytes", "allocated_bytes")
    )
    return torch.cuda.mem_get_info(device)[0] + reserved - allocated

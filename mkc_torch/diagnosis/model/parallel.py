"""Parallel work on a simulation, on all available cores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from mkc_torch._parallel.pool import shared
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.simulation.protocol import PreparedSimulation

__all__ = ["common_parts", "run_parallel"]

T = TypeVar("T")


def run_parallel(
    works: Sequence[Callable[[], T]], prepared: PreparedSimulation, terms: Sequence[Term] = (), thing: str = ""
) -> list[T]:
    """Return the results of functions, in their order.

    Args:
        works: independent functions.
        prepared, terms: a simulation and effects that results may hold.
        thing: name of the items that progress counts.
    """
    return shared(works, common_parts(prepared, terms), thing)


def common_parts(prepared: PreparedSimulation, terms: Sequence[Term]) -> list[object]:
    """Return the parts of a simulation and its effects that every process holds and that need not be sent."""
    return [prepared, *(part for term in terms for part in (term.effect, term.driver) if part is not None)]

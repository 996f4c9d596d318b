"""Works near a simulation, on all cores that may be used."""

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
    """The results of works, in their order.

    Args:
        works: none needs what another one leaves behind.
        prepared, terms: a simulation and effects that results may hold.
        thing: name of what each work is about, where progress counts them.
    """
    return shared(works, common_parts(prepared, terms), thing)


def common_parts(prepared: PreparedSimulation, terms: Sequence[Term]) -> list[object]:
    """What every process has of a simulation and its effects, and need not be sent."""
    return [prepared, *(part for term in terms for part in (term.effect, term.driver) if part is not None)]

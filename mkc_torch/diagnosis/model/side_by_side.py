"""Fits that need nothing of one another: each begins with what the simulation remembers; they may run side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from mkc_torch._parallel.fork import shared
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.simulation.protocol import PreparedSimulation, Remembering

__all__ = ["each", "ending_at_fit", "fitted_each", "known_of", "learn", "memory_kept", "with_memory"]

T = TypeVar("T")


def fitted_each(
    around: FittedModel, works: Sequence[Callable[[], FittedModel]], terms: Sequence[Term]
) -> list[FittedModel]:
    """:func:`each` for fits with one of these effects more, or one that differs in its shape alone."""

    return each(around, [ending_at_fit(work) for work in works], terms)


def ending_at_fit(work: Callable[[], FittedModel]) -> Callable[[], FittedModel]:
    """The same work; in its end the fit is the newest that a simulation remembers."""

    def found() -> FittedModel:
        fit = work()
        fit.model.residual(fit.parameters)
        return fit

    return found


def each(around: FittedModel, works: Sequence[Callable[[], T]], terms: Sequence[Term] = ()) -> list[T]:
    """The results of works near a fit, on all cores that may be used.

    A simulation that remembers begins each of them with what it gave for that fit, and in the end also knows the last
    answer of each.
    """
    prepared = around.model.prepared
    around.model.residual(around.parameters)
    known = known_of(prepared, (*around.model.terms, *terms))
    results = shared([with_memory(prepared, work) for work in works], known)
    for _, newest in results:
        learn(prepared, newest)
    return [result for result, _ in results]


def known_of(prepared: PreparedSimulation, terms: Sequence[Term]) -> list[object]:
    """What every process has of a simulation and its effects."""
    return [prepared, *(part for term in terms for part in (term.effect, term.driver) if part is not None)]


@contextmanager
def memory_kept(prepared: PreparedSimulation) -> Iterator[None]:
    """Afterwards the simulation remembers what it did before."""
    if not isinstance(prepared, Remembering):
        yield
        return
    known = prepared.memory
    try:
        yield
    finally:
        prepared.memory = known


def with_memory(prepared: PreparedSimulation, work: Callable[[], T]) -> Callable[[], tuple[T, Any]]:
    """Work that leaves the simulation's memory as it was, and gives the newest of its own beside the result."""

    def kept() -> tuple[T, Any]:
        with memory_kept(prepared):
            return work(), prepared.newest if isinstance(prepared, Remembering) else None

    return kept


def learn(prepared: PreparedSimulation, newest: Any) -> None:
    """Add what other work left in the memory of a simulation, if it has one."""
    if isinstance(prepared, Remembering):
        prepared.learn(newest)

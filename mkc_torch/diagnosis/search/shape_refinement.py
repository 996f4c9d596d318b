"""Refinement of the continuous numbers of an effect's shape between the points of the grid."""

from __future__ import annotations

from collections.abc import Sequence

from mkc_torch.diagnosis.model.fit import FittedModel, fitted_with_effect
from mkc_torch.diagnosis.model.grid import finer
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term, continuous
from mkc_torch.diagnosis.search.linearized import LinearizedSearch
from mkc_torch.functional import mkc_energy

__all__ = ["middle", "refine_candidates", "refined", "with_spectrum"]

_ROUNDS = 3
"""Rounds of narrowing the range of a shape number."""


def refined(best: FittedModel, base: FittedModel, *, again: bool = False) -> FittedModel:
    """Return the fit with its continuous shape numbers refined one by one.

    Args:
        best: the fit.
        base: the fit without its last effect.
        again: repeat from there, with the sizes fitted to the new shape.
    """
    term = best.model.terms[-1]
    names = continuous(term)
    if not names:
        return best
    for count in range(_ROUNDS):
        for name in names:
            shapes = finer(term, name, base.model.prepared.time, count)
            value = [_energy(best, best.model.with_last(shape)) for shape in shapes]
            term = shapes[min(range(len(shapes)), key=value.__getitem__)]
    moved = fitted_with_effect(base, best.model.with_last(term), best.parameters, graduate=False)
    if not moved.log_likelihood > best.log_likelihood:
        return best
    return refined(moved, base) if again else moved


def refine_candidates(terms: Sequence[Term], look: LinearizedSearch) -> tuple[Term, ...]:
    """Return candidates with their continuous shape numbers refined under the noise of the search.

    Only at pointwise ports: elsewhere each shape needs a new trajectory.
    """
    refine_candidates = []
    for term in terms:
        names = continuous(term)
        if not names or look.scene.is_nonlinear(term):
            continue
        found = term
        for count in range(_ROUNDS):
            for name in names:
                shapes = finer(found, name, look.scene.base.model.prepared.time, count)
                found = shapes[int(look.gains_of(shapes).ratio[:, 0].argmax())]
        if found.shape != term.shape:
            refine_candidates.append(found)
    return tuple(refine_candidates)


def with_spectrum(best: FittedModel, look: LinearizedSearch) -> FittedModel:
    """Return the fit with the shape that is most likely under the noise of the search; a joint fit assumes white noise.

    Another shape is taken if it is clearly better; otherwise the middle of the equivalent shapes, such as all onsets
    within a burst of rejected samples.
    """
    own, base, naming = best.model.terms[-1], look.scene.base, look.settings.naming
    names = continuous(own)
    if not names or look.scene.is_nonlinear(own):
        return best

    def gains(terms: Sequence[Term]) -> list[float]:
        return look.gains_of(terms).ratio[:, 0].tolist()

    others = refine_candidates([own], look)
    here, *there = gains([own, *others])
    if there and there[0] > here + naming.shape_clear:
        moved = others[0]
    else:
        moved = own
        for name in names * _ROUNDS:
            shapes = finer(moved, name, base.model.prepared.time, 1)
            place = [shape.shape for shape in shapes].index(moved.shape)
            moved = shapes[middle(gains(shapes), place, naming.shape_alike)]
    if moved.shape == own.shape:
        return best
    fit = fitted_with_effect(base, best.model.with_shape(moved.shape), best.parameters, graduate=False)
    return fit if fit.converged else best


def middle(values: Sequence[float], place: int, alike: float) -> int:
    """Return the middle of the neighbours of a place whose values differ from it by less than ``alike``.

    Example:
        >>> middle([1.0, 7.0, 7.2, 7.1, 7.0, 7.2, 2.0, 7.2], 1, 0.5)
        3
    """
    first = last = place
    while first > 0 and abs(values[first - 1] - values[place]) < alike:
        first -= 1
    while last < len(values) - 1 and abs(values[last + 1] - values[place]) < alike:
        last += 1
    return (first + last) // 2


def _energy(fit: FittedModel, model: JointModel) -> float:
    """Return the energy of another shape, at the same parameters."""
    return float(mkc_energy(model.residual(fit.parameters), fit.sigma, fit.d).sum())

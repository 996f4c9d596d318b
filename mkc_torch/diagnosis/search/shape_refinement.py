"""The continuous numbers of an effect's shape, closed in on beyond the grid that is searched."""

from __future__ import annotations

from collections.abc import Sequence

from mkc_torch.diagnosis.model.fit import FittedModel, fitted_beside
from mkc_torch.diagnosis.model.grid import finer
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term, continuous
from mkc_torch.diagnosis.search.linearized import LinearizedSearch
from mkc_torch.functional import mkc_energy

__all__ = ["middle", "refine_candidates", "refined", "with_spectrum"]

_ROUNDS = 3
"""Times that the range about a shape's number is narrowed."""


def refined(best: FittedModel, base: FittedModel, *, again: bool = False) -> FittedModel:
    """The fit with the likeliest values of its shape's continuous numbers, closed in on one by one.

    Args:
        best: the fit.
        base: what it is beside.
        again: once more from there, with the amplitudes that fit the new shape.
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
    moved = fitted_beside(base, best.model.with_last(term), best.parameters, graduate=False)
    if not moved.log_likelihood > best.log_likelihood:
        return best
    return refined(moved, base) if again else moved


def refine_candidates(terms: Sequence[Term], look: LinearizedSearch) -> tuple[Term, ...]:
    """Candidates with the continuous numbers of their shapes closed in on under the noise of the search.

    Only where a port is pointwise: elsewhere each shape takes a trajectory of its own.
    """
    refine_candidates = []
    for term in terms:
        names = continuous(term)
        if not names or look.scene.bends(term):
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
    """The fit with the shape that the noise of the search makes of its own: a joint fit takes the noise for white.

    That is another one where it is clearly better, else the middle one of those that are not told apart, as all onsets
    within a burst of rejected samples are.
    """
    own, base, naming = best.model.terms[-1], look.scene.base, look.settings.naming
    names = continuous(own)
    if not names or look.scene.bends(own):
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
    fit = fitted_beside(base, best.model.with_shape(moved.shape), best.parameters, graduate=False)
    return fit if fit.converged else best


def middle(values: Sequence[float], place: int, alike: float) -> int:
    """The middle one of the neighbours of a place that are not told apart from it, alike within some nats.

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
    """Of another shape, at the same parameters."""
    return float(mkc_energy(model.residual(fit.parameters), fit.sigma, fit.d).sum())

"""The continuous numbers of an effect's shape, closed in on beyond the grid that is searched."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.diagnosis.candidates import finer
from mkc_torch.diagnosis.linearise import Linearised, Tangents, candidate_tangents
from mkc_torch.diagnosis.model import JointModel, Term
from mkc_torch.diagnosis.refit import FittedModel, fitted_beside, repeats
from mkc_torch.effects.protocol import ContinuousEffect
from mkc_torch.functional import mkc_energy

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["closer", "continuous", "refined"]

_ROUNDS = 3


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
            value = [_energy(best, base.model.with_term(shape)) for shape in shapes]
            term = shapes[min(range(len(shapes)), key=value.__getitem__)]
    moved = fitted_beside(base, base.model.with_term(term), best.parameters, graduate=False)
    if not (moved.log_likelihood > best.log_likelihood and repeats(moved)):
        return best
    return refined(moved, base) if again else moved


def closer(
    terms: Sequence[Term],
    model: JointModel,
    parameters: Tensor,
    tangents: Tangents,
    counts: Float[Tensor, "N m"],
    linearised: Linearised,
) -> tuple[Term, ...]:
    """Candidates with the continuous numbers of their shapes closed in on under the noise of the search.

    Only where a port is pointwise: elsewhere each shape takes a trajectory of its own.
    """
    closer = []
    for term in terms:
        names = continuous(term)
        if not names or tangents.pointwise[term.port] is None:
            continue
        found = term
        for count in range(_ROUNDS):
            for name in names:
                shapes = finer(found, name, model.prepared.time, count)
                gains = linearised.gains_of(candidate_tangents(model, parameters, shapes, tangents.pointwise), counts)
                found = shapes[int(gains.ratio[:, 0].argmax())]
        if found.shape != term.shape:
            closer.append(found)
    return tuple(closer)


def continuous(term: Term) -> list[str]:
    free = term.effect.continuous if isinstance(term.effect, ContinuousEffect) else {}
    return [name for name in term.shape if name in free]


def _energy(fit: FittedModel, model: JointModel) -> float:
    """Of another shape, at the same parameters."""
    return float(mkc_energy(model.residual(fit.parameters), fit.sigma, fit.d).sum())

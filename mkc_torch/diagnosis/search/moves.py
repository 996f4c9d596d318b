"""Moves of the search from one set of effects to the next, proposed by the linearised model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.shapes import reach_of, within_a_sample
from mkc_torch.diagnosis.model.term import Key, Term
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.effects.per_recording import PerRecording, is_relative
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

_LONGEST = 3.0
"""Recording over the longest lag or delay tried."""

_RATIO = 2.0
"""Ratio of neighbouring lags and delays."""

_OFFSET = 0.5
"""Ratio of a signal's lowest to its highest value above which it is far from 0 throughout."""

_SHARES = (0.2, 0.4, 0.6, 0.8)
"""Levels tried in such a signal, as shares of its range."""

_SPANNED = 1e-6
"""Share of a candidate's change that is not a change by parameters, below which it acts as they do."""

_BETTER = 1e-6
"""Nats by which a further form has to be worth more than the form to first order; forms of one tangent differ less."""

STARTS = 3
"""Shapes from which an effect is fitted: the best local maxima of its linear gain."""


@dataclass(frozen=True)
class Addition:
    """An effect to add: its shapes to start from with their linear sizes, best first, and its linear gain in nats."""

    starts: tuple[tuple[Term, Float[Tensor, " q"]], ...]
    gain: float

    @property
    def key(self) -> Key:
        """Identity of the effect without its shape."""
        return self.starts[0][0].key


def linear_gains(
    fit: FittedModel, terms: Sequence[Term], settings: NoiseSettings
) -> tuple[list[float], list[Float[Tensor, " q"]]]:
    """Return gains of candidates in the linearised model with white noise, and their sizes.

    Args:
        fit: the fit to linearise at.
        terms: candidates.
        settings: which samples count.

    Returns:
        Log-likelihood ratios in nats, 0 for a size whose sign the physics does not allow, minus infinity for a
        candidate that acts as the parameters do, such as a constant force next to a gravity; and the sizes.
    """
    tangents = tangents_of(fit.model, fit.parameters, settings, terms)
    values, counts = fit.pseudo(settings)
    weight = counts / fit.d
    y = (values * weight).flatten()
    nuisance = tangents.nuisance if fit.model.bounds is None else tangents.nuisance[..., _free(fit.model.bounds)]
    own = torch.linalg.qr((nuisance * weight.unsqueeze(-1)).flatten(0, 1))[0]
    y = y - own @ (own.mT @ y)
    power, samples = float(y.square().sum()), float(counts.sum())
    gains, sizes = [], []
    for term, columns in zip(terms, tangents.candidates, strict=True):
        moved = (columns * weight.unsqueeze(-1)).flatten(0, 1)
        before = moved.norm(dim=0)
        moved = moved - own @ (own.mT @ moved)
        scale = moved.norm(dim=0).clamp(min=1e-300)
        if bool(((scale < _SPANNED * before) & (before > 0.0)).all()):
            gains.append(-math.inf)
            sizes.append(torch.zeros_like(scale))
            continue
        size = -torch.linalg.lstsq(moved / scale, y.unsqueeze(-1), driver="gelsd").solution[:, 0] / scale
        within = size.clamp(term.effect.lower, term.effect.upper)
        left = float((y + moved @ within).square().sum())
        better = math.isfinite(left) and left < power
        gains.append(0.5 * samples * math.log(power / max(left, 1e-300)) if better else 0.0)
        sizes.append(within)
    return gains, sizes


def _free(bounds: tuple[Tensor, Tensor]) -> Tensor:
    """Mask of the parameters that are not held."""
    return bounds[0] < bounds[1]


def additions(fit: FittedModel, terms: Sequence[Term], settings: NoiseSettings) -> list[Addition]:
    """Return the effects that a model can add, by descending linear gain, each with its best shapes.

    The list is empty for a model whose residual has no finite derivative, as next to an unstable trajectory.

    Args:
        fit: the model.
        terms: candidates with the shapes of their grids; effects that the model has are left out, with a common size or
            a size of each recording, and those that act as the model's parameters do, which would only undo the bounds
            of these.
        settings: which samples count.
    """
    known = {term.family for term in fit.model.terms}
    terms = [term for term in terms if term.family not in known]
    if not terms:
        return []
    try:
        gains, sizes = linear_gains(fit, terms, settings)
    except NoFitError:
        return []
    groups: dict[Key, list[int]] = {}
    for number, term in enumerate(terms):
        groups.setdefault(term.key, []).append(number)
    found = []
    for numbers in groups.values():
        numbers = [n for n in numbers if gains[n] > -math.inf]
        if not numbers:
            continue
        best = local_maxima([terms[n] for n in numbers], [gains[n] for n in numbers])
        starts = tuple((terms[numbers[k]], sizes[numbers[k]]) for k in best)
        found.append(Addition(starts, max(gains[n] for n in numbers)))
    return sorted(found, key=lambda addition: -addition.gain)


def with_references(fit: FittedModel, terms: Sequence[Term], settings: NoiseSettings) -> tuple[Term, ...]:
    """Return candidates with sizes relative to the first recording where a parameter acts as a common size does.

    Args:
        fit: the simulation alone.
        terms: candidates with a common size and with a size for each recording.
        settings: which samples count.
    """
    families = {term.family for term in terms if term.effect.recordings}
    common = {term.family: term for term in terms if term.family in families and not term.effect.recordings}
    if not common:
        return tuple(terms)
    gains, _ = linear_gains(fit, list(common.values()), settings)
    same = {family for family, gain in zip(common, gains, strict=True) if gain == -math.inf}
    forms: dict[int, PerRecording] = {}
    for term in terms:
        if term.family in same and isinstance(own := term.effect, PerRecording):
            forms.setdefault(id(own), PerRecording(own.effect, own.recordings, own.of_run, relative=True))
    return tuple(
        replace(term, effect=forms[id(term.effect)]) if term.family in same and id(term.effect) in forms else term
        for term in terms
    )


def at_size_zero(fit: FittedModel, group: Sequence[Term]) -> Addition:
    """Return an effect to add from size 0, at the first shapes of its grid."""
    zero = fit.parameters.new_zeros(fit.model.with_term(group[0]).size - fit.model.size)
    return Addition(tuple((term, zero) for term in group[:STARTS]), 0.0)


def local_maxima(terms: Sequence[Term], gains: Sequence[float]) -> list[int]:
    """Return the places of the best local maxima of a gain over shapes, best first, at most :data:`STARTS`.

    Two shapes are neighbours if one number differs by a step of the grid.
    """
    names = sorted({name for term in terms for name in term.shape})
    grids = {name: sorted({float(term.shape[name]) for term in terms if name in term.shape}) for name in names}
    places = [
        tuple(grids[name].index(float(term.shape[name])) if name in term.shape else -1 for name in names)
        for term in terms
    ]
    chosen: list[int] = []
    for number in sorted(range(len(terms)), key=lambda n: -gains[n]):
        near = [n for n in chosen if sum(abs(a - b) for a, b in zip(places[n], places[number], strict=True)) <= 1]
        if not near and len(chosen) < STARTS:
            chosen.append(number)
    return chosen


def with_wide_grid(terms: Sequence[Term], prepared: PreparedSimulation) -> tuple[Term, ...]:
    """Return candidates with wider grids: of lags and delays, and of levels of a signal with an offset.

    Lags and delays go from a sample to a third of the longest run, in ratios of two. Levels that an effect states as
    shares of a signal's largest value are tried at shares of its range too, if the signal is far from 0 throughout.
    """
    found: list[Term] = []
    done: set[Key] = set()
    for term in terms:
        names = [name for name in term.effect.fitted_shape if name in term.effect.continuous and name in term.shape]
        if len(names) == 1 and len(term.shape) == 1:
            if term.key not in done:
                found += [replace(term, shape={names[0]: value}) for value in _lags(term, names[0], prepared)]
        else:
            if term.key not in done:
                found += [replace(term, shape={**term.shape, **shape}) for shape in _levels(term, prepared)]
            found.append(term)
        done.add(term.key)
    return tuple(term for term in found if not within_a_sample(term, prepared))


def _lags(term: Term, name: str, prepared: PreparedSimulation) -> Iterator[float]:
    """Yield the values of a lag or delay within its limits."""
    low, high = reach_of(term, prepared)[name]
    step = prepared.time.diff()
    value = max(float(step[step > 0].median()), low)
    most = min(_longest_run(prepared) / _LONGEST, high)
    while value <= most:
        yield value
        value *= _RATIO


def _levels(term: Term, prepared: PreparedSimulation) -> Iterator[dict[str, float]]:
    """Yield levels within the range of a signal that is far from 0 throughout."""
    effect, port = term.effect, prepared.ports[term.port]
    for name in effect.fitted_shape:
        part, which = effect.relative.get(name, ("", ""))
        sizes = port.sizes.get(part)
        if which != "largest" or sizes is None or not sizes.lowest > _OFFSET * sizes.highest > 0.0:
            continue
        low, high = reach_of(term, prepared)[name]
        values = [sizes.lowest + share * (sizes.highest - sizes.lowest) for share in _SHARES]
        yield from ({name: value} for value in values if low <= value <= high)


def _longest_run(prepared: PreparedSimulation) -> float:
    system = prepared.dynamics
    time = prepared.time
    if system is None:
        return float(time[-1] - time[0])
    first = system.begins.nonzero().squeeze(-1)
    last = torch.cat([first[1:] - 1, first.new_tensor([len(time) - 1])])
    return float((time[last] - time[first]).max())


def special_cases(term: Term, terms: Sequence[Term], prepared: PreparedSimulation) -> list[Term]:
    """Return the candidates that are a special case of an effect, or that it is one of, at the same channels.

    Each at the first shape of its grid. Of a dependence on a column also its other forms, which have the same special
    case. A common size is a special case of a size for each recording.
    """
    channels = prepared.ports[term.port].channels
    found: dict[Key, Term] = {}
    for other in terms:
        pair = (term.effect, other.effect), (other.effect, term.effect)
        nested = any(
            general.reduces_to is not None and general.reduces_to.id == special.id for general, special in pair
        )
        if comes_by_exchange(term) and comes_by_exchange(other) and other.effect.id != term.effect.id:
            nested = nested or _special_id(other) == _special_id(term)
        forms = other.family == term.family and other.key != term.key
        # relative to a parameter of the simulation, which acts as the common size does
        nested = nested or (forms and not (is_relative(term.effect) or is_relative(other.effect)))
        alike = other.columns == term.columns or not (other.columns and term.columns)
        if nested and prepared.ports[other.port].channels == channels and alike:
            found.setdefault(other.key, other)
    return list(found.values())


def _special_id(term: Term) -> str:
    return term.effect.reduces_to.id if term.effect.reduces_to is not None else ""


def comes_by_exchange(term: Term) -> bool:
    """Whether an effect is a further form of a dependence on a column, tried in exchange for its special case."""
    return term.driver is not None and term.effect.reduces_to is not None


def one_form_each(found: Sequence[Addition], worth: Callable[[Addition], float]) -> list[Addition]:
    """Return additions with one form of each effect: the first order of its dependence on a column, and a common size
    for all recordings, unless another form is worth more.

    Otherwise the forms of one effect would take the places of other effects. A further form whose special case is not
    among the additions comes only in exchange.

    Args:
        found: the additions.
        worth: the linear gain of an addition, less the price of its numbers.
    """
    families: dict[Key, list[Addition]] = {}
    for addition in found:
        term = addition.starts[0][0]
        special = term.effect.reduces_to if comes_by_exchange(term) else None
        families.setdefault((special.id if special else term.effect.id, *term.key[1:]), []).append(addition)
    chosen = []
    for key, members in families.items():
        first = [a for a in members if a.key == key] or [a for a in members if is_relative(a.starts[0][0].effect)]
        if first:
            best = max(members, key=worth)
            chosen.append(best if worth(best) > worth(first[0]) + _BETTER else first[0])
    return chosen


def in_other_orders(fit: FittedModel) -> list[tuple[Term, ...]]:
    """Return the effects with one static effect before or behind those with memory, where both are in series.

    A driver's dead zone comes before the lag of its motor, the square law of a propeller behind it.
    """
    terms, ports = fit.model.terms, fit.model.prepared.ports
    # a pure delay commutes with every static effect
    lagging = {term.port for term in terms if term.effect.remembers and "delay" not in term.shape}
    found = []
    for number, term in enumerate(terms):
        if not term.effect.remembers and term.port in lagging and ports[term.port].in_series(term.port):
            found.append((*terms[:number], replace(term, first=not term.first), *terms[number + 1 :]))
    return found

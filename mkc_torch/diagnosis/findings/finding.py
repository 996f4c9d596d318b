"""Findings: their sizes, curves and doubts, and how well they are separable from other candidates."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import ratio, sized, tidy
from mkc_torch.diagnosis.evidence.base import gain_of
from mkc_torch.diagnosis.findings.advice import SAME, distinguishing_state
from mkc_torch.diagnosis.findings.at_input import size_at_input
from mkc_torch.diagnosis.findings.curve import curve_of_effect, places_of
from mkc_torch.diagnosis.findings.regions import attributed, map_of, region_of, shares_of_runs
from mkc_torch.diagnosis.findings.shape import formulas
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.shapes import reach_of
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.result import Alternative, EffectParameter, Finding, Number, Reference, Separability
from mkc_torch.diagnosis.search.estimate import FinalEstimate
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.thresholds import IMPLAUSIBLE
from mkc_torch.effects.context import Context
from mkc_torch.effects.kinds import kind_at
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

_AT_END = 0.01
"""Relative distance within which a number is at a bound."""


def shape_at_ends(term: Term, prepared: PreparedSimulation, context: Context) -> tuple[str, ...]:
    """Return a sentence for each shape parameter at a bound.

    Args:
        term: the effect with its fitted shape.
        prepared: the simulation.
        context: context of the effect.
    """
    return tuple(_ended(term, prepared, context))


def far_from_plausible(term: Term, gamma: Tensor, context: Context) -> str:
    """Return why the amplitude is impossible: at its bound, or many times a plausible size; else empty.

    Args:
        term: the effect.
        gamma: its amplitude.
        context: context of the effect.
    """
    first = term.effect.quantities(term.shape, context)[0]
    largest, most = float(gamma[: first.size].abs().max()), term.effect.upper
    name = first.name.replace("_", " ")
    # an upper bound of 1 is a share, which may be 1
    if 1.0 < most < math.inf and _near(largest, most):
        return f"Its {name} ended at {sized(most, tidy(first.unit))}, the upper bound: the recording does not limit it."
    times = times_plausible(term, gamma, context)
    if times is not None and times > IMPLAUSIBLE:
        return f"Its {name} is {times:.2g} times the largest plausible size ({term.effect.source})."
    return ""


def times_plausible(term: Term, gamma: Tensor, context: Context) -> float | None:
    """Return the largest number of the first quantity as a multiple of the plausible size; None if that is unknown."""
    first, limit = term.effect.quantities(term.shape, context)[0], term.effect.plausible
    times = ratio(term.effect.plausible_unit or first.unit, first.unit)
    if not math.isfinite(limit) or times is None:
        return None
    return float(gamma[: first.size].abs().max()) / (limit * times)


def _ended(term: Term, prepared: PreparedSimulation, context: Context) -> Iterator[str]:
    for name, side in ended_shapes(term, prepared).items():
        text = sized(float(term.shape[name]), tidy(term.effect.unit_of_shape(name, context)))
        yield (
            f"{term.effect.id}: its {name.replace('_', ' ')} ended at {text}, the {side} bound: this recording "
            "does not determine it. Other physics may act there, or the recording is too short."
        )


def ended_shapes(term: Term, prepared: PreparedSimulation) -> dict[str, str]:
    """Return the fitted shape parameters that ended at a bound without a physical meaning, and which bound."""
    found = {}
    for name, ends in reach_of(term, prepared).items():
        for side, end in zip(("least", "greatest"), ends, strict=True):
            if side not in term.effect.natural_ends.get(name, ()) and _near(float(term.shape[name]), end):
                found[name] = side
    return found


def _near(value: float, end: float) -> bool:
    return abs(value - end) <= _AT_END * abs(end)


_MOST_ALTERNATIVES = 5
"""Number of listed alternatives; inseparable ones are always listed."""

_FARTHEST = 30.0
"""Log-likelihood gap in nats above which an alternative is not listed."""

_BLOCKS = 60
"""Number of blocks of the recording."""

_MOST_GAIN = 0.9
"""Share of the gain in the best blocks."""

_CONCENTRATED = 0.35
"""Largest share of best blocks for which the gain counts as concentrated."""


def finding_of(located: SearchResult, final: FinalEstimate, number: int, *, quick: bool = False) -> Finding:
    """Return the finding of effect ``number`` of the final model, without its evidence.

    Args:
        located: its search result.
        final: the final parameters.
        number: of the effect among the model's terms.
        quick: True for a quick look, without p-values and without the states and runs where the effect gains.
    """
    term = final.fit.model.terms[number]
    gamma, covariance = _own(final, number)
    context = _context(final, term)
    channels = places_of(term, context.channels)
    plausible, text = _plausibility(term, gamma, context)
    cannot_be = far_from_plausible(term, gamma, context)
    where = None if quick else attributed(final.fit, number)
    curve = curve_of_effect(term, gamma, covariance, context)
    of_motion_or_driver = term.effect.is_curve and not term.effect.unrecorded
    approximations = formulas(curve) if of_motion_or_driver and curve is not None else ()
    event_times = term.effect.moments(context)
    return Finding(
        effect=term.effect.id,
        drivers=term.columns,
        channels=channels,
        intervals=intervals_of(gain_of(final, number), final.fit.model.prepared.time),
        onset=event_times[0] if event_times else term.shape.get("onset"),
        equation="; ".join([term.effect.equation_of(term.shape, context), *approximations]),
        explanation=term.effect.explained(gamma.tolist(), term.shape, context),
        parameters=all_parameters(final, number),
        p_value=None if quick else located.p_value,
        alternatives=_alternatives(located, term),
        plausible=plausible and not cannot_be,
        plausibility=cannot_be or text,
        cannot_be=bool(cannot_be),
        times_plausible=times_plausible(term, gamma, context),
        shown_share=_shown_share(final.fit, number),
        doubts=shape_at_ends(term, final.fit.model.prepared, context),
        curve=curve,
        region=None if where is None else region_of(where),
        experiments=() if where is None else shares_of_runs(where),
        map=None if where is None else map_of(where),
        event_times=event_times,
        references=_references(term),
        advice=term.effect.advised(gamma.tolist(), term.shape, context),
        recurrence=term.effect.recurrence,
        location_specific=term.effect.location_specific,
        kind=kind_at(context),
        at_input=size_at_input(final, number),
    )


def _references(term: Term) -> tuple[Reference, ...]:
    if term.driver is None:
        return ()
    values = term.driver.reference.tolist()
    return tuple(Reference(*entry) for entry in zip(term.columns, values, term.driver.units, strict=True))


def _own(final: FinalEstimate, number: int) -> tuple[Tensor, Tensor]:
    """Return γ of an effect and its covariance."""
    model = final.fit.model
    start = model.base + sum(model.sizes[:number])
    mine = slice(start, start + model.sizes[number])
    return final.fit.parameters[mine], final.covariance[mine, mine]


def _shown_share(fit: FittedModel, number: int) -> float | None:
    """Return the share of the change of a sensor's vector that its compared length shows.

    None where each component of the vector is compared, and for an effect without a waveform.
    """
    model, term = fit.model, fit.model.terms[number]
    port = model.prepared.ports[term.port]
    if len(port.channels) <= fit.residual.shape[1] or not port.pointwise or not term.effect.has_waveform:
        return None
    start = model.base + sum(model.sizes[:number])
    gone = fit.parameters.clone()
    gone[start : start + model.sizes[number]] = 0.0
    shown = model.residual(fit.parameters) - model.residual(gone)
    context = term.context(model.prepared, model.signals(gone)[term.port])
    moved = term.effect.change(fit.parameters[start : start + model.sizes[number]], term.shape, context)
    size = float(moved.square().sum())
    return math.sqrt(float(shown.square().sum()) / size) if size > 0.0 else None


def _context(final: FinalEstimate, term: Term) -> Context:
    model = final.fit.model
    return term.context(model.prepared, model.signals(final.fit.parameters).get(term.port))


def all_parameters(final: FinalEstimate, number: int) -> tuple[EffectParameter, ...]:
    """Return the parameters of effect ``number`` of a final model: its amplitude and the reported shape numbers."""
    term = final.fit.model.terms[number]
    context = _context(final, term)
    shape = _shape_parameters(term, context, final.shape_errors[number])
    return (*parameters_of(term, *_own(final, number), context), *shape)


def parameters_of(
    term: Term, gamma: Float[Tensor, " q"], covariance: Float[Tensor, "q q"], context: Context
) -> tuple[EffectParameter, ...]:
    """Return γ as named quantities with units and standard errors."""
    error = covariance.diagonal().clamp(min=0.0).sqrt()
    parameters, start = [], 0
    for quantity in term.effect.quantities(term.shape, context):
        mine = slice(start, start + quantity.size)
        value, spread = gamma[mine], error[mine]
        start += quantity.size
        components = _components(term, quantity.name, quantity.size, context)
        parameters.append(
            EffectParameter(quantity.name, _numbers(value), _numbers(spread), tidy(quantity.unit), components)
        )
    return tuple(parameters)


def _components(term: Term, quantity: str, size: int, context: Context) -> tuple[str, ...]:
    """Return the component names of a quantity: those of the effect, or the channels."""
    if size < 2:
        return ()
    own = term.effect.components(quantity, term.shape, context)
    return own or (tuple(context.channels) if size == len(context.channels) else ())


def _shape_parameters(term: Term, context: Context, errors: Mapping[str, float]) -> tuple[EffectParameter, ...]:
    return tuple(
        EffectParameter(name, value, errors.get(name), term.effect.unit_of_shape(name, context), of_shape=True)
        for name, value in term.shape.items()
        if name != "onset" and term.effect.reports(name)
    )


def _numbers(values: Tensor) -> Number:
    if values.dim() == 0 or values.numel() == 1:
        return float(values)
    return tuple(_numbers(v) for v in values)


def _plausibility(term: Term, gamma: Tensor, context: Context) -> tuple[bool, str]:
    limit = term.effect.plausible
    first = term.effect.quantities(term.shape, context)[0]
    largest = float(gamma[: first.size].abs().max())
    if not math.isfinite(limit):
        return True, "No plausible size is known for this effect; check its equation."
    known = term.effect.plausible_unit or first.unit
    times = ratio(known, first.unit)
    if times is None:
        return True, f"Its size is in {first.unit or 'no unit'}; the plausible size is known only in {known}."
    limit *= times
    unit = f" {tidy(first.unit)}" if first.unit else ""
    text = f"Its largest value, {largest:.3g}{unit}, is"
    if largest <= limit:
        return True, f"{text} within the plausible {limit:g}{unit} ({term.effect.source})."
    return False, f"{text} above the plausible {limit:g}{unit} ({term.effect.source}): doubtful."


def _alternatives(located: SearchResult, term: Term) -> tuple[Alternative, ...]:
    """Return the rivals, nearest first: all inseparable rivals, and the next few."""
    found = []
    if term.driver is not None:
        found += [
            Alternative(term.effect.id, (copy,), 0.0, False, term.at, distinguishing_state=SAME)
            for copy in term.driver.copies
        ]
    separable = located.scene.settings.naming.separable
    own = [ranked.number for ranked in located.ranking if located.scene.terms[ranked.number].key == term.key]
    for ranked in located.ranking:
        rival = located.scene.terms[ranked.number]
        if rival.key == term.key or ranked.gap > _FARTHEST:
            continue
        gap = max(ranked.gap, 0.0)
        again, text = rival.effect.recurrence, ""
        if own and gap < separable:
            text = distinguishing_state(located, own[0], ranked.number)
        found.append(Alternative(rival.effect.id, rival.columns, gap, gap >= separable, rival.at, again, text))
    near = [a for a in found if not a.separable]
    return tuple(near + [a for a in found if a.separable][: max(0, _MOST_ALTERNATIVES - len(near))])


def intervals_of(gain: Float[Tensor, " N"], time: Float[Tensor, " N"]) -> tuple[tuple[float, float], ...]:
    """Return the intervals in which an effect's gain is concentrated: the fewest blocks with 90 % of the gain.

    Empty if these are more than a third of the recording, and if runs overlap in time.
    """
    N = len(time)
    count = min(_BLOCKS, N // 10)
    if count < 10 or bool((time.diff() < 0).any()):
        return ()
    block = (torch.arange(N) * count).div(N, rounding_mode="floor")
    total = gain.new_zeros(count).index_add(0, block, gain).clamp(min=0.0)
    order = total.argsort(descending=True)
    needed = int((total[order].cumsum(0) < _MOST_GAIN * total.sum()).sum()) + 1
    if float(total.sum()) <= 0 or needed > _CONCENTRATED * count:
        return ()
    inside = torch.zeros(count, dtype=torch.bool)
    inside[order[:needed]] = True
    intervals: list[tuple[float, float]] = []
    for k in inside.nonzero().squeeze(-1).tolist():
        rows = (block == k).nonzero().squeeze(-1)
        first, last = float(time[rows[0]]), float(time[rows[-1]])
        if intervals and inside[k - 1] and k > 0:
            intervals[-1] = (intervals[-1][0], last)
        else:
            intervals.append((first, last))
    return tuple(intervals)


def labels(terms: Sequence[Term]) -> tuple[str, ...]:
    """Return ``effect (driver)`` of terms, with the port if it is ambiguous."""
    places: dict[tuple[str, tuple[str, ...]], set[str]] = {}
    for term in terms:
        places.setdefault((term.effect.id, term.columns), set()).add(term.port)
    several = {key for key, found in places.items() if len(found) > 1}
    return tuple(
        t.effect.id
        + (f" ({', '.join(t.columns)})" if t.columns else "")
        + (f" at {t.port}" if (t.effect.id, t.columns) in several else "")
        for t in terms
    )


_MOST = 8
"""Largest number of candidates in the matrix."""


def separability(located: SearchResult) -> Separability:
    """Return the separability of the leading candidates at their best shapes, in the metric of the noise.

    The trace of a candidate is its tangent along the best γ, orthogonal to the simulation's parameters. The share is
    the
    squared norm that remains after projection on the rival, relative to the norm before.
    """
    numbers = [ranked.number for ranked in located.ranking[:_MOST]]
    traces, spaces, left = [], [], []
    for number in numbers:
        trace, space, kept = located.look.linearised.search.trace(number, located.look.linearised.series)
        traces.append(trace)
        spaces.append(space)
        left.append(kept)
    share = torch.ones(len(numbers), len(numbers), dtype=torch.float64)
    for i, trace in enumerate(traces):
        length = float(trace.square().sum())
        for j, space in enumerate(spaces):
            taken = float((space.mT @ trace).square().sum())
            share[i, j] = max(0.0, 1.0 - taken / length) if i != j and length > 0 else 0.0
    return Separability(
        labels([located.scene.terms[n] for n in numbers]), share, torch.tensor(left, dtype=torch.float64)
    )

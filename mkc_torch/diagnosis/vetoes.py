"""The vetoes on a finding, in one list, and its grade as a function of their decisions.

A veto compares a number of the finding with a threshold. It only grades: it neither searches nor fits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import torch
from torch import Tensor

from mkc_torch.diagnosis.decisions import Decision
from mkc_torch.diagnosis.environment import Grade
from mkc_torch.diagnosis.held_out_gain import better_on_average, change, confirmation, mean_ratio
from mkc_torch.diagnosis.parts import Finding, HeldOut
from mkc_torch.diagnosis.thresholds import IMPLAUSIBLE, LEVEL, SMALL, VISIBLE


@dataclass(frozen=True)
class VetoContext:
    """What a veto uses in addition to the finding.

    Attributes:
        level: rate of false alarms.
        number: of the finding, from 1.
        in_short: whether the tests were cut short, by a quick look or a stop: only held-out blocks can confirm then.
    """

    level: float = LEVEL
    number: int = 1
    in_short: bool = False


Veto = Callable[[Finding, VetoContext], Decision | None]
"""A veto returns None where it does not apply."""


def p_value(finding: Finding, context: VetoContext) -> Decision | None:
    """Compare the p-value with the level; a quick look has none."""
    p = finding.p_value
    if p is None:
        return None
    text = f"p = {p:.2g} after the whole search, level {context.level:g}."
    return _decision("p_value", finding, context, p, context.level, passed=p <= context.level, sentence=text)


def held_out_blocks(finding: Finding, context: VetoContext) -> Decision | None:
    """Compare the gain on held-out blocks with the gain that they have to show.

    That is half of its 95 % interval; 0 if the residual is smaller by :data:`SMALL` as well, since the surrogates have
    shown that the finding is no chance. Where noise and physics are selected together, process noise predicts one step
    ahead as well, and the blocks can only reject. An event that cannot be held out is confirmed by the search. If the
    tests were cut short, the blocks have to confirm surely.
    """
    held = finding.held_out
    if held is None or (context.in_short and not held.decides):
        if not context.in_short:
            return None
        text = "A quick look or a stopped search confirms by held-out blocks only, and no such gain is known."
        return _decision("held_out_blocks", finding, context, None, 0.0, passed=False, sentence=text)
    gain, (low, high) = held.log_likelihood_gain, held.confidence_interval
    kind, smaller = confirmation(gain, held.confidence_interval), 1.0 - mean_ratio(held)
    text = f"The gain on held-out blocks is {gain:.2g} nats per sample"
    if not held.decides:
        passed, least = not (kind == "worse" and smaller < SMALL), gain - high
        text += "; under process noise they can reject a finding, not confirm it."
    elif context.in_short or not better_on_average(held):
        passed, least = kind == "surely", gain - low
        text += f"; half of its 95 % interval is {least:.2g}."
    else:
        passed, least = True, 0.0
        text += f", and the residual is {_percent(smaller)} smaller."
    known = gain if math.isfinite(least) else None
    least = least if math.isfinite(least) else 0.0
    return _decision("held_out_blocks", finding, context, known, least, passed=passed, sentence=text)


def open_loop(finding: Finding, context: VetoContext) -> Decision | None:
    """Compare the open-loop residual on held-out blocks with that without the finding.

    It applies where noise and physics are selected together: there the open loop has to gain somewhere. If its
    likelihood gains clearly, its residual must not be larger by more than :data:`SMALL`; if the likelihood on held-out
    blocks does, it must not be larger; otherwise it has to be smaller by :data:`SMALL`.
    """
    held = finding.held_out
    if held is None or held.decides or context.in_short:
        return None
    most = _largest_ratio(held, clearly_better=finding.clearly_better)
    ratio = mean_ratio(held)
    text = f"The open-loop residual on held-out blocks is {ratio:.3g} of that without it; at most {most:g} is allowed."
    return _decision("open_loop", finding, context, ratio, most, passed=ratio <= most, sentence=text)


def _largest_ratio(held: HeldOut, *, clearly_better: bool) -> float:
    if clearly_better:
        return 1.0 + SMALL
    surely = confirmation(held.log_likelihood_gain, held.confidence_interval) == "surely"
    return 1.0 if surely else 1.0 - SMALL


def size_beyond_error(finding: Finding, context: VetoContext) -> Decision | None:
    """Compare the size with its standard error; a size of 0 is no finding, whatever held-out blocks show.

    Another change, such as of the noise model, made the difference then.
    """
    known = _sizes_with_errors(finding)
    if not known:
        return None
    exempt = _flat_but_better(finding)
    ratios = [float((value.abs() / error).max()) for value, error in known]
    largest = max((ratio for ratio in ratios if math.isfinite(ratio)), default=None)
    why = "; the open loop without it is clearly less likely, so any size counts" if exempt else ""
    shown = "unknown" if largest is None else f"{largest:.2g}"
    text = f"Its size in standard errors is {shown}{why}."
    least, passed = 0.0 if exempt else 1.0, not is_zero_within_error(finding)
    return _decision("size_beyond_error", finding, context, largest, least, passed=passed, sentence=text)


def size_plausible(finding: Finding, context: VetoContext) -> Decision | None:
    """Compare the size with the largest plausible size; a finding of impossible size is a proxy of other physics."""
    times = finding.times_plausible
    if times is None and not finding.cannot_be:
        return None
    text = finding.plausibility or f"Its size is {times:.2g} of the largest plausible size."
    return _decision(
        "size_plausible", finding, context, times, IMPLAUSIBLE, passed=not finding.cannot_be, sentence=text
    )


def shape(finding: Finding, context: VetoContext) -> Decision | None:
    """Compare the gain of a free curve of the same variables with the gain that makes it clearly better."""
    check = finding.shape
    if check is None:
        return None
    gain = check.free_curve_gain if math.isfinite(check.free_curve_gain) else None
    better = "clearly better" if check.curve is not None else "not clearly better"
    text = f"A free curve of the same variables is {better}: it gains {check.free_curve_gain:.3g} nats."
    return _decision("shape", finding, context, gain, check.needed, passed=check.curve is None, sentence=text)


def visible(finding: Finding, context: VetoContext) -> Decision | None:
    """Compare the change that the compared length shows with the change of the sensor's vector."""
    share = finding.shown_share
    if share is None:
        return None
    text = f"The compared length shows {_percent(share)} of the change of the sensor's vector."
    return _decision("visible", finding, context, share, VISIBLE, passed=share >= VISIBLE, sentence=text)


def residual_reduction(finding: Finding, context: VetoContext) -> Decision | None:
    """Compare the reduction of the residual with :data:`SMALL`; a smaller one shows only in means of many samples."""
    held = finding.held_out
    if held is None:
        return None
    less = change(held)
    text = f"It reduces the residual of an output by up to {_percent(less)} on held-out blocks."
    return _decision("residual_reduction", finding, context, less, SMALL, passed=less >= SMALL, sentence=text)


VETOES: tuple[Veto, ...] = (
    p_value,
    held_out_blocks,
    open_loop,
    size_beyond_error,
    size_plausible,
    shape,
    visible,
    residual_reduction,
)
"""In the order in which they are asked; all are, so that the trail has each."""

_LOWERED: Mapping[str, Grade] = MappingProxyType({"shape": "nearest", "residual_reduction": "small"})
"""Grade of a finding that fails this rule alone; any other rule makes it unconfirmed."""

_WORST_FIRST: tuple[Grade, ...] = ("unconfirmed", "nearest", "small")


def decisions_on(finding: Finding, context: VetoContext = VetoContext()) -> tuple[Decision, ...]:
    """Return the decision of each veto that applies, in their order."""
    decided = (veto(finding, context) for veto in VETOES)
    return tuple(decision for decision in decided if decision is not None)


def grade(decisions: Sequence[Decision]) -> Grade:
    """Return the grade of a finding by the decisions on it, in any order.

    Example:
        >>> failed = Decision("shape", "linear_drag@speed", 40.0, 8.0, False, "")
        >>> grade([failed]), grade([failed, Decision("p_value", "linear_drag@speed", 0.2, 0.05, False, "")]), grade([])
        ('nearest', 'unconfirmed', 'left_out')
    """
    lowered = {_LOWERED.get(decision.rule, "unconfirmed") for decision in decisions if not decision.passed}
    return next((found for found in _WORST_FIRST if found in lowered), "left_out")


_BLOCKS = "held-out blocks do not confirm it"

_REFUSALS: Mapping[str, str] = MappingProxyType(
    {
        "held_out_blocks": _BLOCKS,
        "open_loop": "the open-loop residual on held-out blocks is not clearly smaller with it",
        "visible": "the compared length hardly shows it",
        "p_value": "its p-value is above the level",
    }
)
"""Why a finding is unconfirmed, by the failed rule; the first that fails is stated."""


def refusal(finding: Finding) -> str:
    """Return why a finding is unconfirmed, as a clause.

    Example:
        >>> untested = Finding("linear_drag", (), ("rate of speed",), (), None, "", "", (), 0.2, (), True, "")
        >>> refusal(untested)
        'its p-value is above the level'
    """
    failed = {decision.rule for decision in decisions_on(finding) if not decision.passed}
    text = next((text for rule, text in _REFUSALS.items() if rule in failed), "")
    return text or (_BLOCKS if finding.held_out is not None else "it was not tested on held-out blocks")


def is_refused_by_blocks(finding: Finding) -> bool:
    """Whether held-out blocks are the reason why a finding is unconfirmed."""
    return "held-out blocks" in refusal(finding) and finding.held_out is not None


def is_dropped(decisions: Sequence[Decision]) -> bool:
    """Whether a candidate is no finding at all: its size is 0 within its standard error."""
    return any(decision.rule == "size_beyond_error" and not decision.passed for decision in decisions)


def spelled(finding: Finding) -> str:
    """Return effect and place of a finding, spelled as ``--suspect`` accepts it.

    Example:
        >>> spelled(Finding("linear_drag", (), ("rate of speed",), (), None, "", "", (), 0.01, (), True, ""))
        'linear_drag@speed'
    """
    places = [re.sub("^(rate of|input|parameter) ", "", name) for name in finding.channels]
    return "@".join(filter(None, [finding.effect, ",".join(finding.drivers or places)]))


def is_zero_within_error(finding: Finding) -> bool:
    """Whether all sizes are within a standard error of 0; False without standard errors.

    Numbers of the shape, such as a period, do not count: they exist at any size. A size that ended at a bound of 0 has
    a standard error of 0. Otherwise False as well if the open-loop fit without the finding is clearly less likely, and
    the residual on held-out blocks clearly smaller with it. Far from 0 the likelihood can be flat, as for the capacity
    of a large second store, and the standard error larger than the size (Hauck & Donner, Journal of the American
    Statistical Association 72 (1977), 851).
    """
    known = _sizes_with_errors(finding)
    if known and not any(bool(value.any()) for value, _ in known):
        return True
    within = all(bool((value.abs() < error).all()) for value, error in known)
    return bool(known) and not _flat_but_better(finding) and within


def _sizes_with_errors(finding: Finding) -> list[tuple[Tensor, Tensor]]:
    return [
        (torch.as_tensor(parameter.value), torch.as_tensor(parameter.standard_error))
        for parameter in finding.parameters
        if parameter.standard_error is not None and not parameter.of_shape
    ]


def _flat_but_better(finding: Finding) -> bool:
    held = finding.held_out
    return finding.clearly_better and (held is None or mean_ratio(held) <= 1.0 - SMALL)


def is_small(finding: Finding) -> bool:
    """Whether a finding hardly reduces the residual; only means over many samples show it."""
    return finding.held_out is not None and change(finding.held_out) < SMALL


def worth_correcting(finding: Finding) -> bool:
    """Whether the finding clearly improves the simulation."""
    return finding.grade == "left_out"


def counts(finding: Finding) -> bool:
    """Whether a finding belongs into the corrected model: confirmed, or not tested and of a possible size."""
    untested = finding.held_out is None and not finding.cannot_be
    return finding.grade != "unconfirmed" or untested


def transfers(finding: Finding) -> bool:
    """Whether a finding can be applied to another recording.

    Location-specific and intermittent findings cannot.
    """
    return worth_correcting(finding) and finding.plausible and not (finding.location_specific or finding.comes_and_goes)


def _decision(
    rule: str,
    finding: Finding,
    context: VetoContext,
    value: float | None,
    threshold: float,
    *,
    passed: bool,
    sentence: str,
) -> Decision:
    return Decision(rule, spelled(finding), value, threshold, passed, sentence, context.number)


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %" if abs(share) >= 0.1 else f"{100.0 * share:.1f} %"

"""Advice: what to do or to record next, and where a magnetometer's misfit may come from."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized, tidy
from mkc_torch.diagnosis.environment import ProcessNoise
from mkc_torch.diagnosis.held_out_gain import change
from mkc_torch.diagnosis.result import Alternative, Diagnosis, Finding
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.verdict import conclusion, doubted_signs
from mkc_torch.diagnosis.vetoes import refusal, transfers, worth_correcting
from mkc_torch.effects import is_curve
from mkc_torch.effects.kinds import MOTION

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


_WARMING_UP = 60.0
"""Correlation time in s beyond which a drift may be the warming up of a sensor."""

_SWITCHED = (
    "Look for a cause that is switched on and off, such as a heater, a lamp or a motor, and record it: the offset is "
    "intermittent."
)

_OTHERWISE: Mapping[str, str] = {
    **dict.fromkeys(MOTION, " at other speeds, loads and amplitudes"),
    "temperature": " from another temperature, with other heating and cooling",
    "level": " from another level, with other flows in and out",
    "pressure": " from another pressure, with other flows in and out",
    "voltage": " at other voltages and loads",
    "current": " at other voltages and loads",
}
"""How to record again, by kind of quantity."""

SAME = "In this recording their effects are equal within the noise: only a recording in which they differ helps."

_NOTHING = 0.05
"""Expected gain in nats below which no similar recording distinguishes two effects."""

_BETTER = 1.5
"""Minimum information of a sample, relative to the mean, for a state to be named."""

_FEWEST = 0.03
"""Minimum share of samples in that state."""

_MAINLY = 0.8
"""Minimum share of a signal's norm along its main axis."""

_MOST = 20.0
"""Ratio of samples above which "far more samples" is reported."""


def advice_of(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return advice in sentences, the most important first, with effect ids."""
    d = diagnosis
    known = conclusion(d)
    first = known.first_advice(quick=d.quick, reasons=bool(d.environment.reasons))
    if known.verdict == "adequate":
        return (first, *(_hold_back(f, d) for f in d.findings))
    if known.check:
        left = () if doubted_signs(d.decisions) else _of_what_remains(d)
        return (first, *dict.fromkeys([*(sentence for f in d.findings for sentence in _of(f, d)), *left]))
    return (first,) if first else _after_the_search(d)


def _after_the_search(diagnosis: Diagnosis) -> tuple[str, ...]:
    d = diagnosis
    advice = [sentence for finding in d.findings for sentence in _of(finding, d)]
    advice += _of_what_remains(d)
    use = [_called(f, d) for f in d.findings if transfers(f)]
    if use and "not_better" in conclusion(d).doubts:
        advice.append(
            f"Do not apply the model found here for {' and '.join(use)} yet: the residual on held-out blocks is not "
            "smaller with it. Record again, for longer."
        )
    elif use:
        advice.append(f"The model found here corrects for {' and '.join(use)}: confirm it on a second recording.")
    return tuple(dict.fromkeys(advice))


def _of_what_remains(diagnosis: Diagnosis) -> Iterator[str]:
    d = diagnosis
    rates = [process for process in d.environment.process_noise if process.at_rate]
    if d.remaining:
        yield f"Look for other causes that vary with {', '.join(d.remaining)}: the residual has a smooth trend there."
    elif d.verdict == "unexplained" and rates:
        yield _find_disturbance(rates[0])
    elif d.verdict == "unexplained" and d.environment.process_noise:
        drift = d.environment.process_noise[0]
        example = ", such as warming up" if drift.correlation_time > _WARMING_UP else ""
        yield f"Look for a cause of the drift of `{drift.place}`{example}, and record it."
    elif any(f.grade == "nearest" for f in d.findings):
        return  # advice on its curve follows
    elif not d.findings or d.verdict == "unexplained":
        yield (
            "Record again, for longer, with more columns that could explain the residual, such as temperature, current "
            "and motion."
        )


def _find_disturbance(process: ProcessNoise) -> str:
    size = f"{process.size:.2g} {tidy(process.unit)}".rstrip()
    return (
        f"Look for the cause of the disturbance of the rate of `{process.place}`, with the help of its figure, and "
        f"record the cause. Until then, use {size} as the process noise of that rate, for example in a filter."
    )


def _of(finding: Finding, d: Diagnosis) -> Iterator[str]:
    f = finding
    near = [a for a in f.alternatives if not a.separable]
    if f.grade == "nearest":
        yield _by_its_curve(f, d)
        return
    if not worth_correcting(f):
        yield _hold_back(f, d)
    elif not f.plausible and not f.cannot_be:
        yield f"The size of {_called(f, d)} is not plausible: look for another cause before correcting it."
    if near:
        yield _distinguish(f, near)
    if f.plausible and worth_correcting(f):
        what = _SWITCHED if f.comes_and_goes else f.advice
        if what and near:
            yield f"If it is {_called(f, d)}: {_small_letter(what)}"
        elif what:
            yield what if len(d.findings) == 1 else f"{_called(f, d)}: {_small_letter(what)}"


def _small_letter(sentence: str) -> str:
    return f"{sentence[:1].lower()}{sentence[1:]}"


def _by_its_curve(finding: Finding, d: Diagnosis) -> str:
    """Return the advice for a finding of another shape."""
    f = finding
    formula = f.shape.formula if f.shape is not None else ""
    what = f"the formula {formula}" if formula else "the curve of the report"
    of = f" of {', '.join(f.drivers)}" if f.drivers else ""
    return (
        f"Do not add {_called(f, d)} to the simulation: the recording shows another shape. Look for physics with"
        f" {what}{of}, or use that within the recorded range."
    )


def _hold_back(finding: Finding, d: Diagnosis) -> str:
    """Return why not to correct for a finding."""
    f = finding
    if f.grade == "small" and f.held_out is not None:
        return (
            f"Do not correct for {_called(f, d)}, unless means over many samples matter: it reduces the residual by "
            f"only "
            f"{max(100.0 * change(f.held_out), 0.0):.1f} %."
        )
    if f.cannot_be:
        return (
            f"Do not correct for {_called(f, d)}: {_small_letter(f.plausibility)} Look for other physics at the same "
            "port."
        )
    wider = f", with {', '.join(f.drivers)} over a wider range," if f.drivers else ","
    return (
        f"Do not correct for {_called(f, d)} yet: {refusal(f)}. Record again, for longer{wider} and check whether it "
        "is found again."
    )


def _called(finding: Finding, d: Diagnosis) -> str:
    """Return the name of a finding, with its channels if another finding has the same name."""
    f = finding
    if is_curve(f.effect):
        along = ", ".join(f.drivers) or (f.curve.driver if f.curve is not None else "time")
        name = "the course of an unrecorded cause" if along == "time" else f"the curve along {along}"
    else:
        name = f.effect
    same = [other for other in d.findings if (other.effect, other.drivers) == (f.effect, f.drivers)]
    return f"{name} on the {', '.join(f.channels)}" if len(same) > 1 and f.channels else name


def _distinguish(finding: Finding, near: Sequence[Alternative]) -> str:
    """Return what to record; an effect that is also tried elsewhere is named with its place."""
    same = any((a.effect, a.drivers) == (finding.effect, finding.drivers) for a in near)
    own = f"{finding.effect} on the {', '.join(finding.channels)}" if same and finding.channels else finding.effect
    text = ", ".join(dict.fromkeys(_rival(alternative, placed=same) for alternative in near))
    instruction = f"To distinguish {own} from {text}, record again{_how(finding, near)}."
    return f"{instruction} {near[0].distinguishing_state}".rstrip()


def _rival(alternative: Alternative, *, placed: bool) -> str:
    drivers = f" ({', '.join(alternative.drivers)})" if alternative.drivers else ""
    place = f" on the {alternative.port}" if placed and alternative.port else ""
    return f"{alternative.effect}{drivers}{place}"


def _how(finding: Finding, near: Sequence[Alternative]) -> str:
    every: tuple[Finding | Alternative, ...] = (finding, *near)
    columns = list(dict.fromkeys(column for candidate in every for column in candidate.drivers))
    if all(candidate.drivers for candidate in every):
        if len(columns) == 1:
            return f" with {columns[0]} over a wider range"
        return " with independent variation: change one column and hold the other"
    clauses = list(
        dict.fromkeys(candidate.recurrence for candidate in every if candidate.recurrence and not candidate.drivers)
    )
    if columns:
        clauses.append(f"let {', '.join(columns)} change at other times")
    return f": {'; '.join(clauses)}" if clauses else _OTHERWISE.get(finding.kind, " with other inputs and amplitudes")


def distinguishing_state(located: SearchResult, own: int, rival: int) -> str:
    """Return a sentence on what to record.

    The trace of the effect is projected on the rival and the simulation's parameters. Half the squared residual of the
    projection, in units of the noise, is the expected log-likelihood gain in nats; its distribution over the recording
    shows the informative samples.

    Args:
        located: the search that named the effect.
        own: number of the effect among its candidates.
        rival: number of the rival.
    """
    search, series = located.look.linearised.search, located.look.linearised.series
    trace, _, _ = search.trace(own, series)
    _, space, _ = search.trace(rival, series)
    nats = 0.5 * float((trace - space @ (space.mT @ trace)).square().sum())
    if nats < _NOTHING:
        return SAME
    more = located.scene.settings.naming.separable / nats
    often = f"about {more:.1f} times as many samples" if more > 1.0 else "as many samples again"
    if more > _MOST:
        often = "far more samples"
    text = f"In a similar recording, {often} would distinguish them"
    left = _left(located, own, rival)
    times, words = max(((state.times(left), state.display_name) for state in _states(located)), default=(0.0, ""))
    if times < _BETTER:
        return f"{text}."
    return f"{text}; best samples in which {words}, with {times:.1f} times the mean information."


@dataclass(frozen=True)
class _State:
    """A condition, and the samples that meet it."""

    display_name: str
    samples: Bool[Tensor, " N"]

    def times(self, left: Float[Tensor, " N"]) -> float:
        """Return the information of a sample in this state, relative to the mean."""
        share = float(self.samples.double().mean())
        mean = float(left.mean())
        return float(left[self.samples].mean()) / mean if share >= _FEWEST and mean > 0 else 0.0


def _left(located: SearchResult, own: int, rival: int) -> Float[Tensor, " N"]:
    """Return the squared residual of the projection at each sample, in units of the noise."""
    gamma = located.look.linearised.search.estimate(own, located.look.linearised.series)[0]
    weight = (located.scene.counts / located.fit.d).unsqueeze(-1)
    candidates = located.scene.tangents.candidates
    target = (weight.squeeze(-1) * (candidates[own] @ gamma)).flatten()
    columns = (weight * torch.cat([located.scene.tangents.nuisance, candidates[rival]], -1)).flatten(0, 1)
    size = torch.linalg.vector_norm(columns, dim=0).clamp(min=1e-300)
    basis = torch.linalg.qr(columns / size).Q
    left = target - basis @ (basis.mT @ target)
    return left.square().unflatten(0, located.scene.counts.shape).sum(-1)


def _states(located: SearchResult) -> Iterator[_State]:
    """Yield low and high values of each recorded driver, and main axes of the port's signal."""
    drivers = {t.driver.columns[0]: t.driver for t in located.scene.terms if t.driver and len(t.driver.columns) == 1}
    for name, driver in drivers.items():
        values = driver.values[:, 0]
        if len(values) != len(located.scene.counts):
            continue
        low, high = (float(v) for v in torch.quantile(values, values.new_tensor([1.0 / 3.0, 2.0 / 3.0])))
        for word, edge, inside in (("below", low, values < low), ("above", high, values > high)):
            yield _State(f"{name} is {word} {sized(edge + float(driver.reference), driver.units[0])}", inside)
    yield from _along(located)


def _along(located: SearchResult) -> Iterator[_State]:
    model = located.fit.model
    name = model.terms[-1].port
    port, signals = model.prepared.ports[name], _signals(located)
    if name not in signals or port.carries or len(signals[name]) != len(located.scene.counts):
        return
    signal = signals[name]
    share = signal / torch.linalg.vector_norm(signal, dim=-1, keepdim=True).clamp(min=1e-300)
    for axis, part in zip(port.channels, share.unbind(-1), strict=True):
        for word, inside in (("+", part > _MAINLY), ("−", part < -_MAINLY)):
            yield _State(f"the signal at the {name} is mainly along {word}{axis}", inside)


def _signals(located: SearchResult) -> Mapping[str, Tensor]:
    signals = located.fit.model.signals(located.fit.parameters)
    return {name: value for name, value in signals.items() if math.isfinite(float(value.abs().sum()))}

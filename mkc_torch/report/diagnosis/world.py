"""The world around a simulation in words: how it follows each output, what pushes it, and what inputs do."""

from __future__ import annotations

import math

from mkc_torch._support.unit_text import tidy
from mkc_torch._words.terms import term
from mkc_torch._words.typesetting import plain
from mkc_torch.diagnosis.environment import GoodnessOfFit, NoiseEnvironment, ProcessNoise
from mkc_torch.diagnosis.result import Diagnosis, Table
from mkc_torch.report.diagnosis.numbers import measured
from mkc_torch.report.diagnosis.recordings import recording_called
from mkc_torch.report.words.numbers import number, size

__all__ = [
    "between_sentence",
    "explained",
    "follows_table",
    "noise_lines",
    "offset_sentences",
    "output_lines",
    "push_sentence",
    "pushes_table",
    "remainder",
]

_MOST_OUTPUTS = 6
_STILL = 2.0
"""Times its noise floor up to which an output's variation is called hardly any."""
_MOST_DECIMALS = 4
_SOURCES = {"declared": "world.declared", "samples": "world.samples", "quantisation": "world.quantisation"}
_BETWEEN = {"held": "world.held", "linear": "world.linear", "smooth": "world.smooth"}


def explained(value: float) -> str:
    """A share of the variation, with as many nines as it has.

    Example:
        >>> explained(0.9997), explained(0.12), explained(-0.06), explained(0.985), explained(1.0)
        ('99.97 %', '12 %', 'nothing', '98.5 %', '100 %')
    """
    if not value > 0.0:
        return term("world.nothing")
    places = 0 if value < 0.9 or value == 1.0 else min(max(-math.floor(math.log10(1.0 - value)) - 2, 1), _MOST_DECIMALS)
    return f"{number(100.0 * value, places)} %"


def output_lines(diagnosis: Diagnosis) -> list[str]:
    """A line an output: how the simulation follows it, in its own unit, beside the noise floor; and its offsets."""
    each = diagnosis.world.follows
    told = [_followed(one, lost=diagnosis.verdict == "unfit") for one in each[:_MOST_OUTPUTS]]
    more = len(each) - len(told)
    beside = [] if diagnosis.verdict == "unfit" else offset_sentences(diagnosis.world)
    return [*told, *([term("world.more_outputs", count=more)] if more else []), *beside]


def _followed(one: GoodnessOfFit, *, lost: bool) -> str:
    """How an output is followed; of one that is not, what a trivial prediction reaches.

    Example:
        >>> one = GoodnessOfFit("angle", "rad", 0.0049, 0.35, 0.9998, 0.005, "declared", 0.35, 0.02)
        >>> _followed(one, lost=False)
        'angle follows to 0.00490 rad; noise floor 0.00500 rad (declared); explains 99.98 % of its variation'
    """
    if lost:
        return term(
            "world.lost",
            output=plain(one.output),
            share=explained(one.explained),
            mean=_sized(one.mean_predicts, one.unit),
            residual=_sized(one.residual, one.unit),
            floor=_floor(one),
        )
    key = "world.still" if one.variation <= _STILL * one.noise_floor else "world.follows_to"
    share = explained(one.explained)
    return term(key, output=plain(one.output), residual=_sized(one.residual, one.unit), floor=_floor(one), share=share)


def _floor(one: GoodnessOfFit) -> str:
    if not math.isfinite(one.noise_floor):
        return term("world.floor_unknown")
    return term("world.floor", size=_sized(one.noise_floor, one.unit), source=term(_SOURCES[one.floor_source]))


def _sized(value: float, unit: str) -> str:
    if not math.isfinite(value):
        return term("number.not_known")
    return f"{size(value)} {plain(unit)}".rstrip()


def follows_table(world: NoiseEnvironment) -> Table | None:
    """The numbers of how each output is followed; None where that was not asked."""
    if not world.follows:
        return None
    rows = tuple(
        (
            plain(one.output),
            _sized(one.residual, one.unit),
            _floor(one),
            _sized(one.variation, one.unit),
            explained(one.explained),
            _sized(one.mean_predicts, one.unit),
            _sized(one.last_value_predicts, one.unit),
        )
        for one in world.follows
    )
    return Table(
        term("section.follows"), tuple(term(key) for key in _FOLLOWS_COLUMNS), rows, term("world.follows_note")
    )


_FOLLOWS_COLUMNS = (
    "table.output",
    "label.residual",
    "table.noise_floor",
    "table.variation",
    "table.explained",
    "table.mean_predicts",
    "table.last_value_predicts",
)


def push_sentence(push: ProcessNoise) -> str:
    """What pushes a state, or is added to an output, in plain words.

    Example:
        >>> push_sentence(ProcessNoise("rate", True, 0.7, 0.2284, 0.021, "rad/s²", 300.0))
        'Something unrecorded pushes the rate of `rate`: 0.228 ± 0.021 rad/s², for about 0.7 s at a time.'
        >>> push_sentence(ProcessNoise("rate", True, 0.0, 0.2284, 0.021, "rad/s²", 300.0))
        'Something unrecorded pushes the rate of `rate`: 0.228 ± 0.021 rad/s², anew at each sample.'
        >>> push_sentence(ProcessNoise("angle", False, 30.0, 0.01, 0.002, "rad", 12.0))
        'Something slow is added to `angle` beside its noise: 0.0100 ± 0.0020 rad, for about 30 s at a time.'
    """
    told = measured(push.size, push.standard_error, tidy(push.unit))[0]
    lasts = term("world.lasts", lasting=f"{push.lasting:.2g}") if push.lasting > 0.0 else term("world.each_sample")
    return term("world.push" if push.at_rate else "world.slow", place=plain(push.place), size=told, lasts=lasts)


def pushes_table(world: NoiseEnvironment) -> Table | None:
    """The statistician's numbers of the pushes; None where there are none."""
    if not world.pushes:
        return None
    rows = tuple(
        (
            term("world.rate_of", place=plain(push.place)) if push.at_rate else plain(push.place),
            measured(push.size, push.standard_error, tidy(push.unit))[0],
            f"{push.lasting:.3g} s" if push.lasting > 0.0 else term("unit.sample"),
            size(push.nats) if math.isfinite(push.nats) else term("number.not_known"),
        )
        for push in world.pushes
    )
    columns = (term("table.pushes"), term("table.standard_deviation"), term("table.lasts"), term("table.without"))
    return Table(term("section.pushes"), columns, rows, term("world.pushes_note"))


def between_sentence(world: NoiseEnvironment) -> str:
    """What inputs do between samples; empty where that was not asked.

    Example:
        >>> between_sentence(NoiseEnvironment(input_hold={"torque": "held", "force": "linear"}))
        'Between samples `torque` is held, `force` goes straight.'
    """
    each = [term(_BETWEEN[how], input=plain(name)) for name, how in world.input_hold.items()]
    return term("world.between", inputs=", ".join(each)) if each else ""


def offset_sentences(world: NoiseEnvironment) -> list[str]:
    """The offsets of each output in several recordings.

    Example:
        >>> from mkc_torch.diagnosis.environment import Offset
        >>> offset_sentences(NoiseEnvironment(offsets=(Offset("speed", "m/s", 1, "a.csv", 0.3, 0.001),)))
        ['Offset of speed in each recording: recording 1 (a.csv): 0.3000 ± 0.0010 m/s.']
    """
    told: dict[str, list[str]] = {}
    for one in world.offsets:
        size = measured(one.value, one.standard_error, tidy(one.unit))[0] if math.isfinite(one.standard_error) else "0"
        told.setdefault(one.output, []).append(f"{recording_called(one.recording, one.name)}: {size}")
    return [term("world.offset", output=plain(name), offsets=", ".join(each)) for name, each in told.items()]


def remainder(diagnosis: Diagnosis) -> str:
    """Whether what is left over is the sensor's noise; empty where nothing was asked of it."""
    d = diagnosis
    if d.world.pushes:
        return " ".join(push_sentence(push) for push in d.world.pushes)
    if d.verdict == "adequate" and d.world.follows:
        return term("world.sensor_alone")
    return ""


def noise_lines(diagnosis: Diagnosis) -> list[str]:
    """What the noise of the world is made of, beside that of the fit."""
    return [line for line in (remainder(diagnosis), between_sentence(diagnosis.world)) if line]

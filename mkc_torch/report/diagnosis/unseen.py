"""What unseen blocks say of a finding: whether it is better there, why not if it seems so, and each output's sizes."""

from __future__ import annotations

import math

from mkc_torch._words.terms import term
from mkc_torch._words.typesetting import plain
from mkc_torch.diagnosis.environment import NoiseEnvironment
from mkc_torch.diagnosis.findings.grading import SMALL, Confirmation, change, confirmation, vetoed
from mkc_torch.diagnosis.result import Diagnosis, HeldOut, ResidualSizes
from mkc_torch.report.diagnosis.numbers import improvement
from mkc_torch.report.words.numbers import size

__all__ = ["better", "left", "residual_of_all", "residuals"]

_BETTER = {
    "surely": "evidence.surely",
    "probably": "evidence.probably",
    "not shown": "evidence.not_shown",
    "worse": "evidence.worse",
}
_UNCHANGED = 5e-4
"""Share below which a residual counts as no smaller: "surely better" is not said of it, likelier though it be."""


def better(held_out: HeldOut) -> str:
    """Whether unseen blocks show that the finding makes it better; where the residuals say otherwise, why.

    Example:
        >>> better(HeldOut(0.3, (0.2, 0.4), 1.0, 0.8, "µT")), better(HeldOut(0.01, (-0.1, 0.1), 1.0, 0.99, "µT"))
        ('surely better on unseen blocks', 'not shown to be better on unseen blocks')
        >>> better(HeldOut(0.13, (-0.4, 0.66), 1.0, 0.29, "µT"))
        'not shown to be better on unseen blocks: from block to block the gain differs by more than itself, so it ...'
    """
    kind = confirmation(held_out.log_likelihood_gain, held_out.confidence_interval)
    told, reason = _freely(held_out, kind) if not held_out.decides else _by_likelihood(held_out, kind)
    return term("evidence.because", better=term(told), reason=reason) if reason else term(told)


def _freely(held_out: HeldOut, kind: Confirmation) -> tuple[str, str]:
    """A term and a reason where the free run decides."""
    if vetoed(held_out):
        if kind in ("surely", "probably"):
            return _BETTER["not shown"], term("evidence.free_run_farther")
        return _by_likelihood(held_out, kind)
    if kind == "surely":
        return _by_likelihood(held_out, kind)
    return "evidence.not_against", term("evidence.free_run_closer") if kind == "worse" else ""


def _by_likelihood(held_out: HeldOut, kind: Confirmation) -> tuple[str, str]:
    """A term, and why residuals and likelihood disagree; empty where they do not."""
    less = change(held_out)
    if kind == "surely":
        if less >= _UNCHANGED:
            return _BETTER[kind], ""
        return "evidence.surely_likelier", term("evidence.in_the_tail")
    if less < SMALL:
        return _BETTER[kind], ""
    why = term("evidence.tail_less_likely" if kind == "worse" else "evidence.blocks_differ")
    return _BETTER[kind], _within(held_out.left) or why


def _within(sentence: str) -> str:
    """A sentence as a part of another."""
    return sentence[:1].lower() + sentence[1:].rstrip(".")


def left(held_out: HeldOut) -> str:
    """Of which blocks the free run leaves the recording's range; empty where none does or it was told as a reason."""
    return "" if not held_out.left or _within(held_out.left) in better(held_out) else held_out.left


def residuals(held_out: HeldOut, world: NoiseEnvironment) -> list[str]:
    """The residual before and after, an output a line, each in its own unit and beside its noise floor.

    Example:
        >>> each = {"angle": ResidualSizes(0.02, 0.01, "rad"), "rate": ResidualSizes(0.3, 0.3, "rad/s")}
        >>> residuals(HeldOut(0.3, (0.2, 0.4), 0.3, 0.3, "", each), NoiseEnvironment())
        ['angle 0.0200 → 0.0100 rad (50 % less)', 'rate 0.300 → 0.300 rad/s (no change)']
        >>> residuals(HeldOut(0.3, (0.2, 0.4), 0.9, 0.5, "µT"), NoiseEnvironment())
        ['residual 0.900 → 0.500 µT (44 % less)']
    """
    if not held_out.outputs:
        told = improvement(held_out.rmse_before, held_out.rmse_after, held_out.unit)
        return [term("evidence.of_residual", change=told)]
    return [_of_output(name, sizes, world) for name, sizes in held_out.outputs.items()]


def _of_output(name: str, sizes: ResidualSizes, world: NoiseEnvironment) -> str:
    told = improvement(sizes.before, sizes.after, sizes.unit)
    floor = next((one.noise_floor for one in world.follows if one.output == name), math.nan)
    if math.isfinite(floor):
        told = term("evidence.with_floor", change=told, floor=f"{size(floor)} {plain(sizes.unit)}".rstrip())
    return term("evidence.one_size", output=plain(name), change=told)


def residual_of_all(diagnosis: Diagnosis) -> list[str]:
    """The same without any finding and with all; empty where outputs of several units have one number together."""
    d = diagnosis
    held = [f.held_out for f in d.findings if f.held_out is not None]
    if len(held) == len(d.findings) and all(one.outputs for one in held) and held:
        first, last = held[0].outputs, held[-1].outputs
        both = {
            name: ResidualSizes(sizes.before, last[name].after, sizes.unit)
            for name, sizes in first.items()
            if name in last
        }
        return [_of_output(name, sizes, d.world) for name, sizes in both.items()]
    if len(d.traces.channels) > 1 and not d.traces.unit:
        return []
    told = improvement(d.baseline.rmse, d.corrected.rmse, d.traces.unit)
    return [term("evidence.of_residual", change=told)]

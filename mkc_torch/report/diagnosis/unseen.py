"""Evidence for a finding on held-out blocks, in words: confirmation, reasons, and residuals of each output."""

from __future__ import annotations

import math

from mkc_torch._support.typesetting import plain
from mkc_torch.diagnosis.environment import NoiseEnvironment
from mkc_torch.diagnosis.held_out_gain import (
    Confirmation,
    better_on_average,
    change,
    confirmation,
    mean_ratio,
    rejects,
)
from mkc_torch.diagnosis.result import Diagnosis, HeldOut, ResidualSizes
from mkc_torch.diagnosis.thresholds import SMALL
from mkc_torch.diagnosis.vetoes import counts
from mkc_torch.report.diagnosis.numbers import improvement
from mkc_torch.report.words.numbers import size

_BETTER = {
    "surely": "surely better on held-out blocks",
    "probably": "probably better on held-out blocks, not surely",
    "not shown": "not shown to be better on held-out blocks",
    "worse": "worse on held-out blocks",
}
_VARIES = "the gain varies between blocks by more than its mean"
_UNCHANGED = 5e-4
"""Share by which a residual must shrink for "surely better"."""


def better(held_out: HeldOut) -> str:
    """State whether held-out blocks confirm a finding, and why residual and likelihood disagree.

    Example:
        >>> better(HeldOut(0.3, (0.2, 0.4), 1.0, 0.8, "µT")), better(HeldOut(0.01, (-0.1, 0.1), 1.0, 0.99, "µT"))
        ('surely better on held-out blocks', 'not shown to be better on held-out blocks')
        >>> better(HeldOut(0.13, (-0.4, 0.66), 1.0, 0.29, "µT"))
        'better on average on held-out blocks: the gain varies between blocks by more than its mean'
    """
    kind = confirmation(held_out.log_likelihood_gain, held_out.confidence_interval)
    text, reason = _freely(held_out, kind) if not held_out.decides else _by_likelihood(held_out, kind)
    return f"{text}: {reason}" if reason else text


def _freely(held_out: HeldOut, kind: Confirmation) -> tuple[str, str]:
    """Return key and reason if the open-loop residual decides."""
    if rejects(held_out):
        if kind in ("surely", "probably"):
            return _BETTER[
                "not shown"
            ], "the open-loop residual is larger there, although one-step predictions are more likely"
        return _by_likelihood(held_out, kind)
    if kind == "surely":
        return _by_likelihood(held_out, kind)
    if mean_ratio(held_out) > 1.0 - SMALL:
        return "little difference on held-out blocks", ""
    return (
        "held-out blocks do not reject it",
        "the open-loop residual is smaller there, although one-step predictions are less likely"
        if kind == "worse"
        else "",
    )


def _by_likelihood(held_out: HeldOut, kind: Confirmation) -> tuple[str, str]:
    """Return the key, and why residual and likelihood disagree; the reason is empty if they agree."""
    less = change(held_out)
    if kind == "surely":
        if less >= _UNCHANGED:
            return _BETTER[kind], ""
        return "surely more likely on held-out blocks", "the gain is in the tail of the residual, not in its centre"
    if less < SMALL:
        return _BETTER[kind], ""
    if kind == "worse":
        why = "the loss is in the tail of the residual, not in its centre"
    elif kind == "not shown" and better_on_average(held_out):
        return "better on average on held-out blocks", _within(_diverged(held_out)) or _VARIES
    else:
        why = f"{_VARIES}, so it may be chance"
    return _BETTER[kind], _within(_diverged(held_out)) or why


def _within(sentence: str) -> str:
    """Return a sentence as a clause."""
    return sentence[:1].lower() + sentence[1:].rstrip(".")


def diverged(held_out: HeldOut) -> str:
    """Return in how many blocks a simulation diverges; empty if none does or ``better`` already contains it."""
    sentence = _diverged(held_out)
    return "" if not sentence or _within(sentence) in better(held_out) else sentence


def _diverged(held_out: HeldOut) -> str:
    """Return in how many blocks a simulation leaves the recording's range; empty if none does.

    Example:
        >>> from mkc_torch.diagnosis.result import DivergedBlock
        >>> held_out = HeldOut(0.3, (0.2, 0.4), 0.3, 0.3, "", {}, (DivergedBlock(7, before=True, after=False),), 25)
        >>> _diverged(held_out)
        'The open-loop simulation diverges in 1 of 25 blocks without the finding; no mean includes them.'
    """
    before, after = (sum(getattr(b, side) for b in held_out.diverged_blocks) for side in ("before", "after"))
    if not before and not after:
        return ""
    key = (
        (
            "The open-loop simulation diverges in {before} of {blocks} blocks without the finding, in "
            "{after} with it; no mean includes them."
        )
        if before and after
        else (
            "The open-loop simulation diverges in {before} of {blocks} blocks without the finding; no "
            "mean includes them."
        )
    )
    if after and not before:
        key = "The open-loop simulation diverges in {after} of {blocks} blocks with the finding; no mean includes them."
    return key.format(before=before, after=after, blocks=held_out.blocks)


def residuals(held_out: HeldOut, environment: NoiseEnvironment) -> list[str]:
    """Return one line per output: residual before and after, in its unit, with its noise floor.

    Example:
        >>> each = {"angle": ResidualSizes(0.02, 0.01, "rad"), "rate": ResidualSizes(0.3, 0.3, "rad/s")}
        >>> residuals(HeldOut(0.3, (0.2, 0.4), 0.3, 0.3, "", each), NoiseEnvironment())
        ['angle 0.0200 → 0.0100 rad (50 % less)', 'rate 0.300 → 0.300 rad/s (no change)']
        >>> residuals(HeldOut(0.3, (0.2, 0.4), 0.9, 0.5, "µT"), NoiseEnvironment())
        ['residual 0.900 → 0.500 µT (44 % less)']
    """
    if not held_out.outputs:
        text = improvement(held_out.rmse_before, held_out.rmse_after, held_out.unit)
        return [f"residual {text}"]
    return [_of_output(name, sizes, environment) for name, sizes in held_out.outputs.items()]


def _of_output(name: str, sizes: ResidualSizes, environment: NoiseEnvironment) -> str:
    text = improvement(sizes.before, sizes.after, sizes.unit)
    floor = next((fit.noise_floor for fit in environment.goodness_of_fit if fit.output == name), math.nan)
    if math.isfinite(floor):
        text = f"{text}, noise floor {size(floor)} {plain(sizes.unit)}".rstrip()
    return f"{plain(name)} {text}"


def residual_of_all(diagnosis: Diagnosis) -> list[str]:
    """Return the residuals without findings and with those that count; empty if none counts.

    Also empty if the residuals of the outputs are not known and outputs of several units share a number.
    """
    d = diagnosis
    if not any(counts(finding) for finding in d.findings):
        return []
    after = d.corrected.outputs
    both = {
        name: ResidualSizes(size.rmse, after[name].rmse, size.unit)
        for name, size in d.baseline.outputs.items()
        if name in after
    }
    if both:
        return [_of_output(name, sizes, d.environment) for name, sizes in both.items()]
    if len(d.traces.channels) > 1 and not d.traces.unit:
        return []
    text = improvement(d.baseline.rmse, d.corrected.rmse, d.traces.unit)
    return [f"residual {text}"]

"""A slow change of the offset with time: warm-up, relaxation, ageing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

SHARES = (0.05, 0.1, 0.2, 0.4)
"""Time constants to search, as shares of the recording's length."""

MIDDLES = (0.25, 0.5, 0.75)
"""Middles of a logistic drift to search, as shares of the recording's length."""

WIDTHS = (0.05, 0.12)
"""Widths of a logistic drift to search, as shares of the recording's length."""


class OffsetDrift(GainEffect):
    """Electronics that warm up, relax or age shift the sensor's offset slowly.

    Simulation: adds ``Δb s(t)`` to the sensor's axes, with a monotonic waveform s from 0 to 1 over the recording: a
    straight line; ``1 − exp(−t/τ)``, first-order warm-up; ``√t``, diffusion of heat; or a logistic curve, a transition
    within the recording.
    Drivers: none, it is bound to a time; a later recording has Δb throughout.
    Units: Δb in µT; the time constant, the middle and the width in s from the start of the recording.
    Plausible: up to 50 µT.
    Source: Newton's law of cooling; diffusion of heat into a half-space, in proportion to the square root of time.

    Example:
        >>> from mkc_torch.effects import Context
        >>> time = torch.arange(5.0)
        >>> context = Context(time, torch.zeros(5, 0), (), torch.zeros(5, 1), "µT", ("x",))
        >>> OffsetDrift().change(torch.tensor([4.0]), {"power": 0.5}, context).squeeze(-1)
        tensor([0.0000, 2.0000, 2.8284, 3.4641, 4.0000])
    """

    id = "offset_drift"
    gain = "offset_change"
    continuous: Mapping[str, tuple[float, float]] = {
        "time_constant": (0.02, 2.0),
        "middle": (0.05, 0.95),
        "width": (0.02, 0.3),
    }
    shape_units: Mapping[str, str] = dict.fromkeys(("time_constant", "middle", "width"), "s")
    equation = "δB = Δb s(t),  s from 0 to 1 over the recording"
    explanation = "The sensor's offset drifted slowly over the recording, as it does while electronics warm up."
    advice = "Let the sensor warm up before calibrating, or record its temperature."
    recurrence = "a warm-up comes again after a cold start"
    form_parameters = ("power",)
    plausible = 50.0
    plausible_unit = "µT"
    source = "first-order warm-up; diffusion of heat into a half-space goes with the square root of time"

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        length = float(time[-1] - time[0])
        exponential = [{"time_constant": length * share} for share in SHARES]
        logistic = [{"middle": length * m, "width": length * w} for m in MIDDLES for w in WIDTHS]
        return ({}, *exponential, {"power": 0.5}, *logistic)

    def equation_of(self, shape: Shape, context: Context) -> str:
        waveform = "t / T"
        if "time_constant" in shape:
            waveform = "(1 − exp(−t/τ)) / (1 − exp(−T/τ))"
        elif "middle" in shape:
            waveform = "(l(t) − l(0)) / (l(T) − l(0)),  l(t) = 1 / (1 + exp(−(t − middle) / width))"
        elif "power" in shape:
            waveform = "√(t / T)"
        length = sized(float(context.time[-1] - context.time[0]), "s")
        return f"δB = Δb s(t),  s(t) = {waveform},  t from the recording's start,  T = {length}"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        elapsed = context.time - context.time[0]
        length = elapsed[-1]
        if "time_constant" in shape:
            rate = 1.0 / shape["time_constant"]
            return torch.expm1(-rate * elapsed) / torch.expm1(-rate * length)
        if "middle" in shape:
            level = torch.sigmoid((elapsed - shape["middle"]) / shape["width"])
            return (level - level[0]) / (level[-1] - level[0])
        return (elapsed / length).pow(shape.get("power", 1.0))

    def lasting(self, gamma: Float[Tensor, " q"], context: Context) -> Float[Tensor, "N c"]:
        """The change that remains in a later recording of the sensor: the offset at the end."""
        return gamma.expand(len(context.time), -1)

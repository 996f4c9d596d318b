"""An actuator that acts by the square of its command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.share import ShareEffect

if TYPE_CHECKING:
    from jaxtyping import Float

_SCALE = "scale_of_input"


class InputSquare(ShareEffect):
    """The system is driven by the square of its input: thrust of a propeller, heat of a resistor, pull of a coil.

    A simulation that is linear in such an input is right at one amplitude only: it overestimates small commands. At the
    largest input of the recording the effect is 0, so the simulation's own gain keeps its value there.

    Simulation: adds ``γ (u |u| / c − u)`` to an input u, where c is its largest size in the recording; γ = 1 is the
        square, a smaller γ a mixture of a line and a square.
    Drivers: the input only.
    Units: γ is a share; c in the input's unit.
    Plausible: γ from 0 to 1.
    Source: thrust and torque of a propeller, Leishman, "Principles of Helicopter Aerodynamics" (2006), 2.3; Joule's
        law; static input nonlinearities, Ljung, "System Identification" (1999), 5.1 (Hammerstein models).
    """

    id = "input_square"
    form_parameters = (_SCALE,)
    relative: Mapping[str, tuple[str, str]] = {_SCALE: ("own", "largest")}
    plot_axis = "own"
    equation = "δu = γ (u |u| / c − u)"
    explanation = "The input acts by its square, as a voltage does on a propeller's thrust or on a heater."
    advice = "Replace the input by its square, u |u|, and fit its gain again."
    recurrence = "an input that acts by its square does little while it is small"
    source = (
        "Leishman, Principles of Helicopter Aerodynamics (2006), 2.3; Joule's law; Ljung, System Identification, 5.1"
    )

    def equation_of(self, shape: Shape, context: Context) -> str:
        return f"{self.equation},  c = {sized(float(shape[_SCALE]), context.unit_of('own'))}, the largest input"

    def shapes(self, time: object) -> Sequence[Shape]:
        return ({_SCALE: 1.0},)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own = context.part("own")
        return own * own.abs() / shape[_SCALE] - own

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own = names["own"]
        return (f"{gamma[0]!r} * ({own} * {own}.abs() / {shape[_SCALE]!r} - {own})",)

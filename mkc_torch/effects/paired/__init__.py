"""Effects between simulated and measured outputs: one piece of physics a file.

They act on outputs of simulations without a state of their own, :class:`mkc_torch.simulation.Static` and
:class:`mkc_torch.simulation.Paired`, whose ports have the part "compared". At the output of differential equations most
of them would only repeat an effect on a rate or an input, less well.
"""

from __future__ import annotations

from mkc_torch.effects.base import Effect
from mkc_torch.effects.paired.clock_drift import ClockDrift
from mkc_torch.effects.paired.delay import Delay, SeveralDelays
from mkc_torch.effects.paired.driver_friction import DriverFriction
from mkc_torch.effects.paired.driver_gain import DriverGain
from mkc_torch.effects.paired.driver_hysteresis import DriverBoucWen, DriverDahl
from mkc_torch.effects.paired.driver_linear import DriverLinear
from mkc_torch.effects.paired.driver_pair import DriverPair
from mkc_torch.effects.paired.driver_quadratic import DriverQuadratic
from mkc_torch.effects.paired.gain import Gain
from mkc_torch.effects.paired.gain_drift import GainDrift
from mkc_torch.effects.paired.gravity_sag import GravitySag, SeveralSag
from mkc_torch.effects.paired.offset import Offset, SeveralOffsets
from mkc_torch.effects.paired.output_backlash import OutputBacklash, SeveralBacklash
from mkc_torch.effects.paired.output_saturation import OutputSaturation
from mkc_torch.effects.periodic import Periodic

__all__ = ["PAIRED"]

PAIRED: tuple[Effect, ...] = (
    Gain(),
    Offset(),
    Delay(),
    ClockDrift(),
    OutputBacklash(),
    OutputSaturation(),
    GravitySag(),
    SeveralOffsets(),
    SeveralDelays(),
    SeveralBacklash(),
    SeveralSag(),
    DriverLinear(),
    DriverQuadratic(),
    DriverGain(),
    GainDrift(),
    DriverFriction(),
    DriverBoucWen(),
    DriverDahl(),
    DriverPair(),
    Periodic(),
)
"""The candidate effects for outputs of simulations without a state."""

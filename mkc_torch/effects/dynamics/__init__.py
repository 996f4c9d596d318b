"""Effects on the rates, inputs and outputs of differential equations: one piece of physics a file."""

from __future__ import annotations

from mkc_torch.effects.base import Effect
from mkc_torch.effects.dynamics.added_mass import AddedMass
from mkc_torch.effects.dynamics.backlash import Backlash
from mkc_torch.effects.dynamics.bouc_wen_hysteresis import BoucWenHysteresis
from mkc_torch.effects.dynamics.buoyancy import Buoyancy
from mkc_torch.effects.dynamics.constant_change import ConstantChange
from mkc_torch.effects.dynamics.constant_force import ConstantForce
from mkc_torch.effects.dynamics.coulomb_friction import CoulombFriction
from mkc_torch.effects.dynamics.coupling import Coupling
from mkc_torch.effects.dynamics.cubic_stiffness import CubicStiffness
from mkc_torch.effects.dynamics.dead_zone import DeadZone
from mkc_torch.effects.dynamics.driver_exchange import DriverExchange
from mkc_torch.effects.dynamics.driver_force import DriverForce
from mkc_torch.effects.dynamics.driver_input_gain import DriverInputGain
from mkc_torch.effects.dynamics.driver_output import DriverOutput
from mkc_torch.effects.dynamics.driver_output_lagged import DriverOutputLagged
from mkc_torch.effects.dynamics.driver_output_quadratic import DriverOutputQuadratic
from mkc_torch.effects.dynamics.driver_parameter import DriverParameter
from mkc_torch.effects.dynamics.driver_parameter_arrhenius import DriverParameterArrhenius
from mkc_torch.effects.dynamics.driver_parameter_quadratic import DriverParameterQuadratic
from mkc_torch.effects.dynamics.driver_rate_constant import DriverRateConstant
from mkc_torch.effects.dynamics.hard_stop import HardStop
from mkc_torch.effects.dynamics.hidden_lag import HiddenLag
from mkc_torch.effects.dynamics.hidden_mode import HiddenMode
from mkc_torch.effects.dynamics.input_delay import InputDelay
from mkc_torch.effects.dynamics.input_lag import InputLag
from mkc_torch.effects.dynamics.input_rate_limit import InputRateLimit
from mkc_torch.effects.dynamics.input_saturation import InputSaturation
from mkc_torch.effects.dynamics.input_square import InputSquare
from mkc_torch.effects.dynamics.input_transport_delay import InputTransportDelay
from mkc_torch.effects.dynamics.linear_drag import LinearDrag
from mkc_torch.effects.dynamics.load_dependent_friction import LoadDependentFriction
from mkc_torch.effects.dynamics.magnus_lift import MagnusLift
from mkc_torch.effects.dynamics.overflow import Overflow
from mkc_torch.effects.dynamics.overflow_into import OverflowInto
from mkc_torch.effects.dynamics.position_periodic_force import PositionPeriodicForce
from mkc_torch.effects.dynamics.power_law import PowerLaw
from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
from mkc_torch.effects.dynamics.sensor_clock_drift import SensorClockDrift
from mkc_torch.effects.dynamics.sensor_gain import SensorGain
from mkc_torch.effects.dynamics.sensor_lag import SensorLag
from mkc_torch.effects.dynamics.sensor_offset import SensorOffset
from mkc_torch.effects.dynamics.stribeck_friction import StribeckFriction
from mkc_torch.effects.dynamics.thermal_loss import ThermalLoss
from mkc_torch.effects.dynamics.unknown_near_ends import UnknownNearEnds
from mkc_torch.effects.dynamics.unknown_rate import UnknownRate
from mkc_torch.effects.periodic import PeriodicOutput, PeriodicRate

__all__ = ["DYNAMICS"]

DYNAMICS: tuple[Effect, ...] = (
    ConstantForce(),
    LinearDrag(to_surroundings=True),
    LinearDrag(),
    QuadraticDrag(),
    CoulombFriction(),
    StribeckFriction(),
    LoadDependentFriction(),
    CubicStiffness(),
    PositionPeriodicForce(),
    PowerLaw("difference"),
    PowerLaw("excess"),
    PowerLaw("position"),
    PowerLaw(),
    BoucWenHysteresis(),
    HiddenLag(),
    HiddenMode(),
    AddedMass(),
    Buoyancy(),
    Coupling(),
    MagnusLift(),
    DriverForce(),
    DriverExchange(),
    DriverRateConstant(to_surroundings=True),
    DriverRateConstant(),
    HardStop(),
    OverflowInto(),
    Overflow(),
    ThermalLoss(to_surroundings=True),
    ThermalLoss(),
    ConstantChange(),
    InputDelay(),
    InputTransportDelay(),
    InputLag(),
    InputSquare(),
    InputSaturation(),
    InputRateLimit(),
    DeadZone(),
    DriverInputGain(),
    DriverParameter(),
    DriverParameterQuadratic(),
    DriverParameterArrhenius(),
    Backlash(),
    DriverOutput(),
    DriverOutputQuadratic(),
    DriverOutputLagged(),
    SensorOffset(),
    SensorGain(),
    SensorLag(),
    SensorClockDrift(),
    PeriodicRate(),
    PeriodicOutput(),
    UnknownRate("difference"),
    UnknownRate("own"),
    UnknownRate("position"),
    UnknownNearEnds(),
)
"""The candidate effects for differential equations."""

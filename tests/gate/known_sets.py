"""The sets of effects that are known to act in recordings of the gate, with the shapes of fits by hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class KnownSet:
    """The effects that act in a recording.

    Attributes:
        suspect: the effects, as ``mkc diagnose --suspect`` accepts them.
        shapes: numbers of the shapes of fits by hand, by effect.
    """

    suspect: str
    shapes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


_HIDDEN_STORE = KnownSet("hidden_lag@indoor")
_DRAG = KnownSet("quadratic_drag@speed")

KNOWN_SETS: Mapping[str, KnownSet] = {
    "real house house_1 House": _HIDDEN_STORE,
    "real house house_2 House": _HIDDEN_STORE,
    "real so101 pan Servo": KnownSet(
        "backlash@command + input_delay@command", {"backlash": {"half_gap": 0.01}, "input_delay": {"delay": 0.09}}
    ),
    "real rocket juno Rocket": _DRAG,
    "real pendulum_encoder run Pendulum": KnownSet("coulomb_friction@speed + quadratic_drag@speed"),
    "real mug run Cooling": KnownSet("power_law@temp"),
    **{f"cases coloured_sensor {name} Rocket": _DRAG for name in ("white", "w2", "c05", "c2s", "coloured", "c2f")},
    "cases two_mass stiff_240 Drive": KnownSet(
        "hidden_mode@speed", {"hidden_mode": {"period": 0.2229, "damping": 0.0173}}
    ),
    "cases two_mass resonant_600 Drive": KnownSet("hidden_mode@speed"),
    "cases propeller_arm run Arm": KnownSet(
        "input_square@voltage + input_lag@voltage + input_delay@voltage",
        {"input_lag": {"lag": 0.09}, "input_delay": {"delay": 0.04}},
    ),
    "cases tanks fit Tanks": KnownSet("overflow@level1 + overflow@level1 and level2"),
    "cases coastdown runs Coast": _DRAG,
    "cases altitude runs Altitude": KnownSet("unknown@climb"),
    "cases heater runs Heater": KnownSet("power_law@temp", {"power_law": {"exponent": 1.5}}),
    "cases gear_motor runs GearMotor": KnownSet("coulomb_friction@speed"),
    "strangers motor_pendulum": KnownSet("coulomb_friction@speed + constant_force@speed"),
    "strangers quarter_drone": KnownSet(
        "input_square@command + coulomb_friction@speed + input_lag@command", {"input_lag": {"lag": 0.08}}
    ),
    "strangers battery_cell": KnownSet("input_lag@current", {"input_lag": {"lag": 86.0}}),
    "strangers groundwater_threshold": KnownSet("overflow@head", {"overflow": {"rim": 19.46}}),
    "strangers cogging_motor": KnownSet("coulomb_friction@speed + position_periodic_force@speed"),
    "strangers tilted_cart": KnownSet("constant_force@velocity + coulomb_friction@velocity"),
    "strangers sagging_battery": KnownSet("driver_input_gain@thrust(battery)"),
}
"""By the names of the gate's recordings."""

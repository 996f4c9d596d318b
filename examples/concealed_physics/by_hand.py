"""Known facts on each recording: the missing physics in words, and the result of a fit by hand.

The READMEs of the recordings give the sources.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class ByHand:
    """The missing physics in words, and the result of a fit by hand.

    Attributes:
        left_out: the missing physics, in words.
        sizes: parameters of the missing physics, as simulated or fitted by hand, by effect and name.
        parameters: parameters of the simulation.
        residual: RMS residual of the open-loop simulation of the fit by hand, by output.
        where: regions of the states in which the missing physics acts most, in the words of a diagnosis.
    """

    left_out: str = "nothing"
    sizes: Mapping[tuple[str, str], float] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    residual: Mapping[str, float] = field(default_factory=dict)
    where: Sequence[tuple[str, str]] = ()


FAST = (("speed", "above"), ("speed", "far from zero"), ("altitude", "below"))
"""A rocket that coasts is fast where it is low."""


def _coast(noise: float) -> ByHand:
    sizes = {("quadratic_drag", "drag"): 9.24e-5}
    return ByHand("quadratic drag", sizes, {"gravity": 9.81}, {"altitude": noise}, FAST)


_MODE = {("hidden_mode", "share"): 0.844, ("hidden_mode", "period"): 0.2229, ("hidden_mode", "damping"): 0.0173}
_LIGHT = ("Baseball", "Blue_Basketball", "Green_Basketball", "Orange_Whiffle_Ball", "Yellow_Whiffle_Ball")
_LIGHTER = ("Tennis_Ball", "Volleyball", "Whiffle_Ball_1", "Whiffle_Ball_2")
_FORCE = "no physics: an unrecorded force"

BY_HAND: Mapping[str, ByHand] = {
    "real house house_1 House": ByHand("a second thermal mass"),
    "real house house_2 House": ByHand("a second thermal mass"),
    "real so101 pan Servo": ByHand(
        "play and a delay", {("backlash", "half_gap"): 0.010, ("input_delay", "delay"): 0.09}, {}, {"pan": 0.0024}
    ),
    "real so101 recording": ByHand("play and a delay of the pan, sag of the lift", residual={"pan": 0.0024}),
    "real rocket juno Rocket": ByHand(
        "quadratic drag", {("quadratic_drag", "drag"): 9.2e-5}, {"gravity": 9.81}, {"altitude": 2.2}, FAST
    ),
    "real pendulum_encoder run Pendulum": ByHand(
        "dry friction, quadratic drag", {("coulomb_friction", "friction"): 0.206}, {}, {"angle": 0.0015}
    ),
    "real mug run Cooling": ByHand("a loss that rises steeply", residual={"temp": 0.09}, where=[("temp", "above")]),
    "cases coloured_sensor white Rocket": _coast(0.4),
    "cases coloured_sensor w2 Rocket": _coast(2.0),
    "cases coloured_sensor c05 Rocket": _coast(0.5),
    "cases coloured_sensor c2s Rocket": _coast(2.0),
    "cases coloured_sensor coloured Rocket": _coast(2.0),
    "cases coloured_sensor c2f Rocket": _coast(2.0),
    "cases two_mass stiff_240 Drive": ByHand("a flexible shaft", _MODE),
    "cases two_mass resonant_600 Drive": ByHand("a flexible shaft"),
    "cases propeller_arm run Arm": ByHand("a thrust that is not linear, and late", residual={"angle": 0.028}),
    "cases tanks fit Tanks": ByHand("an overflow", residual={"level2": 0.41}, where=[("level1", "above")]),
    "cases coastdown runs Coast": ByHand(
        "quadratic drag", {("quadratic_drag", "drag"): 0.00047}, where=[("speed", "above"), ("speed", "far from zero")]
    ),
    "cases ball_beam run Ball": ByHand("more than one piece: it hardly follows", residual={"position": 0.059}),
    "cases altitude runs Altitude": ByHand(
        "the ground's effect", {}, {"drag": 0.136}, {"height": 0.006}, [("height", "below"), ("height", "near zero")]
    ),
    "cases heater runs Heater": ByHand(
        "free convection", {("power_law", "exponent"): 1.5}, {"loss": 0.05}, {"temp": 0.15}
    ),
    "cases gear_motor runs GearMotor": ByHand("dry friction"),
    "cases simulated/pushed_slowly run Pendulum": ByHand(_FORCE),
    "cases simulated/pushed_white run Pendulum": ByHand(_FORCE),
    "cases simulated/gusts run Pendulum": ByHand(_FORCE),
    "cases simulated/unrelated run Pendulum": ByHand("all: the output is unrelated"),
    "cases simulated/held_input run UpsideDown": ByHand("gravity's sign is wrong"),
    **{f"data falling_balls {name} Ball": ByHand("air drag") for name in (*_LIGHT, *_LIGHTER)},
    "data heaters run_1s Heaters": ByHand("exchange between the heaters, a sensor's lag"),
    "data broad_34_attached_magnet_3cm": ByHand("a magnet that is taken off"),
    "data broad_36_attached_magnet_5cm": ByHand("a magnet that is taken off"),
    "data silverbox Silverbox": ByHand("a cubic spring", residual={"output": 0.000355}),
    "data servo Servo": ByHand("dry friction that grows with load"),
    "data broad_21_undisturbed_fast": ByHand("the room's field varies"),
    "data quadrotor_compass1": ByHand("the recorded heading jumps"),
    "data quadrotor_compass3": ByHand("the current's field"),
}
"""By name of the recording; in other recordings no physics is missing."""

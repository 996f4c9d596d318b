"""The physics of the effects on differential equations, and where they are tried."""

import math
from dataclasses import replace

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects import DYNAMICS
from mkc_torch.effects.dynamics.overflow_into import OverflowInto
from mkc_torch.simulation import Dynamics
from tests.effects.contexts import dynamic_context, size_of

IDS = (
    "constant_force", "linear_drag", "quadratic_drag", "coulomb_friction", "stribeck_friction",
    "load_dependent_friction", "cubic_stiffness", "position_periodic_force", "coupling", "hard_stop", "overflow",
    "thermal_loss", "input_delay", "input_saturation", "dead_zone", "sensor_lag", "backlash", "bouc_wen_hysteresis",
    "added_mass", "magnus_lift", "buoyancy", "hidden_lag", "hidden_mode", "power_law", "input_lag", "input_square",
)  # fmt: skip

LOSSES = ("linear_drag", "quadratic_drag", "coulomb_friction", "stribeck_friction", "load_dependent_friction")
EITHER_SIGN = ("constant_force", "cubic_stiffness", "position_periodic_force", "magnus_lift", "power_law")
SHARES = (
    "input_delay", "input_lag", "input_square", "input_saturation", "dead_zone", "sensor_lag", "backlash", "added_mass",
    "input_rate_limit",
)  # fmt: skip

N = 80


EFFECTS = pytest.mark.parametrize("effect", DYNAMICS, ids=lambda e: e.id)
EFFECT_BY_ID = {effect.id: effect for effect in DYNAMICS}


def change(effect, gamma, shape, context):
    return effect.change(torch.as_tensor(gamma, dtype=torch.float64), shape, context)


@pytest.mark.parametrize("name", LOSSES)
def test_losses_dissipate_energy(name):
    effect, context = EFFECT_BY_ID[name], dynamic_context(EFFECT_BY_ID[name])
    for shape in effect.shapes(context.time):
        for gamma in torch.eye(size_of(effect, shape, context), dtype=torch.float64):
            power = effect.change(gamma, shape, context)[:, 0] * context.part("own")
            assert float(power.max()) <= 0.0
            assert float(power.min()) < -1e-3
    assert (effect.lower, effect.upper) == (0.0, math.inf)


def test_signs_of_amplitudes():
    assert {e.id for e in DYNAMICS if e.lower == -math.inf} >= set(EITHER_SIGN)
    assert {e.id: e.upper for e in DYNAMICS if 1.0 < e.upper < math.inf} == {
        "hidden_lag": 100.0, "hidden_mode": 10.0, "driver_parameter_arrhenius": 2.0, "sensor_clock_drift": 5.0,
    }  # fmt: skip
    assert {e.id for e in DYNAMICS if (e.lower, e.upper) == (0.0, 1.0)} >= set(SHARES)
    for effect in DYNAMICS:
        assert effect.one_sided or effect.id in EITHER_SIGN or effect.id not in IDS


def test_effects_on_equations_depend_on_states_inputs_or_columns():
    driven = {effect.id for effect in DYNAMICS if effect.roles and not effect.driver_optional}
    assert driven == {
        "driver_force", "driver_exchange", "driver_rate_constant", "driver_input_gain",
        "driver_parameter", "driver_parameter_quadratic", "driver_parameter_arrhenius",
        "driver_output", "driver_output_quadratic", "driver_output_lagged", "input_transport_delay",
    }  # fmt: skip
    for effect in DYNAMICS:
        assert effect.follows_signal != (effect.id.startswith(("driver_output", "offset")) or effect.by_periodogram)
        assert all(low > 0.0 for low, _ in effect.fitted_shape.values())
        assert effect.plot_axis in ("", *dynamic_context(effect).parts)
        assert effect.equation.startswith("δ")


class TestPhysics:
    """Each formula at values that can be computed by hand."""

    @staticmethod
    def at(name, gamma, shape=None, **values):
        effect = EFFECT_BY_ID[name]
        context = dynamic_context(effect)
        carried = context.carries or context.channels
        row = torch.tensor([values.get(name, 0.0) for name in carried], dtype=torch.float64)
        return change(effect, gamma, shape or {}, replace(context, signal=row.expand(N, -1)))[0].tolist()

    def test_a_constant_force_is_its_amplitude(self):
        assert self.at("constant_force", [0.3], speed=-5.0) == [0.3]

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_drags_oppose_the_speed_by_its_power(self, sign):
        assert self.at("linear_drag", [0.3], speed=2.0 * sign) == pytest.approx([-0.6 * sign])
        assert self.at("quadratic_drag", [0.3], speed=2.0 * sign) == pytest.approx([-1.2 * sign])
        assert self.at("cubic_stiffness", [0.3], angle=2.0 * sign) == pytest.approx([-2.4 * sign])

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_friction_opposes_the_speed_independently_of_its_size(self, sign):
        for speed in (0.1, 10.0):
            braked = self.at("coulomb_friction", [0.3], {"width": 0.01}, speed=speed * sign)
            assert braked == pytest.approx([-0.3 * sign])
        shape = {"width": 0.01, "stribeck_speed": 1.0}
        assert self.at("stribeck_friction", [0.3, 0.2], shape, speed=10.0 * sign) == pytest.approx([-0.3 * sign])
        slow = -(0.3 + 0.2 * math.exp(-0.01)) * sign
        assert self.at("stribeck_friction", [0.3, 0.2], shape, speed=0.1 * sign) == pytest.approx([slow])
        loaded = self.at("load_dependent_friction", [0.3, 0.1], {"width": 0.01}, speed=sign, load=5.0)
        assert loaded == pytest.approx([-0.8 * sign])

    def test_a_position_periodic_force_is_a_sum_of_harmonics(self):
        force = self.at("position_periodic_force", [0.3, 0.2], {"order": 4.0}, angle=0.5)
        assert force == pytest.approx([0.3 * math.sin(2.0) + 0.2 * math.cos(2.0)])

    def test_exchange_reduces_the_difference(self):
        assert self.at("coupling", [0.3, 0.2], speed=1.0, other=3.0) == pytest.approx([0.6, -0.4])

    def test_stops_act_against_the_position(self):
        shape = {"place": 1.0, "exponent": 1.0}
        assert self.at("hard_stop", [5.0, 3.0], shape, angle=1.2) == pytest.approx([-1.0])
        assert self.at("hard_stop", [5.0, 3.0], shape, angle=-1.2) == pytest.approx([0.6])
        assert self.at("hard_stop", [5.0, 3.0], shape, angle=0.9) == [0.0]

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_integer_powers_equal_drags_and_springs(self, sign):
        """γ is the size at the scale; below a thousandth of the scale the curve is linear."""
        of = {(e.id, e.plot_axis, "surroundings" in e.needs): e for e in DYNAMICS}
        context = dynamic_context(EFFECT_BY_ID["power_law"])
        speed, angle, wind = (sign * context.component(name) for name in ("speed", "angle", "other"))
        context = replace(context, signal=sign * context.signal)
        for key, scale, exponent, expected in (
            (("power_law", "own", False), "scale_of_own", 1.0, -speed),
            (("power_law", "own", False), "scale_of_own", 2.0, -speed * speed.abs()),
            (("power_law", "own", True), "scale_of_difference", 1.0, wind - speed),
            (("power_law", "position", False), "scale_of_position", 3.0, -angle.pow(3)),
        ):
            found = change(of[key], [0.3 * 5.0**exponent], {scale: 5.0, "exponent": exponent}, context)[:, 0]
            exact = exponent == 1.0
            torch.testing.assert_close(found, 0.3 * expected, rtol=0.0, atol=1e-12 if exact else 1e-4)
        named = {
            e.id: change(e, [0.3], {}, context)[:, 0]
            for e in (EFFECT_BY_ID["linear_drag"], EFFECT_BY_ID["quadratic_drag"])
        }
        for name, exponent in (("linear_drag", 1.0), ("quadratic_drag", 2.0)):
            shape = {"scale_of_own": 5.0, "exponent": exponent}
            found = change(EFFECT_BY_ID["power_law"], [0.3 * 5.0**exponent], shape, context)[:, 0]
            torch.testing.assert_close(found, named[name], rtol=0.0, atol=1e-4)

    def test_losses_to_surroundings_vanish_at_equality(self):
        for name in ("linear_drag", "thermal_loss"):
            (effect,) = [e for e in DYNAMICS if e.id == name and "surroundings" in e.needs]
            context = dynamic_context(effect)
            (shape,) = effect.shapes(context.time)
            alike = context.signal.clone()
            alike[:, 1] = alike[:, 2]
            assert not bool(change(effect, [0.3], shape, replace(context, signal=alike)).any())
            lost = change(effect, [0.3], shape, context)[:, 0] * (context.part("own") - context.part("surroundings"))
            assert float(lost.max()) <= 0.0

    def test_overflow_acts_above_the_rim_only(self):
        assert self.at("overflow", [2.0], {"rim": 1.0, "exponent": 1.0}, speed=1.5) == pytest.approx([-1.0])
        assert self.at("overflow", [2.0], {"rim": 1.0, "exponent": 1.0}, speed=0.5) == [0.0]

    def test_another_vessel_catches_a_part_of_an_overflow(self):
        effect = OverflowInto()
        context = dynamic_context(effect)
        row = torch.tensor([{"speed": 1.5}.get(name, 0.0) for name in context.carries], dtype=torch.float64)
        shape = {"rim": 1.0, "exponent": 2.0}
        found = change(effect, [2.0, 0.4], shape, replace(context, signal=row.expand(N, -1)))
        assert found[0].tolist() == pytest.approx([-0.5, 0.1])

    def test_overflow_and_stops_are_powers_of_the_excess(self):
        for lost, exponent in ((0.5, 1.0), (0.5**1.5, 1.5), (0.5**2.5, 2.5)):
            shape = {"rim": 1.0, "exponent": exponent}
            assert self.at("overflow", [2.0], shape, speed=1.5) == pytest.approx([-2.0 * lost])
            shape = {"place": 1.0, "exponent": exponent}
            assert self.at("hard_stop", [2.0, 4.0], shape, angle=-1.5) == pytest.approx([4.0 * lost])

    def test_radiation_in_kelvin_or_celsius_is_a_linear_loss_near_room_temperature(self):
        effect = EFFECT_BY_ID["thermal_loss"]
        for unit, room in (("°C", 20.0), ("K", 293.15)):
            context = replace(dynamic_context(effect), part_units={"own": unit})
            hot = context.signal.new_tensor([0.0, room, 0.0, 0.0, 0.0]).expand(N, -1)
            assert float(change(effect, [1.0], {}, replace(context, signal=hot))[0]) == pytest.approx(0.0, abs=1e-9)
            hot = hot + hot.new_tensor([0.0, 0.01, 0.0, 0.0, 0.0])  # a linear loss near room temperature
            lost = float(change(effect, [1.0], {}, replace(context, signal=hot))[0])
            assert lost == pytest.approx(-0.01, rel=1e-3)

    def test_saturation_clips_and_a_dead_zone_shifts_the_input(self):
        limit, width = {"limit": 1.0, "softness": 0.01}, {"width": 1.0, "softness": 0.01}
        for u, limited, dead in ((3.0, 1.0, 2.0), (-3.0, -1.0, -2.0), (0.5, 0.5, 0.0)):
            assert u + self.at("input_saturation", [1.0], limit, force=u)[0] == pytest.approx(limited)
            assert u + self.at("dead_zone", [1.0], width, force=u)[0] == pytest.approx(dead, abs=1e-9)


def test_a_delay_interpolates_between_samples():
    effect = EFFECT_BY_ID["input_delay"]
    context = dynamic_context(effect)
    course = (3.0 * context.time + 1.0).unsqueeze(-1)
    for delay in (0.003, 0.1, 0.57):
        delayed = course + change(effect, [1.0], {"delay": delay}, replace(context, signal=course))
        expected = 3.0 * (context.time - delay).clamp(min=float(context.time[0])) + 1.0
        torch.testing.assert_close(delayed[:, 0], expected)


def test_a_delay_does_not_reach_into_another_run():
    """A run begins where time goes back, in steady state at its first value."""
    effect = EFFECT_BY_ID["input_delay"]
    time = torch.cat([torch.linspace(0.0, 2.0, 40), torch.linspace(0.0, 1.0, 40)]).double()
    course = torch.cat([7.0 + 0.0 * time[:40], 1.0 + time[40:]]).unsqueeze(-1)
    context = replace(dynamic_context(effect), time=time, signal=course)
    delayed = (course + change(effect, [1.0], {"delay": 0.3}, context))[:, 0]
    torch.testing.assert_close(delayed[:40], torch.full((40,), 7.0).double())
    torch.testing.assert_close(delayed[40:], 1.0 + (time[40:] - 0.3).clamp(min=0.0))


@pytest.mark.parametrize("name", ["input_delay", "input_lag", "sensor_lag", "backlash", "input_rate_limit"])
def test_runs_are_separated_by_their_number_for_any_clock(name):
    """On a common clock, and on separate clocks, the memory of a run ends with the run."""
    effect = EFFECT_BY_ID[name]
    first, second = torch.linspace(0.0, 2.0, 40).double(), torch.linspace(2.1, 3.9, 40).double()
    course = torch.cat([7.0 + torch.sin(5.0 * first), torch.cos(5.0 * second)]).unsqueeze(-1)
    run = torch.arange(2).repeat_interleave(40)
    shape = effect.shapes(first)[-1]
    for later in (second, second - 2.1):
        both = replace(dynamic_context(effect), time=torch.cat([first, later]), signal=course, run=run)
        together = change(effect, [1.0], shape, both)
        for part, time in ((slice(0, 40), first), (slice(40, 80), later)):
            alone = replace(both, time=time, signal=course[part], run=None)
            torch.testing.assert_close(together[part], change(effect, [1.0], shape, alone))


def test_an_actuator_lags_by_its_time_constant():
    effect = EFFECT_BY_ID["input_lag"]
    time = torch.linspace(0.0, 5.0, N, dtype=torch.float64)
    ramp = 3.0 * time.unsqueeze(-1)
    context = replace(dynamic_context(effect), time=time, signal=ramp)
    acting = (ramp + change(effect, [1.0], {"lag": 0.8}, context))[:, 0]
    torch.testing.assert_close(acting, 3.0 * (time - 0.8 * (1.0 - torch.exp(-time / 0.8))))
    assert effect.within_a_sample({"lag": 0.1}, 0.1)
    assert not effect.within_a_sample({"lag": 0.2}, 0.1)


def test_square_input_equals_the_largest_input_and_a_quarter_at_half():
    effect = EFFECT_BY_ID["input_square"]
    context = dynamic_context(effect)
    signal = torch.linspace(-4.0, 4.0, 5, dtype=torch.float64).unsqueeze(-1)
    context = replace(context, time=context.time[:5], drivers=context.drivers[:5], signal=signal)
    acting = (signal + change(effect, [1.0], {"scale_of_input": 4.0}, context))[:, 0]
    assert acting.tolist() == [-4.0, -1.0, 0.0, 1.0, 4.0]
    assert "c = 4 N, the largest input" in effect.equation_of({"scale_of_input": 4.0}, context)


def test_a_sensor_lags_by_its_time_constant():
    effect = EFFECT_BY_ID["sensor_lag"]
    time = torch.linspace(0.0, 5.0, N, dtype=torch.float64)
    ramp = 3.0 * time.unsqueeze(-1)
    context = replace(dynamic_context(effect), time=time, signal=ramp)
    shown = (ramp + change(effect, [1.0], {"lag": 0.8}, context))[:, 0]
    torch.testing.assert_close(shown, 3.0 * (time - 0.8 * (1.0 - torch.exp(-time / 0.8))))


def test_a_fast_clock_stretches_the_output_from_the_start_of_each_run():
    effect = EFFECT_BY_ID["sensor_clock_drift"]
    time = torch.cat([torch.linspace(3.0, 8.0, 101), torch.linspace(1.0, 5.0, 81)]).double()
    since = time - torch.where(torch.arange(182) < 101, 3.0, 1.0).double()
    course = (4.0 - 2.0 * since).unsqueeze(-1)
    context = replace(dynamic_context(effect), time=time, signal=course)
    shown = (course + change(effect, [2.0], {}, context))[:, 0]
    torch.testing.assert_close(shown, 4.0 - 2.0 * since / 1.02)


@pytest.mark.parametrize(
    ("name", "units"),
    [
        ("constant_force", ["m/s²"]),
        ("coulomb_friction", ["m/s²"]),
        ("stribeck_friction", ["m/s²", "m/s²"]),
        ("coupling", ["1/s"]),
        ("thermal_loss", ["1/s"]),
        ("sensor_lag", [""]),
        ("sensor_clock_drift", ["%"]),
    ],
)
def test_amplitudes_have_the_units_of_their_formulas(name, units):
    effect = EFFECT_BY_ID[name]
    context = replace(dynamic_context(effect), signal_unit="m/s²")
    shape = effect.shapes(context.time)[0]
    assert [quantity.unit for quantity in effect.quantities(shape, context)] == units


# where they are tried


class Pendulum(Dynamics):
    states = ("angle", "speed")
    parameters = {"stiffness": 9.0}
    units = {"angle": "rad", "speed": "rad/s"}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": -p.stiffness * torch.sin(x.angle)}


class Motor(Pendulum):
    inputs = ("torque",)

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": u.torque - p.stiffness * torch.sin(x.angle)}


class Fall(Dynamics):
    states = ("height", "speed")
    units = {"height": "m", "speed": "m/s"}

    def derivative(self, time, x, u, p):
        return {"height": x.speed, "speed": -9.81 + 0.0 * x.speed}


class Ball(Dynamics):
    states = ("x", "y", "vx", "vy")
    units = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}

    def derivative(self, time, x, u, p):
        return {"x": x.vx, "y": x.vy, "vx": 0.0 * x.vx, "vy": -9.81 + 0.0 * x.vy}


class Bodies(Dynamics):
    states = ("inner", "outer")
    parameters = {"loss": 0.1}
    units = {"inner": "°C", "outer": "°C"}

    def derivative(self, time, x, u, p):
        return {"inner": -p.loss * (x.inner - 20.0), "outer": -p.loss * (x.outer - 20.0)}


TIME = torch.arange(0.0, 6.0, 0.05, dtype=torch.float64)


def prepared(system, **columns):
    return system().prepare(Recording({"time": TIME, **columns}))


def effects_by_port(simulation):
    """Return the ids of the tried effects by port."""
    places = {}
    for term in candidate_terms(simulation, (), DYNAMICS):
        places.setdefault(term.port, set()).add(term.effect.id)
    return places


EVERYWHERE = {"constant_force", "linear_drag", "quadratic_drag", "power_law"}
REVERSING = {"coulomb_friction", "stribeck_friction"}


class TestNeeds:
    """Effects are tried only at ports that have the parts which they need."""

    @pytest.mark.e2e
    def test_effects_tried_on_a_pendulum(self):
        places = effects_by_port(prepared(Pendulum, angle=torch.cos(3.0 * TIME)))
        of_speed = EVERYWHERE | REVERSING | {"cubic_stiffness", "hard_stop", "position_periodic_force", "added_mass"}
        remembering = {"hysteretic rate of speed", "lagged rate of speed", "resonant rate of speed"}
        assert set(places) == {"rate of speed", "output", *remembering}
        assert places["hysteretic rate of speed"] == {"bouc_wen_hysteresis"}
        assert places["lagged rate of speed"] == {"hidden_lag"}
        assert places["resonant rate of speed"] == {"hidden_mode"}
        assert places["rate of speed"] & set(IDS) == of_speed
        assert places["output"] == {"sensor_lag"}

    def test_effects_tried_on_a_motor_with_an_input(self):
        places = effects_by_port(prepared(Motor, angle=torch.cos(3.0 * TIME), torque=torch.sin(TIME)))
        assert "load_dependent_friction" in set().union(*places.values())
        assert places["input torque"] == {
            "input_delay", "input_lag", "input_square", "input_saturation", "dead_zone", "backlash", "input_rate_limit",
        }  # fmt: skip

    def test_friction_and_hysteresis_are_not_tried_on_a_fall_without_reversal(self):
        places = effects_by_port(prepared(Fall, height=100.0 - 0.5 * TIME**2))
        assert places["rate of speed"] & set(IDS) == EVERYWHERE | {"hard_stop", "added_mass"}
        assert "hysteretic rate of speed" not in places

    def test_buoyancy_needs_a_height(self):
        assert "buoyancy" in effects_by_port(prepared(Fall, height=torch.cos(TIME)))["rate of speed"]

        class Sway(Fall):
            states = ("sway", "speed")
            units = {"sway": "m", "speed": "m/s"}

            def derivative(self, time, x, u, p):
                return {"sway": x.speed, "speed": -9.81 + 0.0 * x.speed}

        places = effects_by_port(prepared(Sway, sway=torch.cos(TIME)))
        assert "buoyancy" not in places["rate of speed"]

    def test_magnus_lift_is_tried_with_and_without_a_recorded_spin(self):
        fall = {"x": 20.0 * TIME, "y": 9.0 * TIME - 4.9 * TIME**2}
        assert effects_by_port(prepared(Ball, **fall))["exchange of vx and vy"] == {"coupling", "magnus_lift"}
        simulation = prepared(Ball, **fall, spin_z=50.0 - TIME)
        roles = frozenset(role for effect in DYNAMICS for role in effect.roles)
        drivers = find_drivers(simulation.recording, simulation.system.columns, DriverSettings(), roles)
        terms = [t for t in candidate_terms(simulation, drivers.drivers, DYNAMICS) if t.effect.id == "magnus_lift"]
        assert [term.columns for term in terms] == [(), ("spin_z",)]

    def test_magnus_lift_is_not_tried_on_angles(self):
        class Joints(Ball):
            units = {"x": "rad", "y": "rad", "vx": "rad/s", "vy": "rad/s"}

        assert effects_by_port(prepared(Joints, x=TIME, y=TIME))["exchange of vx and vy"] == {"coupling"}

    def test_losses_to_surroundings_are_tried_where_the_surroundings_are_an_input(self):
        class Room(Dynamics):
            states, inputs = ("inner", "wall"), ("power", "outside")
            parameters = {"loss": 0.1}
            units = {"inner": "°C", "wall": "°C"}

            def derivative(self, time, x, u, p):
                away = x.wall - x.inner
                return {"inner": u.power + away, "wall": p.loss * (u.outside - x.wall) - away}

        class Wind(Fall):
            inputs = ("wind", "drive")
            units = {"height": "m", "speed": "m/s", "wind": "m/s"}

        warm = {"inner": 30.0 + 0.0 * TIME, "wall": 20.0 + TIME, "power": TIME, "outside": 5.0 + 0.1 * TIME}
        room = prepared(Room, **warm)
        assert "surroundings" not in room.ports["rate of inner"].parts
        assert room.ports["rate of wall"].parts["surroundings"] == "outside"
        assert room.ports["rate of wall"].part_units["surroundings"] == "°C"
        assert room.ports["rate of wall"].sizes["surroundings"].highest == pytest.approx(15.0 + 0.9 * 5.95)
        forms = {(t.port, t.effect.of) for t in candidate_terms(room, (), DYNAMICS) if t.effect.id == "power_law"}
        # a power of a temperature in °C has no meaning
        assert forms == {("rate of wall", "difference"), ("rate of inner", "excess")}
        falling = prepared(Wind, height=100.0 - 0.5 * TIME**2, wind=TIME, drive=TIME)
        assert falling.ports["rate of speed"].parts["surroundings"] == "wind"
        forms = {t.effect.of for t in candidate_terms(falling, (), DYNAMICS) if t.effect.id == "power_law"}
        assert forms == {"difference", "own"}

    def test_effects_with_memory_are_not_tried_with_restarts(self):
        class Pieces(Pendulum):
            restart_after = 2.0

        assert set(prepared(Pieces, angle=torch.cos(3.0 * TIME)).ports) == {
            "rate of speed",
            "parameter stiffness",
            "output angle",
            "output",
        }

    def test_effects_tried_on_two_bodies_are_thermal(self):
        decay = torch.exp(-0.1 * TIME)
        places = effects_by_port(prepared(Bodies, inner=20.0 + 60.0 * decay, outer=20.0 + 20.0 * decay))
        assert places["exchange of inner and outer"] == {"coupling"}
        # heat can be stored elsewhere, and has no inertia
        assert places["lagged rate of inner"] == {"hidden_lag"}
        assert "resonant rate of inner" not in places
        assert places["rate of inner"] & set(IDS) == {"constant_force", "linear_drag", "thermal_loss", "power_law"}

    def test_needs_are_known_parts(self):
        known = {
            "own", "position", "angle", "deflection", "reversing", "load", "temperature", "level", "other level",
            "other", "rate", "height", "sideways", "flowing", "surroundings",
            "actuator", "driven", "stepped", "pace",
        }  # fmt: skip
        for effect in DYNAMICS:
            assert set(effect.needs) <= known


def test_shapes_are_in_the_units_of_the_recording():
    """A width is a share of the typical speed, the position of a stop a share of the largest deflection."""
    ports = {}
    for size in (1.0, 1000.0):
        simulation = prepared(Pendulum, angle=size * torch.cos(3.0 * TIME))
        ports[size] = {}
        for term in candidate_terms(simulation, (), DYNAMICS):
            ports[size].setdefault(term.effect.id, []).append(term.shape)
    for name, number, share in (("coulomb_friction", "width", 0.3 * 3.0 * math.sqrt(0.5)), ("hard_stop", "place", 0.5)):
        small, large = ports[1.0][name][0][number], ports[1000.0][name][0][number]
        assert small == pytest.approx(share, rel=0.1)
        assert large == pytest.approx(1000.0 * small, rel=1e-6)
    assert ports[1.0]["position_periodic_force"] == ports[1000.0]["position_periodic_force"]


@EFFECTS
def test_a_found_effect_acts_on_a_recording_with_fewer_parts(effect):
    """Conditions of the search, such as a reversal, are not required in another recording."""
    context = dynamic_context(effect)
    lasting = {"own", "position", "angle", "other", "load", "temperature", "rate", "surroundings"}
    fewer = {part: name for part, name in context.parts.items() if part in lasting}
    for shape in effect.shapes(context.time):
        gamma = torch.ones(size_of(effect, shape, context), dtype=torch.float64)
        again = replace(context, parts=fewer, part_units={part: context.part_units[part] for part in fewer})
        assert size_of(effect, shape, again) == len(gamma)
        assert torch.equal(effect.change(gamma, shape, again), effect.change(gamma, shape, context))

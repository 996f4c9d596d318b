"""A user's differential equations fitted to recordings with known truth, simulated by scipy."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.effects.dynamics.input_lag import InputLag
from mkc_torch.recording.recording import MissingColumnError
from mkc_torch.simulation import Dynamics, Parameter, SimulationError
from mkc_torch.simulation.dynamics import correction as dynamics_correction
from mkc_torch.simulation.dynamics import prepared as prepared_dynamics
from mkc_torch.simulation.dynamics import trajectory
from mkc_torch.simulation.dynamics.correction import DynamicsCorrection

STIFFNESS, DAMPING = 9.0, 0.15
FIRST = (1.2, 0.4)


class Pendulum(Dynamics):
    states = ("angle", "speed")
    parameters = {"stiffness": Parameter(7.0, lower=0.0), "damping": Parameter(0.5, lower=0.0, unit="1/s")}
    units = {"angle": "rad", "speed": "rad/s"}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": -p.stiffness * torch.sin(x.angle) - p.damping * x.speed}


def instance(system, **attributes):
    """Return an instance of a system with other attributes."""
    return type(system.__name__, (system,), attributes)()


def swings(time, first=FIRST, stiffness=STIFFNESS, damping=DAMPING, torque=lambda _: 0.0):
    """Angle and speed of a damped pendulum, (2, N)."""

    def rate(t, y):
        return [y[1], -stiffness * math.sin(y[0]) - damping * y[1] + torque(t)]

    return solve_ivp(rate, (time[0], time[-1]), first, t_eval=time, rtol=1e-9, atol=1e-10, max_step=0.05).y


def table(units=None, **columns):
    return Recording({name: torch.as_tensor(values) for name, values in columns.items()}, units=units)


def noisy(values, noise=0.01, outliers=0.0, seed=0):
    random = np.random.default_rng(seed)
    bad = random.random(values.shape) < outliers
    return values + noise * random.standard_normal(values.shape) + bad * random.standard_normal(values.shape)


def fitted_parameters(system, recording):
    """Fitted parameters by their names."""
    prepared = system.prepare(recording)
    fit = fitted(JointModel(prepared), prepared.start())
    return dict(zip(prepared.parameter_names, fit.parameters.tolist(), strict=True)), fit


TIME = np.arange(500) * 0.02
TRUTH = swings(TIME)


class TestFit:
    """Fits to a recording."""

    def test_a_pendulum_with_unmeasured_speed_and_outliers_is_fitted(self):
        values, fit = fitted_parameters(Pendulum(), table(time=TIME, angle=noisy(TRUTH[0], outliers=0.1)))
        assert values["stiffness"] == pytest.approx(STIFFNESS, abs=0.02)
        assert values["damping"] == pytest.approx(DAMPING, abs=0.01)
        assert values["angle at the start"] == pytest.approx(FIRST[0], abs=0.01)
        assert values["speed at the start"] == pytest.approx(FIRST[1], abs=0.03)
        assert float(fit.d) == pytest.approx(0.01, rel=0.2)

    @pytest.mark.e2e
    def test_the_position_is_fitted_where_only_the_speed_is_measured(self):
        values, _ = fitted_parameters(Pendulum(), table(time=TIME, speed=noisy(TRUTH[1], 0.02)))
        assert values["stiffness"] == pytest.approx(STIFFNESS, abs=0.03)
        assert values["angle at the start"] == pytest.approx(FIRST[0], abs=0.03)

    def test_two_measured_states_are_two_channels(self):
        recording = table(time=TIME, angle=noisy(TRUTH[0]), speed=noisy(TRUTH[1], 0.05))
        prepared = Pendulum().prepare(recording)
        assert prepared.channels == ("angle", "speed")
        assert prepared.unit == ""
        values, fit = fitted_parameters(Pendulum(), recording)
        assert values["stiffness"] == pytest.approx(STIFFNESS, abs=0.02)
        assert fit.d.tolist() == pytest.approx([0.01, 0.05], rel=0.2)

    def test_a_pendulum_with_irregular_samples_is_fitted(self):
        time = np.sort(np.random.default_rng(3).uniform(0.0, 10.0, 400))
        values, _ = fitted_parameters(Pendulum(), table(time=time, angle=noisy(swings(time)[0])))
        assert values["stiffness"] == pytest.approx(STIFFNESS, abs=0.02)
        assert values["damping"] == pytest.approx(DAMPING, abs=0.01)

    @pytest.mark.e2e
    def test_few_samples_a_period_are_refined(self):
        """Four samples a period: with a single step for each, the stiffness would be off by 10 %."""
        time = np.arange(60) * 0.5
        prepared = Pendulum().prepare(table(time=time, angle=swings(time)[0]))
        assert len(prepared.grid.time) > 60
        assert prepared.grid.time[prepared.rows].tolist() == pytest.approx(time.tolist())
        values, fit = fitted_parameters(Pendulum(), table(time=time, angle=swings(time)[0]))
        assert values["stiffness"] == pytest.approx(STIFFNESS, abs=0.01)
        assert float(fit.residual.abs().max()) < 0.01
        coarse, _ = fitted_parameters(instance(Pendulum, step=0.5), table(time=time, angle=swings(time)[0]))
        assert abs(coarse["stiffness"] - STIFFNESS) > 0.1

    def test_the_step_of_the_user_sets_the_grid(self):
        recording = table(time=TIME, angle=TRUTH[0])
        assert len(instance(Pendulum, step=0.02).prepare(recording).grid.time) == 500
        assert len(instance(Pendulum, step=0.005).prepare(recording).grid.time) == 4 * 499 + 1

    def test_experiments_share_parameters_but_not_initial_states(self):
        firsts = ((1.2, 0.4), (-0.6, 0.0), (0.3, 2.0))
        time = np.arange(150) * 0.02
        angle = np.concatenate([noisy(swings(time, first)[0], seed=k) for k, first in enumerate(firsts)])
        recording = table(time=np.tile(time, 3), angle=angle, experiment=np.repeat([0.0, 1.0, 2.0], 150))
        prepared = Pendulum().prepare(recording)
        assert prepared.parameter_names[2::2] == tuple(f"angle at the start of {k}" for k in range(3))
        assert float(prepared.time_since_start().max()) == pytest.approx(time[-1])
        values, _ = fitted_parameters(Pendulum(), recording)
        assert values["stiffness"] == pytest.approx(STIFFNESS, abs=0.05)
        for k, (angle_first, speed_first) in enumerate(firsts):
            assert values[f"angle at the start of {k}"] == pytest.approx(angle_first, abs=0.02)
            assert values[f"speed at the start of {k}"] == pytest.approx(speed_first, abs=0.06)

    def test_parameters_are_named_by_the_labels_of_experiments(self):
        recording = Recording(
            {
                "time": torch.arange(6.0),
                "angle": torch.tensor([0.1, 0.0, -0.1, 0.1, 0.0, -0.1]),
                "experiment": torch.tensor([0, 0, 0, 1, 1, 1]),
            },
            labels={"experiment": ("slow", "fast")},
        )
        assert Pendulum().prepare(recording).parameter_names[2] == "angle at the start of slow"

    def test_a_fitted_parameter_stays_within_its_bound(self):
        held = instance(
            Pendulum, parameters={"stiffness": Parameter(7.0, upper=8.5), "damping": Parameter(0.5, lower=0.2)}
        )
        values, _ = fitted_parameters(held, table(time=TIME, angle=TRUTH[0]))
        assert values["stiffness"] <= 8.5
        assert values["damping"] >= 0.2

    def test_unmeasured_states_start_at_the_initial_value_of_the_user(self):
        other = instance(Pendulum, initial={"angle": 0.7})
        start = other.prepare(table(time=TIME, speed=TRUTH[1])).start()
        assert float(start[2]) == 0.7
        assert float(start[3]) == pytest.approx(FIRST[1], abs=0.2)

    def test_rates_may_be_a_list_in_the_order_of_the_states(self):
        def derivative(self, time, x, u, p):
            return [x.speed, -p.stiffness * torch.sin(x.angle) - p.damping * x.speed]

        recording = table(time=TIME, angle=TRUTH[0])
        by_order, by_name = instance(Pendulum, derivative=derivative).prepare(recording), Pendulum().prepare(recording)
        torch.testing.assert_close(by_order.residual(by_name.start(), {}), by_name.residual(by_name.start(), {}))

    @pytest.mark.e2e
    def test_outputs_may_differ_from_the_states(self):
        def output(self, time, x, u, p):
            return {"tip": p.length * torch.sin(x.angle)}

        parameters = {**Pendulum.parameters, "length": Parameter(1.0, lower=0.0)}
        system = instance(Pendulum, outputs=("tip",), output=output, parameters=parameters, initial={"angle": 1.0})
        values, _ = fitted_parameters(system, table(time=TIME, tip=noisy(0.7 * np.sin(TRUTH[0]))))
        assert values["length"] == pytest.approx(0.7, abs=0.01)
        assert values["stiffness"] == pytest.approx(STIFFNESS, abs=0.05)

    def test_derivatives_by_the_parameters_match_finite_differences(self):
        prepared = Pendulum().prepare(table(time=TIME, angle=TRUTH[0]))
        theta = torch.tensor([STIFFNESS, DAMPING, *FIRST], dtype=torch.float64)
        slope = torch.func.jacfwd(lambda t: prepared.residual(t, {}))(theta)
        for k, direction in enumerate(1e-5 * torch.eye(4, dtype=torch.float64)):
            difference = prepared.residual(theta + direction, {}) - prepared.residual(theta - direction, {})
            torch.testing.assert_close(slope[..., k], difference / 2e-5, rtol=1e-4, atol=1e-5)

    def test_earlier_calls_do_not_change_a_residual(self):
        recording = table(time=TIME, angle=TRUTH[0])
        theta = torch.tensor([STIFFNESS, DAMPING, *FIRST], dtype=torch.float64)
        fresh, used = Pendulum().prepare(recording), Pendulum().prepare(recording)
        for factor in (1.3, 0.8, 1.001):
            used.residual(theta * factor, {})
        torch.func.jacfwd(lambda t: used.residual(t, {}))(theta * 1.01)
        torch.testing.assert_close(used.residual(theta, {}), fresh.residual(theta, {}), rtol=0.0, atol=1e-8)

    def test_the_residual_is_nan_without_a_trajectory(self):
        def derivative(self, time, x, u, p):
            return {"level": p.rate * x.level.square()}

        exploding = type("Exploding", (Dynamics,), {"states": ("level",), "parameters": {"rate": 0.1}})
        time = np.arange(100) * 0.02
        prepared = instance(exploding, derivative=derivative).prepare(table(time=time, level=1.0 / (1.0 - 0.1 * time)))
        assert bool(prepared.residual(torch.tensor([0.1, 1.0]).double(), {}).isfinite().all())
        assert bool(prepared.residual(torch.tensor([2.0, 1.0]).double(), {}).isnan().all())
        assert bool(prepared.residual(torch.tensor([0.1, 1.0]).double(), {}).isfinite().all())


# inputs


class Cell(Dynamics):
    states = ("charge",)
    inputs = ("current",)
    outputs = ("voltage",)
    parameters = {"rate": Parameter(0.0005, lower=0.0), "resistance": Parameter(0.05, lower=0.0)}
    initial = {"charge": 1.0}

    def derivative(self, time, x, u, p):
        return {"charge": -p.rate * u.current}

    def output(self, time, x, u, p):
        return {"voltage": x.charge - p.resistance * u.current}


class Driven(Pendulum):
    inputs = ("torque",)

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": u.torque - p.stiffness * torch.sin(x.angle) - p.damping * x.speed}


class TestInputs:
    """Interpolation of inputs between samples."""

    # two thirds of a second a period, six samples each
    time = np.arange(120) / 9.0

    @staticmethod
    def held(t):
        return 3.0 * math.copysign(1.0, math.sin(2.1 * math.floor(9.0 * t + 1e-9)))

    @staticmethod
    def smooth(t):
        return 3.0 * math.sin(3.0 * math.pi * t)

    def linear(self, t):
        return float(np.interp(t, self.time, [self.held(s) for s in self.time]))

    @pytest.mark.parametrize("course", ["held", "linear", "smooth"])
    def test_only_the_true_input_hold_fits(self, course):
        torque = getattr(self, course)
        angle = swings(self.time, (0.2, 0.0), torque=torque)[0]
        recording = table(time=self.time, angle=angle, torque=np.array([torque(t) for t in self.time]))
        theta = torch.tensor([STIFFNESS, DAMPING, 0.2, 0.0], dtype=torch.float64)
        sizes = {}
        for between in ("held", "linear", "smooth"):
            prepared = instance(Driven, input_hold=between, step=0.02).prepare(recording)
            sizes[between] = float(prepared.residual(theta, {}).abs().max())
        assert min(sizes, key=sizes.get) == course
        assert sizes[course] < 0.004
        assert sorted(sizes.values())[1] > 3.0 * sizes[course]

    def test_experiments_with_equal_times_do_not_share_inputs(self):
        """The polynomial at the end of a run must not use samples of the next run."""

        def derivative(self, time, x, u, p):
            return {"charge": p.gain * torch.exp(u.power) - p.loss * x.charge}

        time = np.linspace(0.0, 10.0, 101)
        exact = solve_ivp(
            lambda t, y: 2.0 * np.exp(np.sin(1.7 * t)) - 0.5 * y, (0.0, 10.0), [0.5], t_eval=time, rtol=1e-9
        )
        attributes = {"states": ("charge",), "inputs": ("power",), "parameters": {"gain": 1.5, "loss": 0.3}}
        heated = type("Heated", (Dynamics,), {**attributes, "input_hold": "smooth", "derivative": derivative})
        recording = table(
            time=np.tile(time, 2),
            power=np.tile(np.sin(1.7 * time), 2),
            charge=np.tile(exact.y[0], 2),
            experiment=np.repeat([0.0, 1.0], 101),
        )
        values, _ = fitted_parameters(heated(), recording)
        assert values["gain"] == pytest.approx(2.0, abs=1e-3)
        assert values["loss"] == pytest.approx(0.5, abs=1e-3)

    def test_short_runs_are_interpolated_by_straight_lines(self):
        time, torque = np.arange(5) * 0.1, np.array([0.0, 1.0, 0.0, 2.0, 0.0])
        prepared = instance(Driven, input_hold="smooth", step=0.1).prepare(
            table(time=time, angle=0.1 * time, torque=torque)
        )
        torch.testing.assert_close(prepared.inputs[1::3, 0], torch.tensor([0.5, 0.5, 1.0, 1.0]).double())


# chaotic systems


def lorenz(time):
    def rate(_, y):
        return [10.0 * (y[1] - y[0]), y[0] * (28.0 - y[2]) - y[1], y[0] * y[1] - 8.0 / 3.0 * y[2]]

    return solve_ivp(rate, (time[0], time[-1]), [1.0, 1.0, 20.0], t_eval=time, rtol=1e-10, atol=1e-10).y


class Lorenz(Dynamics):
    states = ("x", "y", "z")
    parameters = {"sigma": 9.0, "rho": 26.0, "beta": 3.0}

    def derivative(self, time, x, u, p):
        return {"x": p.sigma * (x.y - x.x), "y": x.x * (p.rho - x.z) - x.y, "z": x.x * x.y - p.beta * x.z}


class TestSegments:
    """Runs split into segments."""

    time = np.arange(1500) * 0.01

    @pytest.mark.e2e
    def test_a_chaotic_recording_is_fitted_in_segments_only(self):
        recording = table(time=self.time, **dict(zip("xyz", noisy(lorenz(self.time), 0.1), strict=True)))
        values, fit = fitted_parameters(instance(Lorenz, restart_after=1.0), recording)
        assert [values[name] for name in ("sigma", "rho", "beta")] == pytest.approx([10.0, 28.0, 8.0 / 3.0], rel=0.01)
        assert fit.d.tolist() == pytest.approx([0.1] * 3, rel=0.2)
        whole = instance(Lorenz).prepare(recording)
        theta = torch.tensor([10.0, 28.0, 8.0 / 3.0, *whole.measured[0].tolist()], dtype=torch.float64)
        left = whole.residual(theta, {})
        assert not bool(left.isfinite().all()) or float(left.abs().max()) > 5.0

    def test_segments_are_named_by_their_time(self):
        names = instance(Pendulum, restart_after=2.0).prepare(table(time=TIME, angle=TRUTH[0])).parameter_names
        assert names[2::2] == tuple(f"angle at the start, {k} s" for k in (0, 2, 4, 6, 8))

    @pytest.mark.parametrize("more", [0, 1, 2, 3])
    def test_a_short_remainder_joins_the_segment_before(self, more):
        time = np.arange(100 + more) * 0.02
        prepared = instance(Pendulum, restart_after=1.0).prepare(table(time=time, angle=swings(time)[0]))
        assert int(prepared.begins.sum()) == (3 if more == 3 else 2)

    def test_every_experiment_is_split(self):
        time = np.arange(101) * 0.02
        recording = table(
            time=np.tile(time, 2), angle=np.tile(swings(time)[0], 2), experiment=np.repeat([0.0, 1.0], 101)
        )
        prepared = instance(Pendulum, restart_after=1.0).prepare(recording)
        assert prepared.begins.nonzero().squeeze(-1).tolist() == [0, 50, 101, 151]
        assert prepared.labels == [" of 0, 0 s", " of 0, 1 s", " of 1, 0 s", " of 1, 1 s"]


# ports


class Tanks(Dynamics):
    states = ("upper", "lower")
    inputs = ("pump",)
    parameters = {"inflow": 1.0, "drain": Parameter(0.3, lower=0.0)}
    units = {"upper": "m", "lower": "m", "pump": "V"}

    def derivative(self, time, x, u, p):
        return {"upper": p.inflow * u.pump - p.drain * x.upper, "lower": -p.drain * x.lower}


class TestPorts:
    """Ports, and the signals that effects at them can refer to."""

    def pendulum(self, **attributes):
        return instance(Pendulum, **attributes).prepare(table(time=TIME, angle=TRUTH[0])).ports

    def test_ports_of_a_pendulum(self):
        ports = self.pendulum()
        # the rate of the angle is the speed by definition and has no port
        kinds = ("rate", "hysteretic rate", "lagged rate", "resonant rate")
        own = ("parameter stiffness", "parameter damping", "output angle")
        assert list(ports) == [*(f"{kind} of speed" for kind in kinds), *own, "output"]
        port = ports["rate of speed"]
        assert (port.kind, port.channels, port.unit, port.pointwise) == ("rate", ("speed",), "rad/s/s", False)
        assert port.carries == ("angle", "speed", "rate of speed")
        assert {part: port.parts[part] for part in ("own", "position", "angle", "deflection", "reversing")} == {
            "own": "speed", "position": "angle", "angle": "angle", "deflection": "angle", "reversing": "speed",
        }  # fmt: skip
        assert port.part_units["position"] == "rad"
        size = port.sizes["own"]
        assert size.typical == pytest.approx(np.median(np.abs(TRUTH[1])), rel=0.1)
        assert size.largest == pytest.approx(np.abs(TRUTH[1]).max(), rel=0.1)
        assert (size.lowest, size.highest) == pytest.approx((TRUTH[1].min(), TRUTH[1].max()), rel=0.1)

    def test_only_positions_in_rad_are_angles(self):
        assert "angle" not in self.pendulum(units={"angle": "m"})["rate of speed"].parts

    def test_signals_of_constant_sign_are_neither_deflection_nor_reversing(self):
        time = np.arange(100) * 0.02
        recording = table(time=time, angle=1.0 + time, speed=np.ones(100))
        parts = Pendulum().prepare(recording).ports["rate of speed"].parts
        assert "position" in parts
        assert not {"deflection", "reversing"} & set(parts)

    def test_ports_of_two_tanks(self):
        time = np.arange(50) * 0.1
        recording = table(time=time, upper=1.0 + 0 * time, lower=np.exp(-0.3 * time), pump=0.3 + 0.1 * np.sin(time))
        ports = Tanks().prepare(recording).ports
        rates = [
            f"{kind} of {state}" for state in ("upper", "lower") for kind in ("rate", "lagged rate", "resonant rate")
        ]
        own = ("parameter inflow", "parameter drain", "output upper", "output lower")
        names = [*rates, "exchange of upper and lower", "input pump", *own, "output"]
        assert list(ports) == names
        both = ports["exchange of upper and lower"]
        assert (both.channels, both.kind, dict(both.parts)) == (
            ("upper", "lower"), "exchange",
            {"own": "upper", "other": "lower", "level": "upper", "other level": "lower"},
        )  # fmt: skip
        assert ports["rate of upper"].parts["level"] == "upper"
        assert ports["rate of upper"].unit == "m/s"
        pump = ports["input pump"]
        assert (pump.kind, pump.channels, pump.unit) == ("input", ("pump",), "V")
        assert pump.sizes["own"] == pytest.approx((0.3, 0.4, 0.2, 0.4), rel=0.1)
        assert ports["output"].channels == ("upper", "lower")
        assert ports["output"].unit == "m"
        units = {name: ports["output"].part_units[part] for part, name in ports["output"].parts.items()}
        assert units == {"upper": "m", "lower": "m"}

    def test_states_of_different_units_have_no_exchange_port(self):
        time = np.arange(50) * 0.1
        recording = table(time=time, upper=np.exp(-time), lower=np.exp(-time), pump=0 * time)
        ports = instance(Tanks, units={"upper": "m", "lower": "°C"}).prepare(recording).ports
        assert not [name for name in ports if name.startswith("exchange")]
        assert ports["rate of lower"].parts["temperature"] == "lower"

    def test_effects_act_at_their_port(self):
        time = np.arange(50) * 0.1
        recording = table(time=time, upper=np.exp(-0.3 * time), lower=np.exp(-0.3 * time), pump=0 * time)
        prepared = Tanks().prepare(recording)
        theta = torch.tensor([1.0, 0.3, 1.0, 1.0], dtype=torch.float64)
        before = prepared.simulated(theta, {})
        torch.testing.assert_close(before, prepared.measured, rtol=0.0, atol=1e-5)

        def moved(port, change):
            return prepared.simulated(theta, {port: change}) - before

        rate = moved("rate of lower", lambda s: 0.3 * s[:, [1]])  # stops the drain
        torch.testing.assert_close(rate[:, 1], 1.0 - before[:, 1], rtol=0.0, atol=1e-6)
        assert float(rate[:, 0].abs().max()) == pytest.approx(0.0, abs=1e-9)
        exact = torch.from_numpy((1.0 - np.exp(-0.3 * time)) / 0.3)
        pumped = moved("input pump", lambda s: torch.ones_like(s))
        torch.testing.assert_close(pumped[:, 0], exact, rtol=0.0, atol=1e-5)
        even = moved("exchange of upper and lower", lambda s: torch.stack([s[:, 0], -s[:, 0]], -1) * 0.0 + 1.0)
        torch.testing.assert_close(even, torch.stack([exact, exact], -1), rtol=0.0, atol=1e-5)
        shown = moved("output", lambda s: 0.5 * s)
        torch.testing.assert_close(shown, 0.5 * before)

    def test_signals_equal_those_passed_to_effects(self):
        prepared = instance(Driven, step=0.02).prepare(table(time=TIME, angle=TRUTH[0], torque=np.sin(TIME)))
        theta = torch.tensor([STIFFNESS, DAMPING, *FIRST], dtype=torch.float64)
        seen = {}

        def look(name):
            def change(signal):
                seen[name] = signal.detach().clone()
                return torch.zeros_like(signal[:, :1])

            return change

        prepared.residual(theta, {name: look(name) for name in prepared.ports})
        signals = prepared.signals(theta, {})
        for name, port in prepared.ports.items():
            assert signals[name].shape[1] == len(port.carries or port.channels)
            torch.testing.assert_close(signals[name], seen[name], rtol=0.0, atol=1e-4)
        assert prepared.ports["rate of speed"].clock.time.shape == signals["rate of speed"][:, 0].shape

    def test_the_load_is_the_drive_minus_the_holding_forces(self):
        """A motor that is switched on has a braking torque by its back-EMF."""

        def derivative(self, time, x, u, p):
            braking = (p.damping + 2.0 * u.enabled) * x.speed
            return {"angle": x.speed, "speed": 5.0 * u.drive - braking - p.stiffness * x.angle}

        system = instance(Pendulum, inputs=("drive", "enabled"), derivative=derivative)
        inputs = {"drive": np.sin(TIME), "enabled": (TIME > 2.0).astype(float)}
        prepared = system.prepare(table(time=TIME, angle=TRUTH[0], **inputs))
        signals = prepared.signals(torch.tensor([STIFFNESS, DAMPING, *FIRST], dtype=torch.float64), {})
        angle, speed, drive, enabled, load = signals["loaded rate of speed"].unbind(-1)
        torch.testing.assert_close(load, (5.0 * drive - 2.0 * enabled * speed + STIFFNESS * angle).abs())
        assert float((2.0 * enabled * speed).abs().max()) > 0.1


# a model on a new recording


class TestCorrection:
    """Predictions by a fitted model from the start of a recording."""

    def test_a_new_recording_is_predicted_from_its_first_second(self):
        theta = torch.tensor([STIFFNESS, DAMPING, 0.0, 0.0], dtype=torch.float64)
        truth = swings(TIME, (-0.9, 1.5))[0]
        measured = noisy(truth, 0.01, outliers=0.1)
        measured[TIME > 1.0] = 0.0  # later samples are not used
        columns = DynamicsCorrection(Pendulum().prepare(table(time=TIME, angle=measured)), first=1.0).corrected(
            theta, {}
        )
        assert list(columns) == ["time", "angle"]
        assert float((columns["angle"] - torch.from_numpy(truth)).abs().max()) < 0.03

    def test_each_experiment_is_predicted_from_its_own_first_second(self):
        theta = torch.tensor([STIFFNESS, DAMPING], dtype=torch.float64)
        truths = np.concatenate([swings(TIME, first)[0] for first in ((-0.9, 1.5), (0.3, 0.0))])
        recording = table(time=np.tile(TIME, 2), angle=noisy(truths), experiment=np.repeat([0.0, 1.0], 500))
        columns = DynamicsCorrection(Pendulum().prepare(recording), first=1.0).corrected(theta, {})
        assert float((columns["angle"] - torch.from_numpy(truths)).abs().max()) < 0.04

    def test_effects_are_part_of_the_prediction(self):
        theta = torch.tensor([STIFFNESS, DAMPING], dtype=torch.float64)
        recording = table(time=TIME, angle=swings(TIME, damping=DAMPING + 0.2)[0])
        correction = DynamicsCorrection(Pendulum().prepare(recording), first=1.0)
        with_it = correction.corrected(theta, {"rate of speed": lambda s: -0.2 * s[:, [1]]})
        without = correction.corrected(theta, {})
        assert float((with_it["angle"] - recording["angle"]).abs().max()) < 1e-3
        assert float((without["angle"] - recording["angle"]).abs().max()) > 0.1


@pytest.mark.parametrize(("first", "seconds"), [(None, [1.0, 3.0, 10.0]), (2.0, [2.0])])
def test_initial_states_are_estimated_over_growing_horizons(monkeypatch, first, seconds):
    """A pendulum simulated slightly too fast goes over the top; a fit to all samples does not recover from it."""
    correction = DynamicsCorrection(Pendulum().prepare(table(time=TIME, angle=TRUTH[0])), first=first)
    theta, calls = correction.prepared.start(), []

    def watched(_, start, *, weight, **__):
        calls.append((start, weight))
        return SimpleNamespace(theta=start + 0.01)

    monkeypatch.setattr(dynamics_correction, "fit", watched)
    correction.corrected(theta, {})
    starts, weights = zip(*calls, strict=True)
    length = float(TIME[-1] - TIME[0])
    for weight, until in zip(weights, seconds, strict=True):
        until = until * length / 10.0 if first is None else until
        assert torch.equal(weight, torch.as_tensor(TIME - TIME[0] <= until + 1e-9).double())
    for k, start in enumerate(starts):
        torch.testing.assert_close(start, theta[2:] + 0.01 * k)


class Block(Dynamics):
    """A block pulled by a spring over a table to which it sticks, except for a creep of 0.5 mm/s."""

    states = ("place", "speed")
    inputs = ("pull",)
    outputs = ("place",)
    parameters = {"friction": Parameter(20.0, lower=0.0)}
    step = 0.02

    def derivative(self, time, x, u, p):
        spring = 200.0 * torch.clamp(u.pull - x.place, -0.3, 0.3)
        return {"place": x.speed, "speed": spring - x.speed - p.friction * torch.tanh(x.speed / 0.0005)}


def sticking_positions(pull):
    """Return the positions of a block that sticks fully, by short steps; the pull is held between samples."""
    place, speed, places = 0.0, 0.0, []
    for now in pull:
        places.append(place)
        for _ in range(200):
            free = speed + 1e-4 * (200.0 * np.clip(now - place, -0.3, 0.3) - speed)
            speed = math.copysign(max(abs(free) - 20.0 * 1e-4, 0.0), free)
            place += 1e-4 * speed
    return np.array(places)


@pytest.mark.e2e
def test_a_sticking_simulation_is_solved_over_a_horizon_of_small_strides(monkeypatch):
    """Friction is nearly a jump: no trajectory is found from the guess, but the correction needs a trajectory."""
    time = np.arange(80) * 0.02
    pull = 0.6 * np.sin(1.1 * time) + 0.3 * np.sign(np.sin(0.7 * time))
    truth = sticking_positions(pull)
    correction = DynamicsCorrection(Block().prepare(table(time=time, pull=pull, place=noisy(truth, 0.003))), first=0.3)
    theta = correction.prepared.start()
    assert not correction.prepared.trajectory(theta, {}).converged
    with monkeypatch.context() as without:
        without.setattr(prepared_dynamics.PreparedDynamics, "_marched", lambda *_: None)
        with pytest.raises(SimulationError, match=r"no trajectory was found.*`step`"):
            correction.corrected(theta, {})
    # the initial states as measured
    monkeypatch.setattr(dynamics_correction, "fit", lambda _, start, **__: SimpleNamespace(theta=start))
    place = correction.corrected(theta, {})["place"]
    # the pull is interpolated linearly here, and held in the reference
    assert float((place - torch.from_numpy(truth)).abs().max()) < 0.1
    assert float((place - torch.from_numpy(truth)).abs().median()) < 0.03


# undetermined parameters


class Oscillator(Dynamics):
    """A mass on a spring; the motion depends on their quotient only."""

    states = ("place", "speed")
    parameters = {"mass": Parameter(2.0, lower=0.0), "spring": Parameter(15.0, lower=0.0), "damping": 0.1}
    units = {"place": "m", "speed": "m/s"}

    def derivative(self, time, x, u, p):
        return {"place": x.speed, "speed": -p.spring / p.mass * x.place - p.damping * x.speed}


class TestUndetermined:
    """Warnings about undetermined parameters, with the direction that leaves the residual unchanged."""

    recording = table(time=TIME[:200], place=np.cos(3.0 * TIME[:200]))

    def test_a_mass_and_a_spring_are_determined_as_a_quotient_only(self):
        (warning,) = Oscillator().prepare(self.recording).warnings
        assert warning.startswith("The recording does not determine `mass` and `spring` separately")
        assert "direction 0.71 mass + 0.71 spring, relative" in warning

    @pytest.mark.e2e
    def test_the_diagnosis_lists_the_quotient_before_the_search_and_not_as_a_warning(self):
        diagnosis = diagnose(instance(Oscillator, step=0.02), self.recording, effects=(), surrogates=19)
        assert [check.combination for check in diagnosis.checks if check.kind == "only together"] == ["mass / spring"]
        assert not any("does not determine" in warning for warning in diagnosis.warnings)

    def test_a_parameter_without_influence_is_named(self):
        idle = instance(Oscillator, parameters={**Oscillator.parameters, "mass": 1.0, "colour": 5.0})
        assert "The recording does not determine `colour`: whatever it is, the residual is the same." in (
            idle.prepare(self.recording).warnings
        )

    def test_determined_parameters_give_no_warning(self):
        assert Pendulum().prepare(table(time=TIME, angle=TRUTH[0])).warnings == ()
        at_rest = table(time=TIME, angle=swings(TIME, (0.5, 0.0), damping=0.0)[0])
        assert instance(Pendulum, parameters={"stiffness": 9.0, "damping": 0.0}).prepare(at_rest).warnings == ()

    def test_an_undetermined_initial_state_gives_no_warning(self):
        """A state without influence on the outputs is not a fault of the recording."""

        def derivative(self, time, x, u, p):
            return {"place": x.speed, "speed": -p.rate * x.place, "heat": -0.1 * x.heat}

        system = type(
            "Warm",
            (Dynamics,),
            {"states": ("place", "speed", "heat"), "parameters": {"rate": 8.0}, "derivative": derivative},
        )
        assert system().prepare(self.recording).warnings == ()


# actuators and sensors


class TestActuatorsAndSensors:
    """A user's own actuator and sensor."""

    def test_actuator_and_sensor_receive_the_runs(self):
        seen = {}

        def actuator(self, time, u, p, run):
            seen["run"] = run
            return {"torque": 2.0 * u.torque}

        def sensor(self, time, y, p, run):
            assert run.tolist() == [0] * 50 + [1] * 50
            return {"angle": y["angle"] + 0.5}

        time = np.arange(100) * 0.02
        recording = table(time=time, angle=0.0 * time, torque=np.sin(time), experiment=np.repeat([3.0, 5.0], 50))
        theta = torch.tensor([STIFFNESS, DAMPING, 0.1, 0.0, 0.2, 0.0], dtype=torch.float64)
        plain = instance(Driven, step=0.02).prepare(recording)
        own = instance(Driven, step=0.02, actuator=actuator, sensor=sensor).prepare(recording)
        doubled = plain.simulated(theta, {"input torque": lambda s: s})
        torch.testing.assert_close(own.simulated(theta, {}), doubled + 0.5)
        assert set(seen["run"].tolist()) == {0, 1}

    @pytest.mark.parametrize("hold", ["held", "linear"])
    def test_an_output_that_depends_on_an_input_has_the_input_that_acts(self, hold):
        """A cell's voltage falls with the current at once, behind the same lag or gain as its charge."""

        def actuator(self, time, u, p, run):
            return {"current": 2.0 * u.current}

        time = np.arange(100) * 0.5
        current = np.sin(time) + (time > 20.0)
        recording = table(time=time, voltage=0.0 * time, current=current, experiment=np.repeat([3.0, 5.0], 50))
        theta = torch.tensor([0.1, 0.3, 1.0, 0.8], dtype=torch.float64)
        plain = instance(Cell, input_hold=hold).prepare(recording)
        own = instance(Cell, input_hold=hold, actuator=actuator).prepare(recording)
        twice = instance(Cell, input_hold=hold).prepare(
            table(**{**recording.columns, "current": 2.0 * recording["current"]})
        )
        changed = plain.simulated(theta, {"input current": lambda s: s})
        torch.testing.assert_close(own.simulated(theta, {}), changed)
        kept = slice(0, -1) if hold == "held" else slice(None)  # a held input's last sample has no interval
        torch.testing.assert_close(changed[kept], twice.simulated(theta, {})[kept])

    @pytest.mark.e2e
    def test_a_lag_of_an_input_is_found_where_the_output_depends_on_the_input(self):
        """The current reaches a cell in part through a lag, and its voltage shows the current at once."""
        random = np.random.default_rng(3)
        time, lag, share = np.arange(500.0), 30.0, 0.4
        current = np.repeat([0.0, *random.choice([0.0, 1.0, 2.0], 24)], 20)
        late, charge, keep = np.zeros(500), np.ones(500), math.exp(-1.0 / lag)
        for k in range(499):
            away = late[k] - current[k]
            late[k + 1] = current[k] + away * keep
            charge[k + 1] = charge[k] - (current[k] + share * away * lag * (1.0 - keep)) / 2000.0
        voltage = noisy(charge - 0.05 * (current + share * (late - current)), noise=0.001, seed=4)
        system = instance(Cell, input_hold="held")
        recording = table(time=time, current=current, voltage=voltage)
        diagnosis = diagnose(system, recording, effects=(InputLag(),), surrogates=19, max_findings=1)
        assert diagnosis.verdict == "explained"
        sizes = {p.name: p for p in diagnosis.findings[0].parameters}
        assert sizes["share"].value == pytest.approx(share, abs=0.01)
        assert sizes["lag"].value == pytest.approx(lag, abs=1.5)

    def test_an_actuator_that_omits_an_input_raises(self):
        with pytest.raises(SimulationError, match=r"actuator does not return the input `torque`"):
            instance(Driven, actuator=lambda *_: {}).prepare(table(**VALID, torque=0.0 * TIME))


# invalid systems


def returning(value):
    def derivative(self, time, x, u, p):
        return value(x, p)

    return derivative


VALID = {"time": TIME, "angle": TRUTH[0]}

INVALID = {
    "a shape": (
        {"derivative": returning(lambda x, _: {"angle": x.speed, "speed": torch.ones(7)})},
        VALID,
        r"Pendulum.derivative: the rate of `speed` .*\(1497,\), .*\(7,\)",
    ),
    "a matrix": (
        {"derivative": returning(lambda x, _: {"angle": x.speed, "speed": x.angle.unsqueeze(-1)})},
        VALID,
        r"rate of `speed` .*\(1497, 1\)",
    ),
    "no tensor": (
        {"derivative": returning(lambda x, _: {"angle": x.speed, "speed": "fast"})},
        VALID,
        r"rate of `speed` .* str",
    ),
    "other names": (
        {"derivative": returning(lambda x, _: {"angle": x.speed, "velocity": x.angle})},
        VALID,
        r"returns rates of angle, velocity but the states are angle, speed; return one rate for each",
    ),
    "too few by name": (
        {"derivative": returning(lambda x, _: {"angle": x.speed})},
        VALID,
        r"returns rates of angle but the states are angle, speed",
    ),
    "too few in order": (
        {"derivative": returning(lambda x, _: [x.speed])},
        VALID,
        r"returns 1 rates for 2 states \(angle, speed\)",
    ),
    "nothing": ({"derivative": returning(lambda *_: None)}, VALID, r"derivative returns NoneType; return the rate"),
    "NaN": (
        {"derivative": returning(lambda x, p: {"angle": x.speed, "speed": p.stiffness * (x.angle - 1.1).sqrt()})},
        VALID,
        r"the rate of `speed` is nan at time 0\.\d+ s with angle = 1\.[01]\d*, speed = -\d.*; "
        r"parameters stiffness = 7, damping = 0\.5\. Keep it finite",
    ),
    "nothing measured": (
        {},
        {"time": TIME, "height": TRUTH[0]},
        r"none of its states \(angle, speed\) is a column of the recording, which has time, height\. Name what",
    ),
    "short": ({}, {"time": TIME[:2], "angle": TRUTH[0, :2]}, r"a run of 2 samples is too short .* at least 3"),
    "a short run": (
        {},
        {**VALID, "experiment": np.array([1.0, 1.0] + 498 * [2.0])},
        r"a run of 2 samples is too short",
    ),
    "short segments": ({"restart_after": 0.03}, VALID, r"too short .* or use longer segments"),
    "between": (
        {"input_hold": "cubic"},
        VALID,
        r"`input_hold` .*\"held\", \"linear\" or \"smooth\".*'cubic'",
    ),
    "twice": (
        {"parameters": {"angle": 1.0}},
        VALID,
        r"uses the name `angle` twice among states, inputs and parameters",
    ),
    "no states": ({"states": ()}, VALID, r"has no `states`; name them"),
    "no attribute": ({"parameters": {"spring rate": 1.0}}, VALID, r"`spring rate` cannot be an attribute"),
    "another output": (
        {"outputs": ("tip",), "output": lambda *_: {"top": torch.ones(1)}},
        {"time": TIME, "tip": TRUTH[0]},
        r"output does not return `tip`, which is in its outputs; it returns top",
    ),
    "an output's shape": (
        {"outputs": ("tip",), "output": lambda *_: {"tip": torch.ones(3)}},
        {"time": TIME, "tip": TRUTH[0]},
        r"Pendulum.output: `tip` should be a tensor of shape \(500,\)",
    ),
    "a square that overflows": (
        {},
        {"time": TIME, "angle": 1e200 * TRUTH[0]},
        r"column `angle` reaches .*e\+\d+, but at most 1e\+100 is allowed",
    ),
}


@pytest.mark.parametrize(("attributes", "columns", "message"), INVALID.values(), ids=INVALID)
def test_invalid_systems_raise_with_the_place_of_the_fault(attributes, columns, message):
    with pytest.raises(SimulationError, match=message):
        instance(Pendulum, **attributes).prepare(table(**columns))


def test_a_missing_input_is_named():
    with pytest.raises(MissingColumnError, match=r"there is no column `torque`; there are `time`, `angle`"):
        Driven().prepare(table(**VALID))


def test_a_system_without_a_derivative_raises():
    with pytest.raises(NotImplementedError, match=r"Empty has no `derivative\(self, time, x, u, p\)`"):
        type("Empty", (Dynamics,), {"states": ("angle",)})().prepare(table(**VALID))


def test_rows_that_are_not_finite_are_dropped():
    angle = TRUTH[0].copy()
    angle[[3, 40]] = np.nan
    prepared = Pendulum().prepare(table(time=TIME, angle=angle))
    assert len(prepared.time) == 498
    assert "Dropped 2 of 500" in prepared.recording.notes[0]


def test_solving_starts_from_a_trajectory_nearby(monkeypatch):
    """A trajectory that a fit reached gradually may not be reached again from other states."""
    started = []
    real = trajectory.solve

    def watched(rate, grid, begin, guess, known=None, jump=None):
        started.append((guess, known))
        return real(rate, grid, begin, guess, known, jump)

    prepared = Pendulum().prepare(table(time=TIME, angle=TRUTH[0]))
    first = torch.tensor([9.0, 0.1, 0.5, 0.0]).double()
    found = prepared.trajectory(first, {})
    monkeypatch.setattr(prepared_dynamics, "solve", watched)
    for near in (found, found.bare):
        again = prepared.trajectory(first, {}, near)
        torch.testing.assert_close(again.states, found.states, rtol=0.0, atol=1e-9)
    (_, linear), (guess, without) = started
    assert linear is found  # with its linearised equations
    assert without is None
    assert torch.equal(guess, found.states)


def test_an_unknown_name_raises_with_the_known_names():
    class Misspelt(Pendulum):
        def derivative(self, time, x, u, p):
            return {"angle": x.sped, "speed": -x.angle}

    with pytest.raises(AttributeError, match="there is no `sped` here; there is angle, speed"):
        Misspelt().prepare(table(time=TIME, angle=TRUTH[0]))


@pytest.mark.parametrize("what", ["states", "inputs", "outputs"])
def test_a_text_instead_of_names_raises(what):
    system = Pendulum()
    setattr(system, what, "angle")
    with pytest.raises(SimulationError, match=rf"`{what}` .* text 'angle'; write \('angle',\)"):
        system.prepare(table(time=TIME, angle=TRUTH[0]))

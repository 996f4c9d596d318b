import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects.paired.clock_drift import ClockDrift
from mkc_torch.effects.paired.delay import CommonDelay, Delay
from mkc_torch.nonlinear import load_forward_mode
from mkc_torch.recording.recording import MissingColumnError
from mkc_torch.simulation import Paired, SimulationError

COUNT = 400


def signal(time):
    return torch.sin(1.1 * time) + 0.6 * torch.sin(2.7 * time + 1.0) + 0.3 * torch.sin(0.31 * time)


def simulator(step=0.05, *, first=-2.0, last=22.0, **more):
    time = torch.arange(first, last, step, dtype=torch.float64)
    return Recording({"time": time, "y": signal(time)} | more, name="SIM")


def times():
    return torch.arange(COUNT, dtype=torch.float64) * 0.05


def recorded(values, **more):
    g = torch.Generator().manual_seed(2)
    noise = 0.03 * torch.randn(len(values), generator=g, dtype=torch.float64)
    noise[torch.rand(len(values), generator=g) < 0.05] += 0.8
    return Recording({"time": times(), "y": values + noise} | more, name="REC")


def temperature():
    return 20.0 + 4.0 * torch.sin(0.23 * times()) + 2.0 * torch.sin(0.71 * times())


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("values", "effect", "size"),
    [
        (lambda t: 1.06 * signal(t), "gain", 0.06),
        (lambda t: signal(t) + 0.05, "offset", 0.05),
        (lambda t: signal(t + 0.3), "delay", -0.3),
        (lambda t: signal(t).clamp(-1.0, 1.0), "output_saturation", 1.0),
    ],
    ids=["gain", "offset", "delay", "output_saturation"],
)
def test_effects_between_simulator_and_recording_are_found(values, effect, size):
    found = diagnose(Paired(simulator()), recorded(values(times())), surrogates=19, max_findings=1)
    assert found.verdict == "explained"
    assert found.findings[0].effect == effect
    assert found.findings[0].channels == ("y",)
    assert found.findings[0].parameters[0].value == pytest.approx(size, rel=0.2)


def test_a_driver_is_found_and_corrects_another_recording():
    drive = temperature()
    table = recorded(signal(times()) + 0.03 * (drive - 20.0), temperature=drive)
    found = diagnose(Paired(simulator()), table, surrogates=19, max_findings=1)
    first = found.findings[0]
    assert (first.effect, first.drivers) == ("driver_linear", ("temperature",))
    assert [p.name for p in first.parameters] == ["per_unit", "at_mean"]
    assert first.parameters[0].value == pytest.approx(0.03, abs=0.003)
    other = simulator(0.03)
    model = DiagnosedModel.from_json(found.model.to_json(), simulation=Paired(other))
    columns = model(Recording({"time": times(), "temperature": drive}))
    assert float((columns["y"] - table["y"]).abs().median()) < 0.035


@pytest.mark.e2e
def test_a_temperature_coefficient_is_found_and_corrects_another_recording():
    drive = temperature()
    table = recorded(signal(times()) * (1.0 + 0.02 * (drive - 25.0)), temperature=drive)
    found = diagnose(Paired(simulator()), table, surrogates=19, max_findings=1)
    first = found.findings[0]
    assert (first.effect, first.drivers) == ("driver_gain", ("temperature",))
    assert not any(not rival.separable for rival in first.alternatives)
    slope, at_mean = first.parameters
    assert slope.value == pytest.approx(0.02, abs=3.0 * slope.standard_error)
    assert at_mean.value == pytest.approx(0.02 * (float(drive.mean()) - 25.0), abs=3.0 * at_mean.standard_error)
    model = DiagnosedModel.from_json(found.model.to_json(), simulation=Paired(simulator(0.03)))
    columns = model(Recording({"time": times(), "temperature": drive}))
    assert float((columns["y"] - table["y"]).abs().median()) < 0.035


@pytest.mark.e2e
def test_a_drift_of_the_gain_is_found_and_its_last_value_is_kept():
    table = recorded(signal(times()) * (1.0 + 0.15 * times() / times()[-1]))
    found = diagnose(Paired(simulator()), table, surrogates=19, max_findings=1)
    (first,) = found.findings
    assert (first.effect, first.drivers) == ("gain_drift", ())
    assert first.parameters[0].value == pytest.approx(0.15, abs=3.0 * first.parameters[0].standard_error)
    model = DiagnosedModel.from_json(found.model.to_json(), simulation=Paired(simulator(0.03)))
    columns, notes = model.correct(Recording({"time": times()}))
    assert float((columns["y"] - 1.15 * signal(times())).abs().max()) < 0.06
    assert "its final change applies to all samples" in notes[0]


@pytest.mark.e2e
def test_clock_offsets_below_a_sample_are_not_findings():
    found = diagnose(Paired(simulator()), recorded(signal(times() + 0.02)), surrogates=19)
    assert found.verdict == "adequate"
    assert float(found.model.theta[0]) == pytest.approx(0.02, abs=0.006)


def with_effect(prepared, effect, port="output y"):
    """Return a joint model with a single effect."""
    return JointModel(prepared, (Term(effect, None, {}, port),))


def test_a_delay_is_complete_and_the_clock_offset_is_held():
    prepared = Paired(simulator()).prepare(recorded(signal(times() - 0.2)))
    model = with_effect(prepared, Delay())
    start = torch.tensor([-0.06, 0.0, 0.155], dtype=torch.float64)  # a clock with nearly its largest offset
    found = fitted(model, start, graduate=False)
    assert abs(float(found.parameters[0])) < 1e-6
    assert float(found.parameters[2]) == pytest.approx(0.2, abs=0.005)
    gammas, source = [found.parameters[2:]], Paired(simulator())
    saved = DiagnosedModel("simulated", prepared.state, found.parameters[:2], model.terms, gammas, source)
    corrected = saved(Recording({"time": times()}))["y"]
    assert torch.allclose(prepared.measured[:, 0] - corrected, found.residual[:, 0], atol=1e-9)


def test_a_delay_of_one_output_of_two_leaves_the_clock_free():
    both = Recording({"time": simulator()["time"], "y": simulator()["y"], "z": simulator()["y"].square()})
    recording = recorded(signal(times()), z=signal(times()).square() + 0.01)
    prepared = Paired(both).prepare(recording)
    alone, together = (
        with_effect(prepared, Delay()).prior.precision,
        with_effect(prepared, CommonDelay(), "all outputs").prior,
    )
    assert torch.equal(alone[:2], prepared.prior.precision)
    assert float(together.precision[0, 0] / prepared.prior.precision[0]) > 1e6
    apart = JointModel(prepared, tuple(Term(Delay(), None, {}, f"output {name}") for name in "yz"))
    assert float(apart.prior.precision[0, 0] / prepared.prior.precision[0]) > 1e6


def test_with_a_delay_only_the_mean_clock_offset_of_runs_is_held():
    def twice(table):
        columns = {name: torch.cat([values, values]) for name, values in table.columns.items()}
        return Recording(columns | {"experiment": torch.arange(2.0).double().repeat_interleave(len(table))})

    prepared = Paired(twice(simulator())).prepare(twice(recorded(signal(times()))))
    precision = with_effect(prepared, Delay()).prior.precision
    known = float(prepared.prior.precision[0])
    apart, mean = (precision.new_tensor(row) for row in ([1.0, -1.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]))
    assert float(apart @ precision @ apart) == pytest.approx(2.0 * known, rel=1e-6)
    assert float(mean @ precision @ mean) > 1e6 * known
    assert float(precision[2, 2]) == pytest.approx(float(prepared.prior.precision[2]))


def test_a_drift_is_complete_and_the_clock_rate_is_held():
    prepared = Paired(simulator()).prepare(recorded(signal(1.002 * times())))
    found = fitted(with_effect(prepared, ClockDrift(), "all outputs"), torch.tensor([0.0, 5e-5, 0.0019]).double())
    assert abs(float(found.parameters[1])) < 1e-8


def test_the_correction_uses_the_fitted_clocks():
    prepared = Paired(simulator()).prepare(recorded(signal(1.0001 * times() + 0.03)))
    theta = torch.tensor([0.04, 9e-5], dtype=torch.float64)
    corrected = DiagnosedModel("simulated", prepared.state, theta, (), (), Paired(simulator()))
    residual = prepared.measured[:, 0] - corrected(Recording({"time": times()}))["y"]
    assert torch.allclose(residual, prepared.residual(theta, {})[:, 0], atol=1e-12)
    older = DiagnosedModel("simulated", {"channels": ["y"]}, theta, (), (), Paired(simulator()))
    assert torch.allclose(older(Recording({"time": times()}))["y"], signal(times()), atol=1e-3)


def test_interpolation_reproduces_a_smooth_signal_and_its_slope():
    load_forward_mode()
    prepared = Paired(simulator(0.2)).prepare(recorded(signal(times())))
    at = times() + 0.013
    torch.testing.assert_close(prepared.curve.at(at)[:, 0], signal(at), rtol=0.0, atol=3e-3)
    slope = torch.func.jvp(lambda t: prepared.curve.at(t), (at,), (torch.ones_like(at),))[1][:, 0]
    expected = (signal(at + 1e-5) - signal(at - 1e-5)) / 2e-5
    torch.testing.assert_close(slope, expected, rtol=0.0, atol=0.06)


def test_derivatives_of_the_residual_agree_with_finite_differences():
    load_forward_mode()
    prepared = Paired(simulator()).prepare(recorded(signal(times())))
    theta = torch.tensor([0.004, 2e-5], dtype=torch.float64)
    forward = torch.func.jacfwd(lambda at: prepared.residual(at, {}))(theta)
    step = torch.tensor([1e-6, 1e-8], dtype=torch.float64)
    for k in range(2):
        change = step * torch.eye(2, dtype=torch.float64)[k]
        near = (prepared.residual(theta + change, {}) - prepared.residual(theta - change, {})) / (2.0 * step[k])
        torch.testing.assert_close(forward[..., k], near, rtol=1e-4, atol=1e-4 * float(near.abs().max()))


def test_equal_columns_of_both_tables_are_inputs():
    table = recorded(signal(times()))
    exact = Recording({"time": times(), "y": table["y"], "torque": torch.cos(times())})
    same = Recording({"time": times(), "y": signal(times()), "torque": torch.cos(times())})
    prepared = Paired(same).prepare(exact)
    assert prepared.channels == ("y",)
    assert "torque" in prepared.recording
    assert "`torque` is the same in both tables" in prepared.warnings[0]
    with pytest.raises(SimulationError, match="are the same in the recording and the simulated table"):
        Paired(same).prepare(same)


def test_runs_are_matched_by_their_labels():
    def joined(first, second, name, labels):
        run = torch.cat([torch.zeros(len(first)), torch.ones(len(second))])
        columns = {key: torch.cat([first[key], second[key]]) for key in ("time", "y")}
        return Recording(columns | {"experiment": run}, name=name, labels={"experiment": labels})

    second = Recording({"time": times(), "y": 2.0 * signal(times())})
    sim = simulator()
    doubled = Recording({"time": sim["time"], "y": 2.0 * sim["y"]})
    table = joined(recorded(signal(times())), second, "REC", ("b", "a"))
    prepared = Paired(joined(doubled, sim, "SIM", ("a", "b"))).prepare(table)
    assert prepared.parameter_names == ("clock offset of a", "clock offset of b", "clock rate")
    residual = prepared.residual(prepared.start(), {})
    assert float(residual[:COUNT].abs().median()) < 0.05
    assert float(residual[COUNT:].abs().max()) < 1e-3
    with pytest.raises(SimulationError, match="SIM has no run b; its column `experiment` has a, c"):
        Paired(joined(doubled, sim, "SIM", ("a", "c"))).prepare(table)


def test_samples_outside_the_simulated_times_are_excluded():
    prepared = Paired(simulator(first=0.0, last=15.0)).prepare(recorded(signal(times())))
    assert len(prepared.time) == 300
    assert (
        "100 of 400 samples lie outside the times that were simulated, 0 to 14.95 s" in prepared.recording.warnings[0]
    )


def test_tables_without_common_times_or_columns_are_refused():
    with pytest.raises(
        SimulationError, match=r"REC and SIM do not overlap in time: 0 to 19.95 s was recorded, 100 to "
    ):
        Paired(simulator(first=100.0, last=120.0)).prepare(recorded(signal(times())))
    with pytest.raises(SimulationError, match=r"no column in common to compare: z there, y here. Rename"):
        Paired(simulator()).prepare(Recording({"time": times(), "z": times()}, name="REC"))
    with pytest.raises(MissingColumnError, match="time"):
        Paired(simulator()).prepare(Recording({"y": times()}))
    with pytest.raises(MissingColumnError, match="time"):
        Paired(Recording({"y": times()}))
    with pytest.raises(ValueError, match=r"`rate`.*positive and finite.*got 0"):
        Paired(simulator(), rate=0.0)
    with pytest.raises(ValueError, match=r"`offset`.*positive and finite.*got -1"):
        Paired(simulator(), offset=-1)
    with pytest.raises(TypeError, match=r"`offset`.*number positive and finite.*got 'a'"):
        Paired(simulator(), offset="a")
    with pytest.raises(TypeError, match=r"`simulated`.*Recording.*got 'SIM\.csv'; read it, Recording\.read"):
        Paired("SIM.csv")
    with pytest.raises(TypeError, match=r"`recording`.*Recording.*got 'REC\.csv'; read it, Recording\.read"):
        Paired(simulator()).prepare("REC.csv")
    with pytest.raises(TypeError, match=r"`outputs`.*tuple of names of columns.*got 'y'; write \('y',\)"):
        Paired(simulator(), outputs="y")
    with pytest.raises(ValueError, match=r"`outputs` to name a column.*got none; None compares all common columns"):
        Paired(simulator(), outputs=())
    with pytest.raises(SimulationError, match="run of one sample"):
        Paired(Recording({"time": torch.zeros(1), "y": torch.zeros(1)})).prepare(recorded(signal(times())))

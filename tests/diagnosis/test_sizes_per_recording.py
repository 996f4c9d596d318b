"""Recordings diagnosed together: an effect has a common size, or a size for each recording where that scores higher."""

import importlib.util
import inspect
import json

import pytest
import torch

pytest.importorskip("jsonschema")
pytest.importorskip("polars")

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidates_of
from mkc_torch.diagnosis.model.suspect import suspect_id, suspected_terms
from mkc_torch.diagnosis.pipeline.prepare import joined, with_own_offsets
from mkc_torch.diagnosis.search.move_fits import fitted_in_form
from mkc_torch.diagnosis.search.moves import additions, one_form_each, special_cases
from mkc_torch.diagnosis.settings import NoiseSettings, Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.recording.recording import write_table
from mkc_torch.simulation import load_simulation
from tests.cli.commands import assert_refused, flat, mkc
from tests.diagnosis.vehicle import MASS, DraggedVehicle, Pendulum, Vehicle, coast_down, swing

SOURCE = f"from mkc_torch.simulation import Dynamics, Parameter\n\nMASS = {MASS}\n\n\n{inspect.getsource(Vehicle)}"


def vehicles(drags, seed):
    speeds = (30.0, 28.0)
    return [coast_down(d, v, seed + 100 * k, "AB"[k]) for k, (d, v) in enumerate(zip(drags, speeds, strict=True))]


def fitted_vehicle(drags=(0.0067, 0.020), seed=1):
    """Return the fit of the vehicle alone, and its candidates of two effects."""
    recordings = vehicles(drags, seed)
    prepared = with_own_offsets(Vehicle().prepare(joined(Vehicle(), recordings)[0]), recordings)
    prepared = prepared.with_input_hold({"force": "held"})
    fit = fitted(JointModel(prepared), prepared.start())
    effects = [effect for effect in CATALOGUE if effect.id in ("quadratic_drag", "input_delay")]
    return fit, candidates_of(Vehicle(), prepared, effects, Settings().drivers)[1]


def test_only_effects_with_a_size_are_candidates_in_both_forms_and_only_for_several_recordings():
    fit, terms = fitted_vehicle()
    assert {term.key[0] for term in terms} == {"quadratic_drag", "quadratic_drag_per_recording", "input_delay"}
    alone = Vehicle().prepare(vehicles((0.0067, 0.020), 1)[0])
    effects = [effect for effect in CATALOGUE if effect.id == "quadratic_drag"]
    assert {term.key[0] for term in candidates_of(Vehicle(), alone, effects, Settings().drivers)[1]} == {
        "quadratic_drag"
    }
    assert fit.model.prepared.recordings == ("A", "B")


def test_the_forms_of_one_effect_are_exchanged_and_never_both_in_a_model():
    fit, terms = fitted_vehicle()
    found = additions(fit, terms, NoiseSettings())
    assert {addition.key[0] for addition in found} > {"quadratic_drag", "quadratic_drag_per_recording"}
    # two sizes gain far more than the price of a further number
    (drag,) = [a for a in one_form_each(found, lambda a: a.gain - len(a.starts[0][1])) if "drag" in a.key[0]]
    assert drag.key[0] == "quadratic_drag_per_recording"
    common = next(term for term in terms if term.key[0] == "quadratic_drag")
    (own,) = special_cases(common, terms, fit.model.prepared)
    assert own.key[0] == "quadratic_drag_per_recording"
    model = fit.model.with_term(common)
    with_common = fitted(model, torch.cat([fit.parameters, torch.zeros(1, dtype=torch.float64)]), fit.bound)
    assert {addition.key[0] for addition in additions(with_common, terms, NoiseSettings())} == {"input_delay"}
    # with a common size the fit follows the second recording, and takes the first for outliers
    each = fitted_in_form(with_common, 0, [own], NoiseSettings(), fit)
    assert each.parameters[-2:].tolist() == pytest.approx([0.0067, 0.020], rel=0.01)
    again = fitted_in_form(each, 0, [common], NoiseSettings(), fit)
    assert again.model.terms[0].key == common.key
    assert again.log_likelihood >= with_common.log_likelihood


def test_a_size_for_each_recording_can_be_suspected():
    fit, terms = fitted_vehicle()
    prepared = fit.model.prepared
    ((term,),) = suspected_terms("quadratic_drag_per_recording@speed", terms, prepared)
    assert term.effect.recordings == ("A", "B")
    assert suspect_id(term, terms) == "quadratic_drag_per_recording@speed"
    ((term,),) = suspected_terms("quadratic_drag@speed", terms, prepared)
    assert term.effect.recordings == ()


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory):
    """The folder of a diagnosis on the command line of two vehicles with different drags, and its output."""
    folder = tmp_path_factory.mktemp("vehicles")
    (folder / "vehicle.py").write_text(SOURCE, encoding="utf-8")
    for recording in vehicles((0.0067, 0.020), 1):
        write_table(folder / f"{recording.name}.csv", dict(recording.columns))
    arguments = ("--together", "--simulation", f"{folder / 'vehicle.py'}:Vehicle", "--input-hold", "force=held")
    result = mkc("diagnose", folder / "A.csv", folder / "B.csv", *arguments, "--output", folder / "out")
    assert result.exit_code == 0, result.output
    return folder, result.output


@pytest.mark.e2e
def test_drag_that_differs_is_named_with_a_size_for_each_recording(diagnosed):
    folder, output = diagnosed
    content = json.loads((folder / "out" / "together" / "diagnosis.json").read_text(encoding="utf-8"))
    assert content["verdict"] == "explained"
    (finding,) = content["findings"]
    assert (finding["effect"], finding["grade"], finding["recordings"]) == ("quadratic_drag", "left_out", ["A", "B"])
    (drag,) = finding["parameters"]
    assert drag["components"] == ["A", "B"]
    for value, error, truth in zip(drag["value"], drag["standard_error"], (0.0067, 0.020), strict=True):
        assert 0.0 < error < 0.01 * truth
        assert abs(value - truth) <= 3.0 * error
    assert finding["advice"].endswith("Find what changed between the recordings, and give each its own size.")
    assert "The drag differs between the recordings: 0.00" in finding["explanation"]
    assert any(d["subject"] == "quadratic_drag_per_recording@speed" for d in content["decisions"]["decisions"])
    assert "size The drag differs between the recordings: 0.00" in flat(output)
    assert "mkc apply model.json NEW.csv" in output
    assert "--sizes-of A" in output
    report = (folder / "out" / "together" / "report.html").read_text(encoding="utf-8")
    assert "The drag differs between the recordings" in report


@pytest.mark.e2e
def test_a_new_recording_is_simulated_only_with_the_sizes_of_a_selected_recording(diagnosed, tmp_path):
    folder, _ = diagnosed
    model, simulation = folder / "out" / "together" / "model.json", ("--simulation", f"{folder / 'vehicle.py'}:Vehicle")
    new = coast_down(0.020, 25.0, 7, "new")
    write_table(tmp_path / "new.csv", dict(new.columns))
    apply = ("apply", model, tmp_path / "new.csv", "--output", tmp_path / "simulated.csv", *simulation)
    assert_refused(mkc(*apply), "quadratic_drag differs between the diagnosed recordings A, B", "`--sizes-of A`")
    assert not (tmp_path / "simulated.csv").exists()
    assert_refused(mkc(*apply, "--sizes-of", "C"), "'A' or 'B', but got 'C'")
    sizes = {}
    for name in "AB":
        result = mkc(*apply, "--sizes-of", name, "--force")
        assert result.exit_code == 0, result.output
        simulated = Recording.read(tmp_path / "simulated.csv")["speed_simulated"]
        sizes[name] = float((simulated - new["speed"]).square().mean().sqrt())
    assert sizes["B"] < 0.1 < 1.0 < sizes["A"]  # the noise is 0.05 m/s
    check = ("check", model, tmp_path / "new.csv", "--output", tmp_path / "checks", *simulation)
    assert_refused(mkc(*check), "select one with `--sizes-of A`")
    assert mkc(*check, "--sizes-of", "B").exit_code == 0


@pytest.mark.e2e
def test_the_corrected_class_has_the_sizes_of_the_selected_recording(diagnosed):
    folder, _ = diagnosed
    place = folder / "out" / "together"
    source = load_simulation(f"{folder / 'vehicle.py'}:Vehicle")
    model = DiagnosedModel.from_json((place / "model.json").read_text(encoding="utf-8"), simulation=source)
    assert DiagnosedModel.from_json(model.to_json(), simulation=source).to_json() == model.to_json()
    spec = importlib.util.spec_from_file_location("corrected_vehicle", place / "corrected.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    system, new = module.CorrectedVehicle(), coast_down(0.020, 25.0, 7, "new")
    with pytest.raises(ValueError, match="set its `sizes_of` to 'A' or 'B'"):
        system.prepare(new)
    for name in "AB":
        system.sizes_of = name
        prepared, plain = system.prepare(new), source.prepare(new).with_input_hold(model.state["input_hold"])
        selected = model.with_sizes_of(name)
        theta = torch.cat([selected.theta[:2], torch.tensor([25.0], dtype=torch.float64)])
        joint = JointModel(plain, selected.terms)
        expected = joint.residual(torch.cat([theta, *selected.gammas]).detach())
        torch.testing.assert_close(prepared.residual(theta, {}), expected, rtol=0.0, atol=1e-6)


@pytest.mark.e2e
def test_equal_drag_has_a_common_size():
    diagnosis = diagnose(Vehicle(), vehicles((0.010, 0.010), 2), input_hold={"force": "held"}, surrogates=19)
    (finding,) = diagnosis.findings
    assert (finding.effect, finding.recordings) == ("quadratic_drag", ())
    (drag,) = finding.parameters
    assert abs(drag.value - 0.010) <= 3.0 * drag.standard_error
    assert all("per_recording" not in alternative.effect for alternative in finding.alternatives)
    (content,) = json.loads(diagnosis_to_json(diagnosis))["findings"]
    assert "recordings" not in content


@pytest.mark.e2e
@pytest.mark.slow
def test_a_difference_from_a_common_parameter_of_the_simulation_is_named():
    recordings = vehicles((0.0067, 0.020), 1)
    diagnosis = diagnose(DraggedVehicle(), recordings, input_hold={"force": "held"}, surrogates=19)
    (finding,) = diagnosis.findings
    assert (finding.effect, finding.recordings) == ("quadratic_drag", ("A", "B"))
    (drag,) = finding.parameters
    assert drag.components == ("B",)
    assert abs(drag.value - (0.020 - 0.0067)) <= 3.0 * drag.standard_error
    assert "in B, relative to A, where the simulation's own parameters hold." in finding.explanation
    assert json.loads(diagnosis_to_json(diagnosis))["findings"][0]["recordings"] == ["A", "B"]
    model = DiagnosedModel.from_json(diagnosis.model.to_json(), simulation=DraggedVehicle())
    for number, recording in enumerate(recordings):
        simulated, _ = model.with_sizes_of(recording.name).correct(recording)
        residuals = [float((simulated["speed"] - other["speed"]).square().mean().sqrt()) for other in recordings]
        assert residuals[number] < 0.1  # the noise is 0.05 m/s
    equal = diagnose(DraggedVehicle(), vehicles((0.010, 0.010), 2), input_hold={"force": "held"}, surrogates=19)
    assert (equal.verdict, equal.findings) == ("adequate", ())


@pytest.mark.e2e
@pytest.mark.parametrize("seed", [3, 4, 6])
def test_nothing_is_named_where_nothing_is_missing(seed):
    diagnosis = diagnose(Vehicle(), vehicles((0.0, 0.0), seed), input_hold={"force": "held"}, surrogates=19)
    assert diagnosis.verdict == "adequate"
    assert diagnosis.findings == ()


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.parametrize(("frictions", "seed"), [((0.3, 0.9), 1), ((0.5, 0.5), 2)])
def test_dry_friction_of_a_pendulum_has_a_common_size_only_where_it_is_equal(frictions, seed):
    recordings = [swing(friction, seed + 100 * k, "AB"[k]) for k, friction in enumerate(frictions)]
    names = ("coulomb_friction", "stribeck_friction", "linear_drag", "constant_force", "input_lag")
    effects = [effect for effect in CATALOGUE if effect.id in names]
    diagnosis = diagnose(Pendulum(), recordings, effects=effects, input_hold={"torque": "held"}, surrogates=19)
    finding = diagnosis.findings[0]
    assert (finding.effect, finding.recordings) == ("coulomb_friction", ("A", "B") if frictions[0] != 0.5 else ())
    value = finding.parameters[0].value
    # at standstill the friction that stops the pendulum is smoothed otherwise than in the recording
    assert (value if finding.recordings else (value, value)) == pytest.approx(frictions, rel=0.01)

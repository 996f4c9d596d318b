"""The proof of robots: recordings by MuJoCo's own steps, with elements that the user's file lacks."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco
from scipy.optimize import least_squares

from examples.blind_proof import __main__ as command
from examples.blind_proof import diagnose as jobs
from examples.blind_proof.mujoco.cases import SAMPLES, draw, mujoco_steps
from examples.blind_proof.mujoco.power import power
from examples.blind_proof.mujoco.robots import ROBOTS
from examples.blind_proof.mujoco.stepping import FINER, SAMPLE, Truth, fitted_numbers, stepped
from examples.blind_proof.run import write_case
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import load_mjcf

EACH = [
    pytest.param(robot, number, id=f"{robot.name}-{element.effect}-{element.of}")
    for robot in ROBOTS.values()
    for number, element in enumerate(robot.elements)
]


def waves(robot, samples=150):
    """Return smooth commands of a robot, (N, k)."""
    time = SAMPLE * np.arange(samples)[:, None]
    sizes = np.array(list(robot.commands.values()))
    return sizes * np.sin(2.0 * np.pi * time / robot.slowest + np.arange(len(sizes)))


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=lambda robot: robot.name)
def test_the_robot_without_an_element_is_its_file_at_a_finer_step(robot):
    controls = waves(robot, 60)
    model = mujoco.MjModel.from_xml_string(robot.xml)
    model.opt.timestep /= FINER
    data, seen = mujoco.MjData(model), []
    for row in controls:
        seen.append([data.joint(name).qpos[0] for name in robot.joints])
        data.ctrl[:] = row
        mujoco.mj_step(model, data, round(SAMPLE / model.opt.timestep))
    np.testing.assert_allclose(stepped(Truth(robot), controls), seen, atol=1e-12)


@pytest.mark.parametrize(("robot", "number"), EACH)
def test_a_diagnosis_of_the_file_has_the_place_and_the_effect_of_an_element(robot, number, tmp_path):
    element = robot.elements[number]
    path = tmp_path / f"{robot.name}.xml"
    path.write_text(robot.xml)
    simulation = load_mjcf(path)
    places = {f"input {name}" for name in (*simulation.inputs, *simulation.forces)}
    places |= {f"constant {name}" for name in simulation.constants}
    assert set(element.at) <= places
    assert element.effect in {effect.id for effect in CATALOGUE}


@pytest.mark.parametrize(("robot", "number"), EACH)
def test_every_element_changes_the_motion(robot, number):
    element, controls = robot.elements[number], waves(robot)
    found = stepped(Truth(robot, element, math.sqrt(element.sizes[0] * element.sizes[1])), controls)
    assert np.isfinite(found).all()
    assert np.ptp(found - stepped(Truth(robot), controls)) > 1e-3


def test_payloads_are_at_the_centre_of_mass_that_a_diagnosis_adds_mass_to():
    for robot in ROBOTS.values():
        for element in robot.elements:
            if element.form == "a sphere":
                spec = mujoco.MjSpec.from_string(robot.xml)
                before = spec.compile().body(element.of)
                element.write(spec, 0.5)
                after = spec.compile().body(element.of)
                np.testing.assert_allclose(after.ipos, before.ipos, atol=1e-9)
                assert after.mass[0] == pytest.approx(before.mass[0] + 0.5)


def test_the_fitted_numbers_are_those_of_a_diagnosis(tmp_path):
    for robot in ROBOTS.values():
        path = tmp_path / f"{robot.name}.xml"
        path.write_text(robot.xml)
        fitted = {name.rpartition("_")[0] for name in load_mjcf(path).parameters if not name.endswith("armature")}
        assert fitted == set(fitted_numbers(robot))


def test_z_is_the_loss_of_a_fit_without_the_element():
    """By a fit of the file's numbers and the initial state with SciPy to a recording without noise."""
    robot, deviations = ROBOTS["arm"], np.array([0.05, 0.05])
    element, controls = robot.elements[1], waves(robot)
    truth = Truth(robot, element, 0.004, dict.fromkeys(fitted_numbers(robot), 1.0), (0.01, -0.02, 0.03, 0.0))
    recorded = stepped(truth, controls)

    def residual(p):
        factors = dict(zip(fitted_numbers(robot), p[:2], strict=True))
        other = replace(truth, element=None, factors=factors, begin=tuple(p[2:]))
        return ((stepped(other, controls) - recorded) / deviations).ravel()

    fit = least_squares(residual, [1.0, 1.0, *truth.begin], diff_step=1e-4)
    seen = power(truth, controls, deviations, 0.0)
    assert seen.z == pytest.approx(math.sqrt(2.0 * fit.cost), rel=0.05)
    assert seen.z_sep <= seen.z
    less = power(truth, controls, 2.0 * deviations, 0.19)
    assert less.z == pytest.approx(0.5 * math.sqrt(0.81) * seen.z, rel=1e-9)


def test_the_same_address_draws_the_same_case():
    for hidden in (True, False):
        first, second = draw(11, 3, hidden), draw(11, 3, hidden)
        assert first.key == second.key
        assert all(bool((first.recording[n] == second.recording[n]).all()) for n in first.recording.columns)
        assert (first.second is not None) == hidden
    assert draw(11, 3).key.sensor == draw(11, 3, False).key.sensor


def test_outliers_are_numbered_joint_by_joint():
    case = draw(11, 4)
    robot = ROBOTS[case.key.mode]
    shown = np.stack([case.recording[name].numpy() for name in robot.joints])
    away = np.zeros(shown.size, dtype=bool)
    away[list(case.key.outliers)] = True
    steps = np.abs(np.diff(shown, prepend=shown[:, :1]))
    bad = away.reshape(shown.shape)
    assert 0.002 < bad.mean() < 0.05
    assert np.median(steps[bad]) > 10.0 * np.median(steps[~bad])
    assert case.key.oracle_rms == pytest.approx(1.0, abs=0.1)


def test_the_model_is_written_next_to_the_recording_and_used(tmp_path):
    for folder in ("recordings", "second", "simulations"):
        (tmp_path / folder).mkdir()
    case = draw(11, 5)
    write_case(tmp_path, case)
    path = tmp_path / "simulations" / f"{case.key.name}.xml"
    assert path.read_text() == ROBOTS[case.key.mode].xml
    recording = tmp_path / "recordings" / f"{case.key.name}.csv"
    assert jobs.request_for(recording, path.with_suffix(".py")).simulation == str(path)
    assert len(recording.read_text().splitlines()) == SAMPLES + 1


def test_the_proof_has_the_recordings_of_its_aims():
    proof = mujoco_steps()
    ((scenario, hidden, empty),) = proof.sizes(None, None)
    assert (scenario.name, hidden, empty) == ("mujoco", 100, 200)


def named_by_key(paths, folder):
    """Claim dry friction at the arm's elbow in every recording."""
    for path in paths:
        (folder / path.stem).mkdir()
        finding = {"effect": "coulomb_friction", "grade": "left_out", "drivers": [], "channels": ["input elbow_force"]}
        finding |= {"parameters": [], "alternatives": [], "intervals": [], "p_value": 0.01, "onset": None}
        content = {"verdict": "explained", "findings": [finding]}
        (folder / path.stem / "diagnosis.json").write_text(json.dumps(content))


def test_the_command_scores_names_and_joints(tmp_path, monkeypatch, capsys):
    pytest.importorskip("jinja2")
    monkeypatch.setattr(command, "diagnose", named_by_key)
    place = tmp_path / "proof"
    words = ["mujoco", "--cases", "4", "--empty", "2", "--seed", "5", "--workers", "1", "--output", str(place)]
    assert command.main(words) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Blind proof: 6 recordings, hidden physics in 4" in printed
    assert "false alarms 100.0 % (2 of 2" in printed
    keys = json.loads((place / "key.json").read_text())
    right = [key for key in keys if key["effects"] and key["effects"][0]["at"] == ["input elbow_force"]]
    record = json.loads((place / "score.json").read_text())
    assert len([row for row in record["cases"] if row["hidden"]]) == 4
    assert f"({len(right)} of " in printed or not right


@pytest.mark.slow
def test_a_hidden_friction_is_found_and_improves_a_second_recording(tmp_path):
    place = tmp_path / "proof"
    words = ["mujoco", "--cases", "1", "--empty", "0", "--seed", "8", "--workers", "1", "--output", str(place)]
    assert command.main(words) == 0
    assert not list((place / "diagnoses").glob("*.error.txt"))

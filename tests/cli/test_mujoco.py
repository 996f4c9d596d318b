"""A model of MuJoCo on the command line: its diagnosis and its files, and the errors of its options."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco")
pytest.importorskip("typer")
pytest.importorskip("polars")
pytest.importorskip("jsonschema")

import mujoco

from mkc_torch.cli.diagnosis_request import Request
from mkc_torch.cli.joints import by_joints
from mkc_torch.recording import Recording
from mkc_torch.simulation import load_mjcf
from tests.cli.commands import flat, mkc
from tests.docs.files import write_swing

FRICTION = 0.06


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The manual's model, and its recording of the same model with dry friction, by finer steps of MuJoCo."""
    write_swing(tmp_path, friction=FRICTION)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.e2e
def test_hidden_dry_friction_is_named_at_the_joint_and_written_into_the_model(folder):
    mkc("diagnose", "SWING.csv", "--simulation", "swing.xml", "--output", "results", "--quick")
    written = folder / "results" / "SWING"
    assert "entry of hinge_force" in (written / "diagnosis.json").read_text()
    page = (written / "report.html").read_text()
    assert re.search('<span class="added">[+] .*frictionloss=', page)  # the page shows what corrected.xml changes
    new = load_mjcf(written / "corrected.xml").parameters
    assert new["hinge_frictionloss"].value == pytest.approx(FRICTION, abs=0.02)
    applied = mkc("apply", written / "model.json", "SWING.csv", "--simulation", "swing.xml", "--output", "sim.csv")
    assert applied.exit_code == 0, applied.output
    recording, simulated = Recording.read("SWING.csv"), Recording.read("sim.csv")
    with_findings = (simulated["hinge_simulated"] - recording["hinge"]).square().mean().sqrt()
    prepared = load_mjcf("swing.xml").prepare(recording)
    assert with_findings < 0.3 * prepared.residual(prepared.given, {}).square().mean().sqrt()
    write_swing(folder, "NEW", friction=FRICTION, seed=1)
    checked = mkc("check", written / "model.json", "NEW.csv", "--simulation", "swing.xml", "--output", "checks")
    assert checked.exit_code == 0, checked.output
    assert "holds" in checked.output
    alone = subprocess.run(
        [sys.executable, written / "corrected.py", "NEW.csv"], capture_output=True, text=True, check=False
    )
    assert alone.returncode == 0, alone.stderr
    check = json.loads((folder / "checks" / "NEW" / "check.json").read_text())
    printed = float(re.search(r"hinge: (\S+) rad", alone.stdout)[1])
    assert printed == pytest.approx(check["outputs"]["hinge"]["rmse_corrected"], rel=1e-4)


def test_a_recording_with_the_columns_of_a_model_is_written(folder):
    done = mkc("new-simulation", "example", "--from", "swing.xml")
    assert done.exit_code == 0, done.output
    assert Recording.read("example.csv").names == ("time", "drive", "hinge")
    assert "mkc diagnose YOURS.csv --simulation swing.xml" in flat(done.output)
    again = mkc("new-simulation", "example", "--from", "swing.xml")
    assert again.exit_code == 1
    assert "example.csv exists" in flat(again.output)


def test_the_places_of_a_model_are_listed(folder):
    done = mkc("effects", "--simulation", "swing.xml")
    assert "coulomb_friction@hinge_force" in done.output
    assert "input_delay@drive" in done.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--simulation", "swing.xml", "--fit", "joint:wrist.*"), "no number of the model has this name"),
        (("--simulation", "swing.xml", "--fit", "joint:*,"), "--fit has an empty part"),
        (("--simulation", "own.py:Own", "--fit", "joint:*"), "--fit applies to a model of MuJoCo"),
        (("--simulation", "swing.xml", "--joints", "wrist"), "joints expected some of hinge, got wrist"),
        (("--simulation", "swing.xml", "--joints", "hinge,"), "--joints has an empty part"),
        (("--simulation", "own.py:Own", "--joints", "all"), "--joints applies to a model of MuJoCo"),
        (("--simulation", "absent.xml"), "there is no such file"),
    ],
)
def test_wrong_options_are_refused(folder, arguments, message):
    done = mkc("diagnose", "SWING.csv", *arguments)
    assert done.exit_code != 0
    assert message in flat(done.output)
    assert not (folder / "results" / "SWING").exists()


def test_a_model_json_keeps_which_numbers_were_fitted(folder):
    recording = Recording.read("SWING.csv")
    state = load_mjcf("swing.xml", ["joint:hinge.damping"]).prepare(recording).state
    assert state["fitted"] == ["joint:hinge.damping"]
    correction = load_mjcf("swing.xml").correction({**state, "fitted": ["joint:*.damping"]}, recording)
    assert list(correction.prepared.known) == ["hinge_damping"]
    assert torch.equal(correction.prepared.time, recording["time"])


THREE = """
<mujoco model="three links">
  <option timestep="0.01" integrator="implicitfast"/>
  <default><joint type="hinge" axis="0 1 0" damping="0.3"/><geom type="capsule" size="0.02" mass="0.5"/></default>
  <worldbody>
    <body>
      <joint name="hip"/><geom fromto="0 0 0 0 0 -0.3" contype="0" conaffinity="0"/>
      <body pos="0 0 -0.3">
        <joint name="knee"/><geom fromto="0 0 0 0 0 -0.3" contype="0" conaffinity="0"/>
        <body pos="0 0 -0.3"><joint name="foot"/><geom fromto="0 0 0 0 0 -0.1" contype="0" conaffinity="0"/></body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="hip" joint="hip" kp="40" kv="2"/>
    <position name="knee" joint="knee" kp="40" kv="2"/>
    <position name="foot" joint="foot" kp="20" kv="1"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def leg(folder):
    """A leg of three joints and its recording, stepped by MuJoCo."""
    (folder / "leg.xml").write_text(THREE)
    model = mujoco.MjModel.from_xml_string(THREE)
    data, rows = mujoco.MjData(model), []
    rng = np.random.default_rng(4)
    for k in range(120):
        control = 0.4 * np.sin(0.02 * k * np.array([2.0, 3.1, 4.3]))
        rows.append([0.02 * k, *control, *(data.qpos + 0.001 * rng.normal(size=3))])
        data.ctrl[:] = control
        mujoco.mj_step(model, data, nstep=2)
    names = ["time", "hip_ctrl", "knee_ctrl", "foot_ctrl", "hip", "knee", "foot"]
    np.savetxt("LEG.csv", rows, delimiter=",", header=",".join(names), comments="", fmt="%.6f")
    return folder


def test_more_than_two_joints_are_simulated_one_by_one(leg):
    request = Request(simulation="leg.xml")
    each = [(name,) for name in ("hip", "knee", "foot")]
    assert [known.joints for known in by_joints(Path("LEG.csv"), request)] == each
    assert [known.joints for known in by_joints(Path("LEG.csv"), replace(request, joints=("all",)))] == [()]
    both = ("knee", "hip")
    assert [known.joints for known in by_joints(Path("LEG.csv"), replace(request, joints=both))] == [both]
    one = Request(simulation="swing.xml")
    assert [known.joints for known in by_joints(Path("SWING.csv"), one)] == [()]
    assert [known.joints for known in by_joints(Path("SWING.csv"), replace(one, joints=("each",)))] == [("hinge",)]


@pytest.mark.e2e
def test_each_joint_has_a_folder_and_all_have_a_file(leg):
    done = mkc("diagnose", "LEG.csv", "--simulation", "leg.xml", "--max-findings", "0", "--quick")
    assert done.exit_code in (0, 3), done.output
    for joint in ("hip", "knee", "foot"):
        found = json.loads((leg / "results" / "LEG" / joint / "diagnosis.json").read_text("utf-8"))
        assert found["recording"] == f"LEG, {joint}"
        assert list(found["goodness_of_fit"]) == [joint]
    joined = load_mjcf(leg / "results" / "LEG" / "corrected.xml").parameters
    alone = load_mjcf(leg / "results" / "LEG" / "knee" / "corrected.xml").parameters
    assert joined["knee_kp"].value == pytest.approx(alone["knee_kp"].value)
    assert alone["knee_kp"].value == pytest.approx(40.0, rel=0.1)
    assert str(Path("results", "LEG", "corrected.xml")) in flat(done.output)
    applied = mkc("apply", "results/LEG/knee/model.json", "LEG.csv", "--simulation", "leg.xml", "--output", "out.csv")
    assert applied.exit_code == 0, applied.output
    table = Recording.read("out.csv")
    assert float((table["knee_simulated"] - table["knee"]).std()) < 0.002

"""Joints that follow their recorded positions, while the others are simulated."""

import pickle

import numpy as np
import pytest
import torch

from mkc_torch.diagnosis.io.mjcf import mjcf_source
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects import CATALOGUE
from mkc_torch.recording import Recording
from mkc_torch.simulation import MjcfError, load_mjcf
from tests.simulation.stepped.models import TWO_LINKS


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(TWO_LINKS)
    return path


def moved(arm, samples=200, noise=0.0):
    """A recording of both joints, simulated at once."""
    whole = load_mjcf(arm)
    time = 0.02 * np.arange(samples)
    control = np.stack([0.6 - 0.6 * np.cos(1.3 * time), 0.4 * np.sin(2.1 * time) ** 2], 1).repeat(4, 0)
    p = {name: parameter.value for name, parameter in whole.parameters.items()}
    states = whole._engine.rolled_out(np.zeros(4), control, np.zeros((len(control), 2)), p)
    places = np.concatenate([np.zeros((1, 4)), states])[: 4 * samples : 4]
    rng = np.random.default_rng(2)
    places += noise * rng.normal(size=places.shape)
    columns = {"time": time, "shoulder": places[:, 0], "elbow": places[:, 1]}
    columns |= {"shoulder_ctrl": control[::4, 0], "elbow_motor": control[::4, 1]}
    return Recording({name: torch.tensor(values) for name, values in columns.items()})


@pytest.mark.parametrize("joint", ["shoulder", "elbow"])
def test_a_joint_moves_as_in_the_whole_model(arm, joint):
    prepared = load_mjcf(arm, joints=[joint]).prepare(moved(arm))
    assert prepared.channels == (joint,)
    assert prepared.system.states == (joint, f"{joint}_vel")
    left = prepared.residual(prepared.given, {})
    # the recorded motion of the other joint is known at the samples only
    assert float(left.abs().max()) < 0.01 * float(prepared.measured.abs().max())


def test_effects_act_at_the_simulated_joint_alone(arm):
    prepared = load_mjcf(arm, joints=["elbow"]).prepare(moved(arm))
    assert "entry of elbow_force" in prepared.ports
    assert "input elbow_motor" in prepared.ports
    assert not [port for port in prepared.ports if "shoulder" in port]
    assert list(prepared.known) == ["elbow_damping", "elbow_armature"]


def test_several_runs_are_followed_each_by_itself(arm):
    one = moved(arm, samples=60)
    both = {name: torch.cat([one[name], one[name]]) for name in one.names if name != "time"}
    both["time"] = torch.cat([one["time"], one["time"] + 100.0])
    both["experiment"] = torch.arange(2.0).repeat_interleave(60).double()
    prepared = load_mjcf(arm, joints=["elbow"]).prepare(Recording(both))
    left = prepared.residual(prepared.given, {})
    torch.testing.assert_close(left[:60], left[60:], rtol=0, atol=1e-9)


def test_a_model_with_followed_joints_is_pickled_and_saved(arm):
    system = load_mjcf(arm, joints=["elbow"])
    again = pickle.loads(pickle.dumps(system))
    assert again.states == system.states
    assert system.saved == {"joints": ["elbow"]}
    assert load_mjcf(arm).moving(["elbow"]).inputs == system.inputs


@pytest.mark.parametrize(("joints", "message"), [(["wrist"], "got wrist"), ([], "got none")])
def test_unknown_joints_are_refused(arm, joints, message):
    with pytest.raises(MjcfError, match=message):
        load_mjcf(arm, joints=joints)


def test_a_joint_without_a_column_cannot_be_followed(arm):
    known = moved(arm)
    recording = Recording({name: known[name] for name in known.names if name != "shoulder"})
    with pytest.raises(MjcfError, match="no column `shoulder`"):
        load_mjcf(arm, joints=["elbow"]).prepare(recording)


def test_the_findings_of_joints_are_joined_in_one_file(arm):
    friction = next(effect for effect in CATALOGUE if effect.id == "coulomb_friction")
    parts = []
    for joint, size in (("shoulder", 0.02), ("elbow", 0.08)):
        system = load_mjcf(arm, joints=[joint])
        theta = [1.5 * parameter.value for parameter in system.parameters.values()]
        term = Term(friction, None, {"width": 0.05}, f"entry of {joint}_force")
        parts.append((system, theta, [term], [torch.tensor([size])]))
    target = arm.parent / "joined.xml"
    target.write_text(mjcf_source(parts)[0])
    new = load_mjcf(target).description.model
    np.testing.assert_allclose(new.dof_frictionloss, [0.095, 0.08])  # of the shoulder with that of the file, fitted
    np.testing.assert_allclose(new.dof_damping, [0.3, 0.15])

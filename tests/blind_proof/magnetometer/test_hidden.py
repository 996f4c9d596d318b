import dataclasses
import math

import pytest
import torch

from examples.blind_proof.draws import generator
from examples.blind_proof.magnetometer.cases import draw_scene, later_scene
from examples.blind_proof.magnetometer.hidden import (
    CATALOGUE,
    OUTSIDE,
    bar_field,
    dipole_field,
    hard_iron_step,
    play,
    wire_field,
)

ALL_EFFECTS = {**CATALOGUE, **OUTSIDE}


@pytest.fixture(scope="module")
def scene():
    return draw_scene(generator(0), 20.0)


@pytest.mark.parametrize("effect", ALL_EFFECTS)
def test_traces_are_finite_and_named(effect, scene):
    later = later_scene(generator(1), scene)
    for k in range(5):
        hidden = ALL_EFFECTS[effect](generator(2, k), scene)
        assert hidden.effect == effect
        for at in (scene, later):
            trace = hidden.trace(at)
            assert trace.shape == (len(at.time), 3)
            assert bool(trace.isfinite().all())
        assert float(hidden.trace(scene).std(0).max()) > 0


@pytest.mark.parametrize("effect", ["hard_iron_step", "offset_drift"])
def test_a_step_and_a_drift_keep_their_final_offset_in_later_recordings(effect, scene):
    hidden = ALL_EFFECTS[effect](generator(3), scene)
    end = hidden.trace(scene)[-1]
    later = hidden.trace(dataclasses.replace(scene, settled=True))
    assert float(later.std(0).max()) < 1e-12
    assert float((later[0] - end).norm()) < 0.1 * float(end.norm())


def test_a_step_rises_about_its_onset(scene):
    hidden = hard_iron_step(generator(4), scene)
    size = hidden.trace(scene).norm(dim=-1)
    x = scene.time - hidden.onset
    assert float(size[x < -0.16].max()) == 0.0
    assert float(size[x > 0.16].min()) > 0.9


def test_the_field_of_a_wire_is_the_biot_savart_integral():
    place, along, half = torch.tensor([0.03, 0.05, -0.02]).double(), torch.tensor([0.6, 0.0, 0.8]).double(), 0.1
    s = torch.linspace(-half, half, 20_001).double()
    toward = -(place + s[:, None] * along)
    integrand = torch.linalg.cross(along.expand_as(toward), toward) / toward.norm(dim=-1, keepdim=True) ** 3
    expected = 0.1 * torch.trapezoid(integrand, s, dim=0)
    torch.testing.assert_close(wire_field(place, along, half), expected, rtol=1e-6, atol=1e-9)


def test_the_field_of_a_bar_is_that_of_a_line_of_dipoles():
    place, axis = torch.tensor([[0.7, -0.4, 1.0]]).double(), torch.tensor([0.0, 0.6, 0.8]).double()
    moment = torch.tensor([1.0, 0.0, 0.0]).double()
    s = torch.linspace(-200.0, 200.0, 80_001).double()
    expected = torch.trapezoid(dipole_field(place - s[:, None] * axis, moment), s, dim=0)
    torch.testing.assert_close(bar_field(place, moment, axis)[0], expected, rtol=1e-4, atol=1e-6)


def test_the_field_of_a_dipole_has_neither_divergence_nor_curl():
    place, moment = torch.tensor([0.3, -0.2, 0.5]).double(), torch.tensor([0.1, 0.2, -0.3]).double()
    jacobian = torch.func.jacrev(lambda p: dipole_field(p, moment))(place)
    assert abs(float(jacobian.trace())) < 1e-9 * float(jacobian.abs().max())
    torch.testing.assert_close(jacobian, jacobian.mT)


def test_play_has_two_branches():
    x = 10.0 * torch.sin(torch.linspace(0.0, 4.0 * math.pi, 400))[:, None].double()
    y = play(x, 2.0)
    rising = torch.cat([torch.diff(x, dim=0) > 0, torch.tensor([[False]])])
    near = (x.abs() < 1.0) & (torch.arange(400)[:, None] > 100) & (torch.arange(400)[:, None] < 390)
    assert float((x - y)[near & rising].min()) == pytest.approx(2.0)
    assert float((x - y)[near & ~rising].max()) == pytest.approx(-2.0)


def test_the_nonlinearity_saturates_and_is_cubic_when_small(scene):
    hidden = CATALOGUE["cubic_nonlinearity"](generator(5), scene)
    weak = dataclasses.replace(scene, field_world=0.01 * scene.field_world)
    weak = dataclasses.replace(weak, sensor=dataclasses.replace(weak.sensor, hard=torch.zeros(3).double()))
    weaker = dataclasses.replace(weak, field_world=0.5 * weak.field_world)
    torch.testing.assert_close(hidden.trace(weak), 8.0 * hidden.trace(weaker), rtol=1e-3, atol=1e-9)

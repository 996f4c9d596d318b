"""What effects between what was simulated and what was measured promise."""

import pytest
import torch

from mkc_torch._support.unit_text import quotient, tidy
from mkc_torch.diagnosis.model.grid import absolute
from mkc_torch.effects import CATALOGUE, DYNAMICS, PAIRED
from mkc_torch.effects.base import BoundedEffect
from mkc_torch.effects.context import Context
from mkc_torch.effects.paired.between import shifted
from mkc_torch.simulation.outputs import ALL, output_ports

IDS = ("gain", "offset", "delay", "clock_drift", "output_saturation", "driver_linear", "driver_quadratic")
N = 120


def context(effect):
    time = torch.arange(N, dtype=torch.float64) / 10.0
    signal = (2.0 * torch.sin(1.3 * time) + 0.2).unsqueeze(-1)
    port = output_ports(("y",), {"y": "V"}, "V", signal, ("y",))[ALL if effect.port == "outputs" else "output y"]
    drivers = torch.cos(0.7 * time).unsqueeze(-1) if effect.roles else time.new_zeros(N, 0)
    units = ("A",) if effect.roles else ()
    made = Context(time, drivers, units, signal, "V", ("y",), (), port.parts, port.part_units)
    return made, [absolute(effect, shape, port) for shape in effect.shapes(time)]


def test_ids_are_the_contract():
    assert tuple(effect.id for effect in PAIRED) == IDS
    assert set(PAIRED) | set(DYNAMICS) < set(CATALOGUE)
    named = [effect.id for effect in CATALOGUE if effect.id not in ("unknown", "field_gradient")]
    assert len(set(named)) == len(named)


@pytest.mark.parametrize("effect", PAIRED, ids=lambda e: e.id)
def test_the_change_is_none_without_an_amplitude_and_smooth(effect):
    seen, shapes = context(effect)
    for shape in (shapes[0], shapes[-1]):
        size = sum(q.size for q in effect.quantities(shape, seen))
        zero = torch.zeros(size, dtype=torch.float64)
        assert float(effect.change(zero, shape, seen).abs().max()) < 1e-12
        gamma = torch.full((size,), 0.0123, dtype=torch.float64)
        tangent = torch.func.jacfwd(lambda g, shape=shape: effect.change(g, shape, seen))(gamma)
        assert tangent.shape == (N, 1, size)
        step = 1e-6 * torch.eye(size, dtype=torch.float64)
        near = [(effect.change(gamma + h, shape, seen) - effect.change(gamma - h, shape, seen)) / 2e-6 for h in step]
        near = torch.stack(near, -1)
        torch.testing.assert_close(tangent, near, rtol=1e-5, atol=1e-6 * float(near.abs().max()) + 1e-9)
        assert float(near.abs().max()) > 0.0 or effect.id == "output_saturation"


@pytest.mark.parametrize("effect", PAIRED, ids=lambda e: e.id)
def test_users_are_told_what_it_is(effect):
    assert effect.equation.startswith("δy = ")
    for sentence in (effect.explanation, effect.advice):
        assert sentence.endswith(".")
    for heading in ("Simulation:", "Drivers:", "Units:", "Plausible:", "Source:"):
        assert heading in type(effect).__doc__


def test_units():
    units = {e.id: [q.unit for q in e.quantities(*reversed_pair(e))] for e in PAIRED}
    assert units["driver_quadratic"] == ["V/A", "V/A²", "V"]
    assert (units["gain"], units["offset"], units["delay"]) == ([""], ["V"], ["s"])
    assert (tidy("rad/s/s"), tidy("1/µT²"), tidy("counts"), tidy("m²·s/s")) == ("rad/s²", "1/µT²", "counts", "m²")
    assert (quotient("rad/s/s", "rad/s", 2), quotient("K/s", "K"), quotient("V", "")) == ("1/rad", "1/s", "")


def reversed_pair(effect):
    seen, shapes = context(effect)
    return shapes[0], seen


def test_a_delay_is_a_shift_within_its_run():
    time = torch.arange(10, dtype=torch.float64)
    both = torch.cat([time, time])
    values = torch.cat([time, 100.0 + time])
    late = shifted(values, both, -2.5)
    assert late[:4].tolist() == [0.0, 0.0, 0.0, 0.5]
    assert late[10:14].tolist() == [100.0, 100.0, 100.0, 100.5]
    assert shifted(values, both, 2.5)[8:12].tolist() == [9.0, 9.0, 102.5, 103.5]


def test_only_one_sided_effects_are_bounded():
    assert {e.id for e in PAIRED if isinstance(e, BoundedEffect)} == {"output_saturation"}

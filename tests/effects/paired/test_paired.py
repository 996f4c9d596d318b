"""Effects between simulated and measured outputs: units, bounds, and shifts in time."""

import math

import torch

from mkc_torch._support.unit_text import quotient, tidy
from mkc_torch.effects import PAIRED
from mkc_torch.effects.paired.between import shifted
from tests.effects.contexts import paired_context


def test_units_of_paired_effects_are_tidied_quotients_and_powers():
    units = {e.id: [q.unit for q in e.quantities({}, paired_context(e))] for e in PAIRED}
    assert units["driver_quadratic"] == ["V/A", "V/A²", "V"]
    assert (units["gain"], units["offset"], units["delay"]) == ([""], ["V"], ["s"])
    assert (tidy("rad/s/s"), tidy("1/µT²"), tidy("counts"), tidy("m²·s/s")) == ("rad/s²", "1/µT²", "counts", "m²")
    assert (quotient("rad/s/s", "rad/s", 2), quotient("K/s", "K"), quotient("V", "")) == ("1/rad", "1/s", "")


def test_a_delay_is_a_shift_within_its_run():
    time = torch.arange(10, dtype=torch.float64)
    both = torch.cat([time, time])
    values = torch.cat([time, 100.0 + time])
    late = shifted(values, both, -2.5)
    assert late[:4].tolist() == [0.0, 0.0, 0.0, 0.5]
    assert late[10:14].tolist() == [100.0, 100.0, 100.0, 100.5]
    assert shifted(values, both, 2.5)[8:12].tolist() == [9.0, 9.0, 102.5, 103.5]


def test_only_one_sided_effects_are_bounded():
    assert {e.id for e in PAIRED if e.one_sided} == {"output_saturation", "backlash"}
    assert {e.id for e in PAIRED if e.upper < math.inf} == {"output_saturation"}

"""An offset that mirrors the later vectors with the same length is no finding of a sensor whose length is compared."""

import functools
from dataclasses import replace

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.ranking import is_hardly_visible
from mkc_torch.diagnosis.thresholds import VISIBLE
from mkc_torch.effects import SENSOR
from mkc_torch.simulation import Magnetometer

FIELD, ONSET, SAMPLES = 50.0, 40.0, 500
STEP = next(effect for effect in SENSOR if effect.id == "hard_iron_step")
LAST = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
"""Direction of the field after the onset."""


@functools.cache
def fit_without_step():
    """Return the fit to a sensor that is turned in all directions, and lies almost still after the onset."""
    g = torch.Generator().manual_seed(2)
    time = 0.1 * torch.arange(SAMPLES, dtype=torch.float64)
    direction = torch.randn(SAMPLES, 3, generator=g, dtype=torch.float64)
    late = LAST + 0.02 * torch.randn(SAMPLES, 3, generator=g, dtype=torch.float64)
    direction = torch.where(time.unsqueeze(-1) < ONSET, direction, late)
    field = FIELD * direction / direction.norm(dim=-1, keepdim=True)
    field = field + 0.3 * torch.randn(SAMPLES, 3, generator=g, dtype=torch.float64)
    columns = {"time": time, **dict(zip(("mag_x", "mag_y", "mag_z"), field.unbind(-1), strict=True))}
    prepared = Magnetometer().prepare(Recording(columns))
    return fitted(JointModel(prepared), prepared.start())


def with_step(change):
    """Return the fit with a step of the offset, at the same parameters."""
    fit = fit_without_step()
    model = fit.model.with_term(Term(STEP, None, {"onset": ONSET}))
    return replace(fit, model=model, parameters=torch.cat([fit.parameters, torch.as_tensor(change).double()]))


@pytest.mark.parametrize("change", [[1.0, 0.5, 0.8], [20.0, 10.0, 15.0], [0.0, 3.0, 6.0]])
def test_an_offset_is_visible_in_the_length(change):
    assert not is_hardly_visible(with_step(change))


@pytest.mark.parametrize("tilt", [0.0, 0.4, 1.0])
def test_a_mirror_of_the_later_vectors_is_hardly_visible(tilt):
    """The vectors after the onset are mirrored at a plane, whose normal may be turned away from the field."""
    normal = LAST + tilt * torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    normal = normal / normal.norm()
    change = 2.0 * FIELD * (LAST @ normal) * normal
    assert float(change.norm()) > 0.5 * FIELD
    assert is_hardly_visible(with_step(change))


def test_the_limit_is_below_a_small_offset_in_random_directions():
    assert VISIBLE < 3.0**-0.5 / 3.0

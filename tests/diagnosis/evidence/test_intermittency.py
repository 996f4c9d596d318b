"""Lasting steps are distinguished from intermittent steps."""

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.evidence.timing import comes_and_goes, memory_of
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.effects.sensor.hard_iron_step import HardIronStep
from mkc_torch.simulation import Magnetometer

N, ONSET = 3000, 1000
TIME = torch.arange(N, dtype=torch.float64)


def gain_of(course, size, phi=0.0, seed=0):
    """Return the gain, assuming white noise, of a step of this size in unit AR(1) noise with coefficient `phi`."""
    generator = torch.Generator().manual_seed(seed)
    white = torch.randn(N, generator=generator, dtype=torch.float64) * (1.0 - phi**2) ** 0.5
    noise = white.clone()
    for k in range(1, N):
        noise[k] += phi * noise[k - 1]
    step = size * (TIME >= ONSET).double()
    error = noise + size * course
    return 0.5 * (error.square() - (error - step).square())


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize(("size", "phi"), [(3.0, 0.0), (0.15, 0.0), (3.0, 0.9), (0.7, 0.9)])
def test_a_lasting_step_is_not_intermittent(size, phi, seed):
    gain = gain_of((TIME >= ONSET).double(), size, phi, seed)
    assert not comes_and_goes(
        gain, TIME, float(ONSET), EvidenceSettings(), memory_of([torch.tensor([phi], dtype=torch.float64)])
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("size", "phi"), [(3.0, 0.0), (1.0, 0.0), (3.0, 0.9)])
def test_a_switched_offset_is_intermittent(size, phi, seed):
    switched = (TIME >= ONSET).double() * (torch.sin((TIME - ONSET) / 100.0) >= -0.3).double()
    gain = gain_of(switched, size, phi, seed)
    assert comes_and_goes(
        gain, TIME, float(ONSET), EvidenceSettings(), memory_of([torch.tensor([phi], dtype=torch.float64)])
    )


@pytest.mark.e2e
@pytest.mark.parametrize("lasts", [True, False])
def test_a_diagnosis_distinguishes_lasting_from_intermittent_steps(lasts):
    generator = torch.Generator().manual_seed(2)
    time = 0.02 * torch.arange(2000, dtype=torch.float64)
    turn = torch.stack([torch.sin(0.9 * time), torch.cos(1.3 * time), torch.sin(1.7 * time + 1.0)], -1)
    field = 50.0 * turn / torch.linalg.vector_norm(turn, dim=-1, keepdim=True)
    on = (time >= 12.0) & (lasts | (torch.sin(0.8 * (time - 12.0)) >= -0.5))
    offset = on.double().unsqueeze(-1) * torch.tensor([4.0, -3.0, 5.0], dtype=torch.float64)
    readings = field + offset + 0.3 * torch.randn(2000, 3, generator=generator, dtype=torch.float64)
    columns = dict(zip(("mag_x", "mag_y", "mag_z"), readings.unbind(-1), strict=True))
    options = {"effects": (HardIronStep(),), "max_findings": 1, "surrogates": 19}
    (finding,) = diagnose(Magnetometer(), Recording({"time": time, **columns}), **options).findings
    assert finding.effect == "hard_iron_step"
    assert finding.comes_and_goes == (not lasts)


def test_memory_is_the_long_run_variance_over_the_variance():
    assert memory_of([]) == 1.0
    assert memory_of([torch.tensor([0.9], dtype=torch.float64)]) == pytest.approx(19.0, rel=1e-3)
    assert memory_of([torch.tensor([-0.5]), torch.tensor([0.5])]) == pytest.approx(3.0, rel=1e-3)

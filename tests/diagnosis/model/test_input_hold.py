"""The hold of an input between samples, chosen again once an effect is found."""

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.model.process_noise import choose_input_hold, fit_alone
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.effects.dynamics.dead_zone import DeadZone
from mkc_torch.simulation import Dynamics, Parameter


class Tanks(Dynamics):
    """Two tanks in cascade; the outflow by Torricelli's law has no finite slope at an empty tank."""

    states = ("h1", "h2")
    inputs = ("valve",)
    outputs = ("h1", "h2")
    parameters = {name: Parameter(1.0, lower=0.0) for name in ("pump", "k1", "k2")}
    initial = {"h1": 6.0, "h2": 6.0}

    def derivative(self, time, x, u, p):
        first, second = (torch.sqrt(torch.clamp(level, min=1e-3)) for level in (x.h1, x.h2))
        return {"h1": p.pump * u.valve - p.k1 * first, "h2": p.k1 * first - p.k2 * second}


def recorded(count=400):
    """Levels while a valve with a dead zone is held for 25 samples at a time, at times nearly closed."""
    g = torch.Generator().manual_seed(4)
    time = 2.0 * torch.arange(count, dtype=torch.float64)
    valve = (3.0 * torch.rand(count // 25, generator=g, dtype=torch.float64)).repeat_interleave(25)
    h = torch.full((2,), 6.0, dtype=torch.float64)
    levels = [h]
    for value in valve[:-1].tolist():
        for _ in range(40):
            flow = torch.tensor([0.6, 0.55]) * h.clamp(min=1e-3).sqrt()
            h = h + 0.05 * torch.stack([1.2 * max(value - 0.5, 0.0) - flow[0], flow[0] - flow[1]])
        levels.append(h)
    noise = 0.05 * torch.randn(count, 2, generator=g, dtype=torch.float64)
    h1, h2 = (torch.stack(levels) + noise).unbind(-1)
    return Recording({"time": time, "valve": valve, "h1": h1, "h2": h2})


@pytest.mark.e2e
@pytest.mark.slow
def test_the_hold_is_chosen_again_with_the_effect():
    found = diagnose(Tanks(), recorded(), effects=(DeadZone(),), surrogates=19, max_findings=1)
    assert found.environment.input_hold == {"valve": "held"}
    assert found.verdict == "explained"
    width = next(p for p in found.findings[0].parameters if p.name == "width")
    assert width.value == pytest.approx(0.5, abs=0.01)


@pytest.mark.e2e
@pytest.mark.parametrize(("more", "expected"), [(0.9, "linear"), (1.1, "held")])
def test_another_hold_than_the_simulations_own_has_to_gain_a_nat(more, expected):
    """Where both fit alike, the errors of rounding would choose."""
    prepared = Tanks().prepare(recorded(100))
    base = fit_alone(prepared, {}, NoiseSettings(), lambda *_, **__: None)

    def value(fits):
        return more * (fits.fit.model.prepared.input_hold == {"valve": "held"})

    found = choose_input_hold(base, {}, {}, NoiseSettings(), value)
    assert found.fit.model.prepared.input_hold == {"valve": expected}

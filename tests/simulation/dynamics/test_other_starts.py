"""Further starts for a first fit that failed."""

import torch

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.other_starts import other_starts


class Growing(Dynamics):
    states = ("speed",)
    outputs = ("rpm",)
    parameters = {"a": 80.0, "b": 1.0}

    def derivative(self, time, x, u, p):
        return {"speed": p.a * x.speed + p.b}

    def output(self, time, x, u, p):
        return {"rpm": 9.5 * x.speed}


def prepared(**parameters):
    time = torch.arange(120, dtype=torch.float64) / 10.0
    simulation = Growing()
    simulation.parameters = {**Growing.parameters, **parameters}
    return simulation.prepare(Recording({"time": time, "rpm": 1.0 - torch.exp(-time)}))


def test_starts_are_finite_and_sorted_and_the_wrong_parameter_is_named():
    free = prepared()
    found = other_starts(free, free.given, 3)
    assert len(found.starts) == 3
    left = [free.residual(start, {}) for start in found.starts]
    assert all(bool(residual.isfinite().all()) for residual in left)
    sizes = [float(residual.abs().median()) for residual in left]
    assert sizes == sorted(sizes)
    assert (found.output, found.parameter) == ("rpm", "a")
    assert 0.0 <= found.until < 12.0
    assert found.lasts == torch.inf


def test_starts_stay_within_the_bounds():
    free = prepared(a=Parameter(80.0, lower=79.0))
    found = other_starts(free, free.given, 3)
    assert found.output == "rpm"
    assert all(float(start[0]) >= 79.0 for start in found.starts)

"""Units and the scale of time change no name, no p-value and no grade: a driven mass with dry friction."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest
import torch

from mkc_torch import Diagnosis, Recording, diagnose
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Dynamics, Parameter

FEW = ("coulomb_friction", "linear_drag", "quadratic_drag", "constant_force", "input_lag", "input_delay", "sensor_lag")


@functools.cache
def moved(friction: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times in s, forces and positions by semi-implicit steps, with white noise."""
    rng, step, fine = np.random.default_rng(0), 0.05, 20
    force = np.repeat(rng.choice([-1.0, 0.0, 1.0], 20), 15)
    x, v, found = 0.0, 0.0, []
    for now in force:
        found.append(x)
        for _ in range(fine):
            v += step / fine * (now - 2.0 * x - 0.3 * v - friction * math.tanh(v / 0.01))
            x += step / fine * v
    return step * np.arange(300), force, np.array(found) + 0.005 * rng.normal(size=300)


@functools.cache
def diagnosed(friction: float, second: float, metre: float) -> Diagnosis:
    """The diagnosis with times in units of 1 / ``second`` s and positions in units of 1 / ``metre`` m."""

    class Mass(Dynamics):
        states, inputs, outputs, input_hold = ("x", "v"), ("force",), ("x",), "held"
        parameters = {"stiffness": Parameter(1.8 / second**2, lower=0.0), "damping": Parameter(0.4 / second, lower=0.0)}

        def derivative(self, time: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
            return {"x": x.v, "v": u.force - p.stiffness * x.x - p.damping * x.v}

    time, force, position = (torch.tensor(values) for values in moved(friction))
    columns = {"time": second * time, "force": metre / second**2 * force, "x": metre * position}
    effects = [effect for effect in CATALOGUE if effect.id in FEW]
    return diagnose(Mass(), Recording(columns), effects=effects, surrogates=19)


SCALES = [
    pytest.param(1e-6, 1.0, marks=pytest.mark.slow),
    (3e7, 1.0),
    (1.0, 1e-9),
    pytest.param(1.0, 1e9, marks=pytest.mark.slow),
    pytest.param(1e-6, 1e9, marks=pytest.mark.slow),
]


@pytest.mark.e2e
@pytest.mark.parametrize(("second", "metre"), SCALES)
def test_scales_of_time_and_position_change_sizes_only(second: float, metre: float) -> None:
    usual, other = diagnosed(0.25, 1.0, 1.0), diagnosed(0.25, second, metre)
    assert [f.effect for f in usual.findings] == ["coulomb_friction"]
    assert other.verdict == usual.verdict
    assert [(f.effect, f.grade, f.p_value) for f in other.findings] == [
        (f.effect, f.grade, f.p_value) for f in usual.findings
    ]
    sizes = [d.findings[0].parameters[0].value for d in (usual, other)]
    assert sizes[1] == pytest.approx(metre / second**2 * sizes[0], rel=1e-6)


@pytest.mark.e2e
@pytest.mark.parametrize(("second", "metre"), [(3e7, 1e-9), (1e-6, 1e9)])
def test_scales_make_nothing_of_nothing(second: float, metre: float) -> None:
    usual, other = diagnosed(0.0, 1.0, 1.0), diagnosed(0.0, second, metre)
    assert usual.findings == other.findings == ()
    assert other.verdict == usual.verdict
    assert other.p_value == usual.p_value

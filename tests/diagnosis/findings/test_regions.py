"""Attribution of a finding's gain to samples, states and runs."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording
from mkc_torch.diagnosis.evidence.held_out import scored
from mkc_torch.diagnosis.findings.regions import Attribution, attributed, map_of, region_of, shares_of_runs
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects import DYNAMICS
from tests.diagnosis.line import Line
from tests.diagnosis.search.test_tangents import Offset
from tests.diagnosis.test_dynamics_diagnosis import Pendulum

EFFECTS = {effect.id: effect for effect in DYNAMICS}


def swings(hidden, first):
    """Runs of a pendulum of which the angle was measured, each with its own hidden rate of the speed."""
    time = np.arange(300) * 0.02
    noise = np.random.default_rng(3)
    angle = []
    for rate, start in zip(hidden, first, strict=True):
        exact = solve_ivp(
            lambda _, y, rate=rate: [y[1], -9.0 * math.sin(y[0]) - 0.05 * y[1] + rate(*y)],
            (0.0, time[-1]), [start, 0.0], t_eval=time, rtol=1e-8, atol=1e-9, max_step=0.02,
        )  # fmt: skip
        angle.append(exact.y[0] + 0.01 * noise.standard_normal(len(time)))
    number = np.repeat(np.arange(len(angle)), len(time)).astype(float)
    columns = {"time": np.tile(time, len(angle)), "angle": np.concatenate(angle), "experiment": number}
    return Recording({name: torch.from_numpy(values) for name, values in columns.items()})


@pytest.fixture(scope="module")
def stiffening_spring():
    """Return the fit of a stiffening spring to a run of large swings and a run of small swings."""
    prepared = Pendulum().prepare(swings([lambda x, _: -4.0 * x**3] * 2, [1.2, 0.2]))
    model = JointModel(prepared, (Term(EFFECTS["cubic_stiffness"], None, {}, "rate of speed"),))
    return fitted(model, torch.cat([prepared.start(), prepared.time.new_tensor([3.0])]), graduate=False)


def log_likelihood(fit, parameters):
    return float(scored(fit.model.residual(parameters), fit.sigma, fit.d, fit.bound).sum())


def test_sample_gains_sum_to_the_log_likelihood_gain(stiffening_spring):
    without = stiffening_spring.parameters.clone()
    without[-1] = 0.0
    gain = log_likelihood(stiffening_spring, stiffening_spring.parameters) - log_likelihood(stiffening_spring, without)
    assert gain > 100.0
    assert float(attributed(stiffening_spring, 0).nats.sum()) == pytest.approx(gain, rel=0.02)


def test_the_region_of_a_stiffening_spring_is_far_from_zero(stiffening_spring):
    region = region_of(attributed(stiffening_spring, 0))
    assert (region.state, region.unit, region.kind) == ("angle", "rad", "far from zero")
    assert region.bound > 0.3
    assert region.share_of_gain > 0.7
    assert region.share_of_time <= 0.5


def test_the_run_of_large_swings_has_the_gain_of_a_stiffening_spring(stiffening_spring):
    large, small = shares_of_runs(attributed(stiffening_spring, 0))
    assert large > 0.95
    assert large + small == pytest.approx(1.0)


def test_the_map_sums_to_the_gain_and_is_nan_where_no_state_was(stiffening_spring):
    found = attributed(stiffening_spring, 0)
    drawn = map_of(found)
    assert drawn.states == ("angle", "speed")
    assert drawn.units == ("rad", "rad/s")
    assert float(drawn.nats.nansum()) == pytest.approx(float(found.nats.sum()))
    # the pendulum is never at its largest angle and speed at once
    assert bool(drawn.nats.isnan().any())


def attribution(nats, **places):
    return Attribution(torch.as_tensor(nats).double(), places, {}, {}, None)


@pytest.mark.parametrize(
    ("kind", "inside"),
    [
        ("below", lambda x: x < -0.8),
        ("above", lambda x: x > 0.8),
        ("near zero", lambda x: x.abs() < 0.1),
        ("far from zero", lambda x: x.abs() > 0.9),
    ],
)
def test_each_kind_of_region_is_recognised(kind, inside):
    x = torch.linspace(-1.0, 1.0, 2001, dtype=torch.float64)
    region = region_of(attribution(inside(x), x=x, still=torch.zeros_like(x)))
    assert (region.state, region.kind) == ("x", kind)
    assert region.share_of_gain == pytest.approx(1.0)
    assert region.share_of_time == pytest.approx(0.1, abs=0.002)


def test_an_effect_that_acts_everywhere_has_no_region():
    x = torch.linspace(-1.0, 1.0, 2001, dtype=torch.float64)
    assert region_of(attribution(torch.ones_like(x), x=x)) is None


def test_an_effect_without_gain_has_no_region():
    x = torch.linspace(-1.0, 1.0, 2001, dtype=torch.float64)
    assert region_of(attribution(-torch.ones_like(x), x=x)) is None


def test_gains_and_losses_that_cancel_have_neither_region_nor_shares():
    x = torch.linspace(-1.0, 1.0, 2001, dtype=torch.float64)
    run = (x > 0).long()
    found = Attribution(torch.where(x > 0, -0.9, 1.0).double(), {"x": x}, {}, {}, run)
    assert region_of(found) is None
    assert shares_of_runs(found) == ()


def test_a_single_state_has_no_map():
    x = torch.linspace(-1.0, 1.0, 2001, dtype=torch.float64)
    assert map_of(attribution(torch.ones_like(x), x=x, still=torch.zeros_like(x))) is None


def test_a_single_run_has_no_shares(stiffening_spring):
    found = attributed(stiffening_spring, 0)
    alone = Attribution(found.nats, found.places, found.units, found.parts, torch.zeros_like(found.run))
    assert shares_of_runs(alone) == ()


def test_a_port_without_parts_has_no_states():
    line = Line()
    model = JointModel(line, (Term(Offset(), None, {}),))
    fit = fitted(model, torch.cat([line.start(), line.time.new_zeros(3)]), graduate=False)
    assert attributed(fit, 0) is None

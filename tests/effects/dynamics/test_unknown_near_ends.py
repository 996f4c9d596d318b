"""An unnamed force that is steep near the ends of the range."""

import numpy as np
import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.effects import DYNAMICS
from mkc_torch.effects.dynamics.unknown_near_ends import NUMBERS, UnknownNearEnds, curve_within
from mkc_torch.simulation import Dynamics

OWN = UnknownNearEnds()


class Hover(Dynamics):
    states, inputs = ("height", "climb"), ("thrust",)
    parameters = {"mass": 1.1}
    units = {"height": "m", "climb": "m/s"}

    def derivative(self, time, x, u, p):
        return {"height": x.climb, "climb": u.thrust / p.mass - 9.81}


def basis(values, lowest, highest):
    return torch.stack([curve_within(values, lowest, highest, unit) for unit in torch.eye(NUMBERS).double()], -1)


def remaining_rms(design, values):
    """RMS residual of a regression of values on a design and a constant."""
    design = torch.cat([design, torch.ones_like(design[:, :1])], -1)
    return float(
        (values - design @ torch.linalg.lstsq(design, values.unsqueeze(-1)).solution[:, 0]).square().mean().sqrt()
    )


def test_basis_is_a_cubic_and_terms_that_rise_towards_the_ends():
    x = torch.linspace(-3.0, 3.0, 121, dtype=torch.float64)
    found = basis(x, -1.0, 2.0).numpy()
    t = np.clip(x.numpy() / 2.0, -1.0, 1.0)
    np.testing.assert_allclose(found[:, :3], np.polynomial.legendre.legvander(t, 3)[:, 1:], atol=1e-12)
    inside = np.clip(x.numpy(), -1.0, 2.0)
    for k, width in ((3, 1.2), (5, 0.45)):
        np.testing.assert_allclose(found[:, k], np.clip(1.0 - (inside + 1.0) / width, 0.0, None) ** 3, atol=1e-12)
        np.testing.assert_allclose(found[:, k + 1], np.clip(1.0 - (2.0 - inside) / width, 0.0, None) ** 3, atol=1e-12)


def test_ground_effect_is_fitted_seven_times_as_closely_as_by_a_polynomial():
    height = 0.2 + 1.3 * torch.linspace(0.0, 1.0, 1301, dtype=torch.float64)
    lift = 9.81 / (1.0 - 0.0055 / height.square()) - 9.81
    powers = torch.stack([(height / 1.5) ** k for k in range(1, 5)], -1)
    assert 7.0 * remaining_rms(basis(height, 0.2, 1.5), lift) < remaining_rms(powers, lift)
    assert remaining_rms(basis(height, 0.2, 1.5), lift) < 0.02 * float(lift.std())


def test_range_is_from_the_recording():
    time = torch.arange(0.0, 6.0, 0.05, dtype=torch.float64)
    height = 0.5 + 0.3 * torch.cos(3.0 * time)
    terms = candidate_terms(Hover().prepare(Recording({"time": time, "height": height, "thrust": time})), (), DYNAMICS)
    (curve,) = [term for term in terms if isinstance(term.effect, UnknownNearEnds)]
    assert curve.port == "rate of climb"
    assert curve.shape["lowest_of_position"] == pytest.approx(0.2, abs=0.01)
    assert curve.shape["highest_of_position"] == pytest.approx(0.8, abs=0.01)
    # it has the key of the polynomial over the same position, so that only the better curve is reported
    assert len({term.key for term in terms if term.effect.id == "unknown" and term.port == curve.port}) == 1


def test_a_range_without_width_is_finite():
    found = basis(torch.tensor([-1.0, 0.0, 2.0], dtype=torch.float64), 0.0, 0.0)
    assert bool(found.isfinite().all())


def test_code_equals_the_curve():
    x, gamma = (
        torch.linspace(0.0, 2.0, 41, dtype=torch.float64),
        torch.linspace(-1.0, 1.0, NUMBERS, dtype=torch.float64),
    )
    shape = {"lowest_of_position": 0.3, "highest_of_position": 1.7}
    (line,) = OWN.code(gamma.tolist(), shape, {"position": "x", "own": "v"})
    written = eval(line, {"curve_within": curve_within, "x": x})
    torch.testing.assert_close(written, curve_within(x, 0.3, 1.7, gamma))

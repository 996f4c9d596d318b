"""Shape parameters of effects are fitted jointly, starting from the points of the grid."""

from dataclasses import replace

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import ShapedModel, candidate_terms, reach_of, shape_fitted
from mkc_torch.diagnosis.search.estimate import estimate
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Dynamics, Parameter

EFFECTS = {effect.id: effect for effect in DYNAMICS}
N = 400


class Lag(Dynamics):
    """A first-order lag."""

    states = ("level",)
    inputs = ("drive",)
    parameters = {"rate": Parameter(2.0, lower=0.0)}
    step = 0.05

    def derivative(self, time, x, u, p):
        return {"level": p.rate * (u.drive - x.level)}


def driven(act, seed=0, behind=0.0):
    """Return the level of a lag whose drive is distorted by ``act``, seen by a sensor with a lag of ``behind`` s."""
    generator = torch.Generator().manual_seed(seed)
    time = 0.05 * torch.arange(N, dtype=torch.float64)
    drive = 2.0 * torch.sin(0.9 * time) + torch.sin(2.3 * time + 1.0)
    fine = torch.linspace(0.0, float(time[-1]), 20 * (N - 1) + 1, dtype=torch.float64)
    seen = act(2.0 * torch.sin(0.9 * fine) + torch.sin(2.3 * fine + 1.0))
    step = float(fine[1])
    level = [0.0]
    for now, after in zip(seen[:-1].tolist(), seen[1:].tolist(), strict=True):
        level.append(level[-1] + step * 1.7 * (0.5 * (now + after) - level[-1]))
    shown = [0.0]
    for true_level in level[1:]:
        shown.append(true_level if behind == 0.0 else shown[-1] + step / behind * (true_level - shown[-1]))
    noise = 0.01 * torch.randn(N, generator=generator, dtype=torch.float64)
    return Recording({"time": time, "drive": drive, "level": torch.tensor(shown[::20], dtype=torch.float64) + noise})


def joint_fit(recording, *known):
    """Return the joint fit with effects, each followed by its shape on the grid."""
    prepared = Lag().prepare(recording)
    terms = []
    for effect, shape in zip(known[::2], known[1::2], strict=True):
        (term, *_) = candidate_terms(prepared, (), (effect,))
        terms.append(replace(term, shape={**term.shape, **shape}))
    base = fitted(JointModel(prepared), prepared.start())
    half = base.parameters.new_full((len(terms),), 0.5)
    return fitted(JointModel(prepared, terms), torch.cat([base.parameters, half]), base.bound)


def test_a_saturation_limit_between_grid_points_is_estimated():
    recording = driven(lambda u: 1.37 * torch.tanh(u / 1.37))
    before = joint_fit(recording, EFFECTS["input_saturation"], {"limit": 1.8})
    after = shape_fitted(before)
    assert before.model.terms[-1].shape["limit"] == 1.8
    assert after.log_likelihood > before.log_likelihood + 100.0
    # the drive does not reach the limit of the hyperbolic tangent, so limit and share are only known together
    shape = after.model.terms[-1].shape
    reached = after.parameters[-1] * (shape["limit"] - 2.8) + 2.8
    assert float(reached) == pytest.approx(1.37, abs=0.03)
    assert shape["softness"] > 0.3
    assert float(after.residual.square().mean().sqrt()) < 0.0115


def test_a_hard_limit_has_a_softness_near_zero():
    recording = driven(lambda u: u.clamp(-1.37, 1.37))
    after = shape_fitted(joint_fit(recording, EFFECTS["input_saturation"], {"limit": 1.2}))
    shape = after.model.terms[-1].shape
    assert shape["limit"] == pytest.approx(1.37, abs=0.01)
    assert shape["softness"] < 0.05
    assert float(after.parameters[-1]) == pytest.approx(1.0, abs=0.01)


def test_a_delay_and_its_share_are_estimated_jointly():
    late = driven(lambda u: torch.cat([u[:1].expand(123), u[:-123]]))  # 123 of 20 for each 0.05 s
    after = shape_fitted(joint_fit(late, EFFECTS["input_delay"], {"delay": 0.2}))
    assert after.model.terms[-1].shape["delay"] == pytest.approx(0.3075, abs=0.01)
    assert float(after.parameters[-1]) == pytest.approx(1.0, abs=0.02)


def test_the_shapes_of_two_effects_are_fitted_jointly():
    recording = driven(lambda u: u.clamp(-1.37, 1.37), behind=0.15)
    before = joint_fit(recording, EFFECTS["input_saturation"], {"limit": 1.2}, EFFECTS["sensor_lag"], {"lag": 0.3})
    limit, lag = (term.shape for term in shape_fitted(before).model.terms)
    assert limit["limit"] == pytest.approx(1.37, abs=0.02)
    assert lag["lag"] == pytest.approx(0.15, abs=0.03)
    assert all(isinstance(value, float) for value in (*limit.values(), *lag.values()))


def test_an_effect_without_shape_parameters_is_unchanged():
    prepared = Lag().prepare(driven(lambda u: u))
    (term,) = candidate_terms(prepared, (), (EFFECTS["constant_force"],))
    model = JointModel(prepared, (term,))
    fit = fitted(model, torch.cat([prepared.start(), prepared.time.new_zeros(1)]))
    assert shape_fitted(fit) is fit


class Broken(type(EFFECTS["input_saturation"])):
    """An effect that is finite only for shapes of the grid."""

    def waveform(self, shape, context):
        course = super().waveform(shape, context)
        return course if isinstance(shape["limit"], float) else course * torch.nan


def test_the_grid_shape_stays_if_the_simulation_is_not_finite():
    recording = driven(lambda u: u.clamp(-1.37, 1.37))
    fit = joint_fit(recording, Broken(), {"limit": 1.2})
    assert shape_fitted(fit) is fit


def test_parameters_are_followed_by_logarithms_of_the_shape():
    recording = driven(lambda u: u.clamp(-1.37, 1.37))
    fit = joint_fit(recording, EFFECTS["input_saturation"], {"limit": 1.2})
    reach = reach_of(fit.model.terms[-1], fit.model.prepared)
    largest = float(recording["drive"].abs().max())
    assert reach["limit"] == pytest.approx((0.2 * largest, 1.5 * largest))
    model = ShapedModel.of(fit.model)
    start = model.start(fit.parameters)
    assert model.size == len(start) == fit.model.size + 2
    low, high = model.bounds
    assert len(low) == len(high) == model.size
    assert bool(((low <= start) & (start <= high)).all())
    assert float(high[-2].exp()) == pytest.approx(1.5 * largest)
    torch.testing.assert_close(model.residual(start), fit.model.residual(fit.parameters))
    assert model.prior is None or len(model.prior.mean) == model.size


def test_errors_equal_least_squares_with_the_shape_as_a_parameter():
    """In white normal noise: σ² (JᵀJ)⁻¹, J by differences of parameters and limit."""
    fit = shape_fitted(
        joint_fit(driven(lambda u: u.clamp(-1.37, 1.37), seed=2), EFFECTS["input_saturation"], {"limit": 1.2})
    )
    final = estimate(fit, NoiseSettings())
    shape, theta = final.fit.model.terms[-1].shape, final.fit.parameters
    (errors,) = final.shape_errors
    assert set(errors) == {"limit"}  # the softness is at the end of its range

    def residual(values):
        moved = final.fit.model.with_shape({**shape, "limit": float(values[-1])})
        return moved.residual(values[:-1]).squeeze(-1)

    at = torch.cat([theta, theta.new_tensor([shape["limit"]])])
    columns = []
    for k in range(len(at)):
        step = torch.zeros_like(at)
        step[k] = 1e-4 * at[k]
        columns.append((residual(at + step) - residual(at - step)) / (2.0 * step[k]))
    slopes = torch.stack(columns, -1)
    covariance = float(residual(at).square().sum()) / (N - len(at)) * torch.linalg.inv(slopes.mT @ slopes)
    known = covariance.diagonal().sqrt()
    assert errors["limit"] == pytest.approx(float(known[-1]), rel=0.2)
    assert float(final.standard_error[-1]) == pytest.approx(float(known[-2]), rel=0.2)
    alone = float(torch.linalg.inv(covariance).diagonal()[-2].rsqrt())
    assert float(final.standard_error[-1]) > 2.0 * alone  # with the limit fixed, the error is far too small
    assert shape["limit"] == pytest.approx(1.37, abs=3.0 * errors["limit"])


@pytest.mark.parametrize("wrong", [{"limit": (1.0, 1.0)}, {"limit": (2.0, 1.0)}, {"magic": (1.0, 2.0)}])
def test_an_empty_range_raises(wrong):
    fit = joint_fit(driven(lambda u: u.clamp(-1.37, 1.37)), EFFECTS["input_saturation"], {"limit": 1.2})
    term = fit.model.terms[-1]
    effect = type("Mine", (type(term.effect),), {"fitted_shape": wrong})()
    with pytest.raises(ValueError, match=r"`fitted_shape` of input_saturation.*limit, softness.*got `\w+`"):
        reach_of(replace(term, effect=effect), fit.model.prepared)

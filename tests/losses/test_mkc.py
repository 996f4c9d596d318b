import copy
import io
import math
import pickle

import numpy as np
import pytest
import torch
from torch import nn
from torch.autograd import gradcheck, gradgradcheck
from torch.func import functional_call, grad, stack_module_state, vmap

from mkc_torch import MKCDistribution, MKCLoss
from mkc_torch.density.energy import KAPPA_MAX
from mkc_torch.functional import log_normalizer, mkc_energy, mkc_nll, mkc_weight

INF, NAN = math.inf, math.nan
REDUCTIONS = ["none", "mean", "sum"]
each_reduction = pytest.mark.parametrize("reduction", REDUCTIONS)
FIXED = {"learn_sigma": False, "learn_d": False}
SIGMA, D, BOUND = [0.7, 3.0, 20.0], [0.5, 1.0, 2.0], [9.0, 40.0, 1e3]


def data(*shape, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [(3 * torch.randn(*shape, dtype=torch.float64, generator=generator)).to(dtype) for _ in range(2)]


def make_loss(num_channels=3, *, dtype=torch.float64, **options):
    """A learned loss of three different channels, in float64 from the start."""
    m = num_channels
    settings = {"sigma": SIGMA[:m], "d": D[:m], "bound": BOUND[:m], **options}
    return MKCLoss(m, **{k: torch.tensor(v, dtype=dtype) if isinstance(v, list) else v for k, v in settings.items()})


def expected_nll(loss, error):
    return mkc_nll(error, loss.sigma, loss.d, loss.bound)


def reduced(values, reduction):
    return {"none": values, "mean": values.mean(), "sum": values.sum()}[reduction]


def gradients(value, *leaves):
    return torch.autograd.grad(value.sum(), leaves, retain_graph=True)


# --- value and gradient


@each_reduction
def test_fixed_infinite_sigma_equals_weighted_squared_error(reduction):
    loss = make_loss(sigma=INF, reduction=reduction, **FIXED)
    x, y = data(5, 3)
    x.requires_grad_()
    found = loss(x, y)
    expected = reduced(0.5 * ((x - y) / loss.d) ** 2, reduction)
    torch.testing.assert_close(found, expected, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(gradients(found, x), gradients(expected, x), rtol=1e-14, atol=1e-14)


@each_reduction
def test_infinite_sigma_with_learned_d_equals_the_gaussian_nll_in_value_and_gradient(reduction):
    loss = make_loss(sigma=INF, bound=1e3, learn_sigma=False, reduction=reduction)
    x, y = data(6, 3)
    x.requires_grad_()
    d = loss.d.detach().clone().requires_grad_()
    found = loss(x, y)
    expected = nn.GaussianNLLLoss(full=True, reduction=reduction)(x, y, (d**2).expand(6, 3))
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(gradients(found, x), gradients(expected, x), rtol=1e-12, atol=1e-12)
    (by_raw,) = gradients(loss(x, y), loss.raw_d)
    (chain,) = gradients(loss.d, loss.raw_d)
    torch.testing.assert_close(by_raw / chain, gradients(expected, d)[0], rtol=1e-9, atol=1e-12)


def test_fixed_sigma_and_d_give_the_papers_energy_over_the_channels():
    loss = make_loss(**FIXED)
    assert not loss.normalize
    x, y = data(7, 3)
    kernel = torch.exp(-((x - y) ** 2) / (2 * loss.d**2 * loss.sigma**2))
    paper = (loss.sigma**2 * (1 - kernel.mean(0))).sum()  # (9)
    assert loss(x, y).item() == pytest.approx(paper.item() / 3, rel=1e-12)
    assert not list(loss.parameters())


@each_reduction
@pytest.mark.parametrize("learned", [(True, True), (True, False), (False, True)])
def test_the_learned_loss_equals_the_nll(reduction, learned):
    loss = make_loss(reduction=reduction, learn_sigma=learned[0], learn_d=learned[1])
    x, y = data(8, 3)
    x.requires_grad_()
    expected = reduced(expected_nll(loss, x - y), reduction)
    leaves = [x, *loss.parameters()]
    assert len(leaves) == 1 + sum(learned)
    torch.testing.assert_close(loss(x, y), expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(gradients(loss(x, y), *leaves), gradients(expected, *leaves), rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(loss.log_normalizer(), log_normalizer(loss.sigma, loss.d, loss.bound))


def test_normalize_adds_the_normalizer_to_a_fixed_loss_and_leaves_its_gradient():
    plain, normalized = make_loss(**FIXED), make_loss(normalize=True, **FIXED)
    x, y = data(8, 3)
    x.requires_grad_()
    torch.testing.assert_close(normalized(x, y), plain(x, y) + plain.log_normalizer().mean())
    torch.testing.assert_close(gradients(normalized(x, y), x), gradients(plain(x, y), x))


@each_reduction
def test_the_gradient_of_an_outlier_is_scaled_by_its_weight(reduction):
    loss = make_loss(reduction=reduction, **FIXED)
    x, y = data(4, 3)
    y[2, 1] += 1e6
    x.requires_grad_()
    (slope,) = gradients(loss(x, y), x)
    error = (x - y).detach()
    expected = mkc_weight(error, loss.sigma, loss.d) * error / loss.d**2 / (12 if reduction == "mean" else 1)
    torch.testing.assert_close(slope, expected, rtol=1e-12, atol=1e-300)
    assert slope[2, 1] == 0


@pytest.mark.parametrize(
    ("shape", "channel_dim"),
    [
        *[((3,), 0), ((3,), -1), ((5, 3), -1), ((5, 3), 1), ((3, 5), 0), ((5, 3, 4), 1), ((5, 3, 4), -2)],
        *[((3, 5, 4), 0), ((3, 5, 4), -3), ((2, 3, 2, 2, 2), 1), ((2, 2, 2, 2, 3), 4)],
    ],
)
@each_reduction
def test_channels_may_lie_in_any_dimension_of_any_rank(shape, channel_dim, reduction):
    loss = make_loss(channel_dim=channel_dim, reduction=reduction)
    x, y = data(*shape)
    last = expected_nll(loss, (x - y).movedim(channel_dim, -1)).movedim(-1, channel_dim)
    torch.testing.assert_close(loss(x, y), reduced(last, reduction))
    weight = torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    if reduction == "none":
        torch.testing.assert_close(loss(x, y, weight), weight * last)
    else:
        divisor = weight.sum() if reduction == "mean" else 1.0
        torch.testing.assert_close(loss(x, y, weight), (weight * last).sum() / divisor)


# --- weights and masks


@each_reduction
def test_weights_per_sample_equal_weights_per_element(reduction):
    loss = make_loss(channel_dim=1, reduction=reduction)
    x, y = data(5, 3, 4)
    values = expected_nll(loss, (x - y).movedim(1, -1)).movedim(-1, 1)
    per_sample = torch.linspace(0, 2, 20, dtype=torch.float64).reshape(5, 4)
    for weight, full in ((per_sample, per_sample[:, None].expand(5, 3, 4)), (values.abs(), values.abs())):
        weight, full = weight.detach(), full.detach()
        for given in (weight, weight.float(), weight.bfloat16()):
            w = full if given is weight else full.to(given.dtype).double()
            expected = {"none": w * values, "sum": (w * values).sum(), "mean": (w * values).sum() / w.sum()}[reduction]
            torch.testing.assert_close(loss(x, y, given), expected)


@each_reduction
def test_the_weight_of_a_sample_of_rank_one_applies_to_all_channels(reduction):
    loss = make_loss(reduction=reduction)
    x, y = data(3)
    values = expected_nll(loss, x - y)
    expected = {"none": 2 * values, "sum": 2 * values.sum(), "mean": values.mean()}[reduction]
    torch.testing.assert_close(loss(x, y, torch.tensor(2.0)), expected)


@each_reduction
def test_equal_weights_leave_the_mean_and_scale_the_sum(reduction):
    loss = make_loss(reduction=reduction)
    x, y = data(5, 3)
    factor = 1 if reduction == "mean" else 2
    torch.testing.assert_close(loss(x, y, torch.full((5,), 2.0)), factor * loss(x, y))


@each_reduction
@pytest.mark.parametrize("poison", [NAN, INF, -INF, 1e300])
@pytest.mark.parametrize("where", ["input", "target", "both"])
@pytest.mark.parametrize("kind", ["mask", "zero weight"])
def test_masked_elements_affect_neither_value_nor_gradient(reduction, poison, where, kind):
    loss = make_loss(reduction=reduction)
    x, y = data(5, 3)
    mask = torch.ones(5, 3, dtype=torch.bool)
    mask[1, 2] = mask[4, 0] = False
    weight = mask if kind == "mask" else mask.double()

    def all_of(x, y):
        x, y = x.clone().requires_grad_(), y.clone().requires_grad_()
        value = loss(x, y, weight)
        return [value.detach(), *gradients(value, x, y, loss.raw_kappa, loss.raw_d)]

    expected = all_of(x, y)
    if where in ("input", "both"):
        x[~mask] = poison
    if where in ("target", "both"):
        y[~mask] = poison
    found = all_of(x, y)
    assert all(map(torch.equal, found, expected))
    assert all(t.isfinite().all() for t in found)
    assert (found[1][~mask] == 0).all()
    if reduction == "none":
        assert (found[0][~mask] == 0).all()


def test_masked_mean_is_the_mean_over_unmasked_elements():
    loss = make_loss()
    x, y = data(6, 3)
    mask = torch.tensor([True, False, True, True, False, True])
    torch.testing.assert_close(loss(x, y, mask), loss(x[mask], y[mask]))


@each_reduction
def test_all_weights_zero_give_zero_with_zero_gradients(reduction):
    loss = make_loss(reduction=reduction)
    x = torch.full((4, 3), NAN, dtype=torch.float64, requires_grad=True)
    for weight in (torch.zeros(4, 3), torch.zeros(4), torch.zeros(4, dtype=torch.bool)):
        value = loss(x, data(4, 3)[1], weight)
        assert (value == 0).all()
        assert all((g == 0).all() for g in gradients(value, x, loss.raw_kappa, loss.raw_d))


@each_reduction
def test_one_extreme_outlier_leaves_a_finite_loss_and_finite_gradients(reduction):
    loss = MKCLoss(2, sigma=2.0, bound=50.0, reduction=reduction)
    for size in (60.0, 1e10, 1e20, 1e30):
        x = torch.zeros(4, 2, requires_grad=True)
        y = torch.zeros(4, 2)
        y[1, 1] = size
        value = loss(x, y)
        assert value.isfinite().all()
        assert all(g.isfinite().all() for g in gradients(value, x, loss.raw_kappa, loss.raw_d))


# --- dtypes


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@each_reduction
def test_half_precision_inputs_give_a_float32_loss(dtype, reduction):
    loss = make_loss(dtype=torch.float32, reduction=reduction)
    x, y = data(5, 3, dtype=dtype)
    x.requires_grad_()
    value = loss(x, y)
    assert value.dtype == torch.float32
    torch.testing.assert_close(value, loss(x.float(), y.float()), rtol=0, atol=0)
    assert gradients(value, x)[0].dtype == dtype
    assert loss(x, y.float()).dtype == torch.float32


def test_sums_of_half_precision_do_not_overflow():
    loss = MKCLoss(1, sigma=INF, d=1.0, reduction="sum", **FIXED)
    x = torch.full((1000, 1), 200.0, dtype=torch.float16)
    assert loss(x, -x).item() == pytest.approx(1000 * 0.5 * 400**2, rel=1e-6)


@each_reduction
def test_autocast_changes_nothing(reduction):
    loss = make_loss(dtype=torch.float32, reduction=reduction)
    x, y = data(5, 3, dtype=torch.float32)
    x.requires_grad_()
    expected = loss(x, y)
    leaves = [x, loss.raw_kappa, loss.raw_d]
    slopes = gradients(expected, *leaves)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = loss(x, y)
    assert found.dtype == torch.float32
    assert torch.equal(found, expected)
    assert all(map(torch.equal, gradients(found, *leaves), slopes))


def test_loss_of_a_layer_under_autocast_is_float32():
    layer, loss = nn.Linear(2, 3), MKCLoss(3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        output = layer(torch.ones(4, 2))
        assert output.dtype == torch.bfloat16
        assert loss(output, torch.zeros(4, 3)).dtype == torch.float32


def test_double_inputs_are_computed_in_double_by_a_float32_module():
    loss = make_loss(sigma=2.0, d=1.0, bound=32.0, dtype=torch.float32)
    x, y = data(5, 3)
    value = loss(x, y)
    assert value.dtype == torch.float64
    exact = mkc_energy(x - y, loss.sigma.double(), loss.d.double()).mean() + loss.log_normalizer().double().mean()
    torch.testing.assert_close(value, exact, rtol=1e-6, atol=0)
    fixed = make_loss(sigma=2.0, d=1.0, bound=32.0, dtype=torch.float32, **FIXED)
    torch.testing.assert_close(fixed(x, y), mkc_energy(x - y, 2.0, 1.0).mean(), rtol=1e-13, atol=0)
    gradients(value, loss.raw_kappa)


def test_to_float64_converts_everything_and_keeps_the_values():
    loss = make_loss(dtype=torch.float32)
    before = loss.sigma.double(), loss.d.double()
    loss = loss.to(torch.float64)
    assert {t.dtype for t in loss.state_dict().values()} == {torch.float64}
    torch.testing.assert_close((loss.sigma, loss.d), before, rtol=1e-6, atol=0)
    x, y = data(5, 3)
    torch.testing.assert_close(loss(x, y), expected_nll(loss, x - y).mean(), rtol=1e-12, atol=0)
    loss.sigma, loss.d = 1.5, 0.25
    torch.testing.assert_close(loss.sigma, torch.full((3,), 1.5, dtype=torch.float64), rtol=1e-13, atol=0)
    torch.testing.assert_close(loss.d, torch.full((3,), 0.25, dtype=torch.float64), rtol=1e-12, atol=0)


# --- copies and states


@pytest.mark.parametrize("options", [{}, FIXED, {"learn_d": False}], ids=["learned", "fixed", "half"])
def test_copies_and_pickles_are_equal_and_independent(options):
    loss = make_loss(**options)
    x, y = data(5, 3)
    for twin in (copy.deepcopy(loss), pickle.loads(pickle.dumps(loss))):
        assert torch.equal(twin(x, y), loss(x, y))
        twin.d = 0.8
        assert not torch.equal(twin(x, y), loss(x, y))
        torch.testing.assert_close(loss.d, torch.tensor(D, dtype=torch.float64))


@pytest.mark.parametrize("options", [{}, FIXED, {"learn_sigma": False}], ids=["learned", "fixed", "half"])
def test_state_dict_carries_bound_and_d_min_into_a_loss_made_with_others(options):
    loss = make_loss(d_min=[0.01] * 3, **options)
    other = make_loss(sigma=[1.0] * 3, d=[5.0] * 3, bound=[6.0] * 3, d_min=[0.3] * 3, **options)
    buffer = io.BytesIO()
    torch.save(loss.state_dict(), buffer)
    buffer.seek(0)
    assert {"fixed_bound", "fixed_d_min"} <= set(loss.state_dict())
    other.load_state_dict(torch.load(buffer, weights_only=True))
    x, y = data(5, 3)
    for name in ("sigma", "d", "bound", "d_min"):
        assert torch.equal(getattr(other, name), getattr(loss, name))
    assert torch.equal(other(x, y), loss(x, y))


def test_state_dict_of_another_number_of_channels_is_refused():
    with pytest.raises(RuntimeError, match="size mismatch"):
        make_loss(3).load_state_dict(make_loss(2).state_dict())
    with pytest.raises(RuntimeError, match="size mismatch"):
        MKCLoss(3).load_state_dict(MKCLoss(1).state_dict())


@pytest.mark.parametrize("learned", [{}, {"learn_d": False}, {"learn_sigma": False}], ids=["both", "sigma", "d"])
def test_a_learned_loss_loads_into_a_fixed_loss_and_back(learned):
    loss, fixed, again = (
        make_loss(**learned),
        make_loss(sigma=9.0, d=0.3, **FIXED),
        make_loss(sigma=9.0, d=0.3, **learned),
    )
    fixed.load_state_dict(loss.state_dict())
    again.load_state_dict(fixed.state_dict())
    for other in (fixed, again):
        for name in ("sigma", "d", "bound", "d_min"):
            found = getattr(other, name).double()
            torch.testing.assert_close(found, getattr(loss, name).double(), rtol=1e-5, atol=0.0)


def test_a_fixed_gaussian_does_not_load_into_a_learned_loss():
    with pytest.raises(RuntimeError, match="raw_kappa"):
        make_loss().load_state_dict(make_loss(sigma=INF, **FIXED).state_dict())


# --- sigma, d and their bounds


@pytest.mark.parametrize("options", [{}, FIXED], ids=["learned", "fixed"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sigma_and_d_are_the_given_and_the_assigned_values(options, dtype):
    loss = make_loss(dtype=dtype, **options)
    tolerance = {"rtol": 2e-6 if dtype == torch.float32 else 1e-12, "atol": 0}
    torch.testing.assert_close(loss.sigma, torch.tensor(SIGMA, dtype=dtype), **tolerance)
    torch.testing.assert_close(loss.d, torch.tensor(D, dtype=dtype), **tolerance)
    loss.sigma, loss.d = 1.5, torch.tensor([0.25, 0.5, 4.0], dtype=dtype)
    torch.testing.assert_close(loss.sigma, torch.full((3,), 1.5, dtype=dtype), **tolerance)
    torch.testing.assert_close(loss.d, torch.tensor([0.25, 0.5, 4.0], dtype=dtype), **tolerance)
    loss.sigma = torch.tensor([0.1, 5.0, 50.0])
    torch.testing.assert_close(loss.sigma, torch.tensor([0.1, 5.0, 50.0], dtype=dtype), rtol=1e-5, atol=0)
    assert loss.sigma.shape == loss.d.shape == (3,)
    assert loss.sigma.requires_grad == (not options)


@pytest.mark.parametrize("sigma", [0.05, 0.06, 1.0, 1e3, 1e4])
def test_sigma_survives_its_parametrisation_over_its_range_in_float32(sigma):
    assert MKCLoss(1, sigma=sigma, **FIXED).sigma.item() == pytest.approx(sigma, rel=1e-6)
    loss = MKCLoss(1, sigma=sigma)
    assert loss.sigma.item() == pytest.approx(sigma, rel=1e-4)
    assert all(p.isfinite().all() for p in loss.parameters())
    value = loss(torch.ones(2, 1), torch.zeros(2, 1))
    assert all(g.isfinite().all() for g in gradients(value, *loss.parameters()))


def test_a_fixed_sigma_can_be_set_to_infinity_and_back():
    loss = make_loss(**FIXED)
    loss.sigma = torch.tensor([INF, 2.0, INF])
    assert loss.sigma.tolist() == pytest.approx([INF, 2.0, INF])
    x, y = data(4, 3)
    torch.testing.assert_close(loss(x, y), mkc_energy(x - y, loss.sigma, loss.d).mean())
    loss.sigma = 3.0
    assert loss.sigma.tolist() == pytest.approx([3.0] * 3)


def test_a_learned_sigma_cannot_be_set_to_infinity():
    loss = make_loss()
    with pytest.raises(ValueError, match="finite `sigma`"):
        loss.sigma = INF
    assert all(p.isfinite().all() for p in loss.parameters())


def test_setters_keep_the_parameter_objects_of_an_optimiser():
    loss = make_loss()
    before = list(loss.parameters())
    loss.sigma, loss.d = 1.0, 1.0
    assert all(a is b for a, b in zip(before, loss.parameters(), strict=True))
    assert all(p.requires_grad for p in loss.parameters())


@pytest.mark.parametrize("value", [0.049, 0.0, -1.0, NAN])
def test_sigma_setter_refuses_values_out_of_range(value):
    for loss in (make_loss(), make_loss(**FIXED)):
        with pytest.raises(ValueError, match="`sigma` in"):
            loss.sigma = value
        with pytest.raises(ValueError, match=r"shape \(3,\).*got \(2,\)"):
            loss.sigma = torch.ones(2)


@pytest.mark.parametrize("value", [0.0, -1.0, NAN, INF])
def test_d_setter_refuses_values_that_are_not_positive_and_finite(value):
    for loss in (make_loss(), make_loss(**FIXED)):
        with pytest.raises(ValueError, match=r"`d`.*positive and finite"):
            loss.d = value
        with pytest.raises(ValueError, match=r"shape \(3,\).*got \(2,\)"):
            loss.d = torch.ones(2)


@pytest.mark.parametrize("value", [0.01, 0.005, 40.0, 50.0])
def test_d_setter_refuses_values_not_between_its_bounds(value):
    loss = make_loss(bound=40.0, d_min=0.01)
    with pytest.raises(ValueError, match="`d` between `d_min`"):
        loss.d = value
    torch.testing.assert_close(loss.d, torch.tensor(D, dtype=torch.float64))


def test_bounds_hold_after_violent_steps():
    for seed in range(3):
        loss = make_loss(dtype=torch.float32, d_min=0.01)
        optimiser = torch.optim.SGD(loss.param_groups(), lr=1e3)
        x, y = data(16, 3, dtype=torch.float32, seed=seed)
        for step in range(200):
            optimiser.zero_grad()
            loss(x * 10 ** (step % 5 - 2), y).backward()
            optimiser.step()
            assert ((loss.kappa >= 0) & (loss.kappa <= KAPPA_MAX)).all()
            assert ((loss.d >= loss.d_min) & (loss.d <= loss.bound * (1 + 1e-6))).all()
        assert loss(x, y).isfinite()
        assert all(p.isfinite().all() for p in loss.parameters())
        assert (loss.sigma >= 0.0499).all()


def test_getters_return_the_optimised_values():
    torch.manual_seed(0)
    loss = MKCLoss(2, sigma=5.0, d=1.0, bound=100.0)
    y = torch.randn(2000, 2) * torch.tensor([0.3, 4.0])
    optimiser = torch.optim.Adam(loss.param_groups(lr=0.1))
    for _ in range(150):
        optimiser.zero_grad()
        loss(torch.zeros_like(y), y).backward()
        optimiser.step()
    assert loss.d.tolist() == pytest.approx([0.3, 4.0], rel=0.1)
    torch.testing.assert_close(loss.sigma, loss.kappa.rsqrt())


def test_the_default_bound_is_a_hundred_times_the_initial_d_and_constant():
    loss = MKCLoss(2, d=torch.tensor([0.5, 3.0]))
    assert loss.bound.tolist() == [50.0, 300.0]
    torch.testing.assert_close(loss.d_min, torch.tensor([0.5e-3, 3e-3]))
    optimiser = torch.optim.SGD(loss.parameters(), lr=1.0)
    for _ in range(5):
        optimiser.zero_grad()
        loss(torch.zeros(4, 2), torch.ones(4, 2)).backward()
        optimiser.step()
    assert abs(loss.d[0].item() - 0.5) > 0.01
    assert loss.bound.tolist() == [50.0, 300.0]
    loss.d = 2.0
    assert loss.bound.tolist() == [50.0, 300.0]


def test_param_groups_are_free_of_weight_decay_and_take_options():
    loss = make_loss()
    (group,) = loss.param_groups(lr=0.5)
    assert set(map(id, group["params"])) == set(map(id, loss.parameters()))
    assert group["weight_decay"] == 0
    assert group["lr"] == 0.5
    assert make_loss(**FIXED).param_groups() == []
    assert len(make_loss(learn_d=False).param_groups()[0]["params"]) == 1
    model = nn.Linear(2, 3)
    optimiser = torch.optim.AdamW([{"params": model.parameters()}, *loss.param_groups()], lr=0.1, weight_decay=0.5)
    before, weights = loss.raw_kappa.detach().clone(), model.weight.detach().clone()
    for p in (*model.parameters(), *loss.parameters()):
        p.grad = torch.zeros_like(p)
    optimiser.step()
    assert torch.equal(loss.raw_kappa, before)
    assert not torch.equal(model.weight, weights)


# --- derivatives and statistics


@pytest.mark.parametrize("weighted", [False, True])
@each_reduction
def test_gradcheck_in_input_target_and_both_parameters(reduction, weighted):
    loss = make_loss(2, reduction=reduction)
    x, y = data(3, 2)
    weight = torch.tensor([[1.0, 0.5], [0.0, 2.0], [1.5, 0.2]], dtype=torch.float64) if weighted else None

    def f(x, y, raw_kappa, raw_d):
        return functional_call(loss, {"raw_kappa": raw_kappa, "raw_d": raw_d}, (x, y, weight))

    leaves = [t.detach().clone().requires_grad_() for t in (x, y, loss.raw_kappa, loss.raw_d)]
    assert gradcheck(f, leaves)
    assert gradgradcheck(f, leaves)


def test_the_gradient_by_the_weights_passes_gradcheck():
    loss = make_loss()
    x, y = data(4, 3)
    weight = torch.rand(4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).add(0.1).requires_grad_()
    assert gradcheck(lambda w: loss(x, y, w), (weight,))


def test_parameters_of_the_density_are_recovered_from_samples():
    torch.manual_seed(1)
    sigma, d, bound, count = 1.5, 0.7, 20.0, 20_000
    y = MKCDistribution(*(torch.tensor(v, dtype=torch.float64) for v in (sigma, d, bound))).sample((count, 1))
    loss = MKCLoss(1, sigma=3.0, d=2.0, bound=bound).double()
    optimiser = torch.optim.LBFGS(loss.parameters(), max_iter=100, line_search_fn="strong_wolfe", tolerance_grad=1e-9)

    def closure():
        optimiser.zero_grad()
        value = loss(torch.zeros_like(y), y)
        value.backward()
        return value

    optimiser.step(closure)

    def mean_nll(parameters):
        return mkc_nll(y[:, 0], parameters[0], parameters[1], bound).mean()

    found = torch.cat([loss.sigma, loss.d]).detach()
    information = count * torch.autograd.functional.hessian(mean_nll, found)
    errors = torch.linalg.inv(information).diagonal().sqrt()
    assert ((found - torch.tensor([sigma, d])).abs() <= 4 * errors).all()
    assert (errors < 0.02).all()


# --- bad arguments


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"num_channels": 0}, ValueError, "`num_channels` to be a positive integer but got 0"),
        ({"num_channels": -1}, ValueError, "`num_channels` to be a positive integer but got -1"),
        ({"num_channels": True}, ValueError, "`num_channels` to be a positive integer but got True"),
        ({"num_channels": 2.0}, ValueError, r"`num_channels` to be a positive integer but got 2\.0"),
        ({"reduction": "average"}, ValueError, "`reduction` to be 'none', 'mean' or 'sum' but got 'average'"),
        ({"reduction": None}, ValueError, "`reduction` to be"),
        ({"sigma": 0.01}, ValueError, r"`sigma` in \[0\.05, inf\] but got 0\.01"),
        ({"sigma": -3.0}, ValueError, "`sigma` in"),
        ({"sigma": NAN}, ValueError, "`sigma` in"),
        ({"sigma": torch.ones(3)}, ValueError, r"`sigma` to be a number or of shape \(2,\) but got \(3,\)"),
        ({"sigma": torch.ones(2, 1)}, ValueError, r"`sigma` to be a number or of shape \(2,\) but got \(2, 1\)"),
        ({"sigma": INF}, ValueError, "finite `sigma` with `learn_sigma=True` but got inf, where its gradient is 0"),
        ({"sigma": torch.tensor([1.0, INF])}, ValueError, "finite `sigma` with `learn_sigma=True`"),
        ({"d": "automatic"}, TypeError, "`d` to be a number, a tensor of numbers or 'auto' but got 'automatic'"),
        ({"d": 0.0}, ValueError, r"`d` to be positive and finite but got 0\.0"),
        ({"d": INF}, ValueError, "`d` to be positive and finite"),
        ({"d": NAN}, ValueError, "`d` to be positive and finite"),
        ({"d": torch.ones(3)}, ValueError, r"`d` to be a number or of shape \(2,\) but got \(3,\)"),
        ({"bound": 0.0}, ValueError, "`bound` to be positive and finite"),
        ({"bound": INF}, ValueError, "`bound` to be positive and finite"),
        ({"bound": 1.0, "d": 1.0}, ValueError, "`bound` to exceed `d`"),
        ({"d_min": 0.0}, ValueError, "`d_min` to be positive and finite"),
        ({"d_min": 1.0, "d": 1.0}, ValueError, "`d_min` below `d`"),
        ({"normalize": False}, ValueError, "without the normaliser the loss is smallest at sigma -> 0 or d -> inf"),
        ({"normalize": False, "learn_d": False}, ValueError, "without the normaliser"),
        ({"normalize": False, "learn_sigma": False}, ValueError, "without the normaliser"),
    ],
)
def test_bad_arguments_are_refused_with_a_reason(options, error, message):
    with pytest.raises(error, match=message):
        MKCLoss(**{"num_channels": 2, **options})


@pytest.mark.parametrize("shapes", [((4, 2), (4, 1)), ((4, 2), (2,)), ((4, 2), (1, 2)), ((2, 4, 2), (4, 2))])
def test_shapes_that_torch_would_broadcast_are_refused(shapes):
    x, y = (torch.zeros(s) for s in shapes)
    for first, second in ((x, y), (y, x)):
        with pytest.raises(ValueError, match="`input` and `target` of the same shape"):
            MKCLoss(2)(first, second)


@pytest.mark.parametrize("shape", [(4, 3), (2, 4), (2, 2, 1)])
def test_a_wrong_number_of_channels_is_refused(shape):
    with pytest.raises(ValueError, match="2 channels in dimension -1"):
        MKCLoss(2)(torch.zeros(shape), torch.zeros(shape))


def test_a_missing_channel_dimension_is_refused():
    for channel_dim in (1, -2):
        with pytest.raises(ValueError, match="for the channels"):
            MKCLoss(2, channel_dim=channel_dim)(torch.zeros(2), torch.zeros(2))
    with pytest.raises(ValueError, match="for the channels"):
        MKCLoss(1)(torch.zeros(()), torch.zeros(()))


@pytest.mark.parametrize("dtype", [torch.int64, torch.bool, torch.complex64])
def test_integers_and_complex_numbers_are_refused(dtype):
    x = torch.zeros(4, 2)
    with pytest.raises(TypeError, match=r"`target`.*floating-point"):
        MKCLoss(2)(x, x.to(dtype))
    with pytest.raises(TypeError, match=r"`input`.*floating-point"):
        MKCLoss(2)(x.to(dtype), x)


@each_reduction
def test_an_empty_batch_is_refused(reduction):
    with pytest.raises(ValueError, match="at least one element"):
        MKCLoss(2, reduction=reduction)(torch.zeros(0, 2), torch.zeros(0, 2))


@pytest.mark.parametrize("shape", [(2,), (3, 2), (4, 1, 1), (3,), ()])
def test_weights_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"`weight` of shape \(4, 2\),.*or \(4,\)"):
        MKCLoss(2)(torch.zeros(4, 2), torch.zeros(4, 2), torch.ones(shape))


@pytest.mark.parametrize("shape", [(2, 1, 4, 5), (1, 1, 4, 5), (2, 3, 1, 1), (2, 4, 5)])
def test_weights_of_images_broadcast_to_all_their_elements(shape):
    loss = make_loss(channel_dim=1)
    x, y = data(2, 3, 4, 5)
    weight = torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    whole = (weight.unsqueeze(1) if weight.dim() == 3 else weight).expand(2, 3, 4, 5)
    torch.testing.assert_close(loss(x, y, weight), loss(x, y, whole))


def test_ambiguous_channel_dimension_is_refused():
    x = torch.zeros(2, 3, 4, 5)
    with pytest.raises(ValueError, match=r"3 channels in dimension -1.*got \(2, 3, 4, 5\);.*`channel_dim=1`"):
        MKCLoss(3)(x, x)
    square = torch.zeros(2, 3, 4, 3)
    with pytest.raises(ValueError, match=r"`channel_dim`.*shape \(2, 3, 4, 3\).*size 3"):
        MKCLoss(3)(square, square)
    for named in (1, -1):
        assert math.isfinite(MKCLoss(3, channel_dim=named)(square, square + 1.0).item())


@pytest.mark.parametrize("dtype", [torch.int64, torch.int32])
def test_integer_weights_equal_repetition(dtype):
    loss = make_loss()
    x, y = data(3, 3)
    repeated = torch.tensor([0, 1, 1, 2])
    count = torch.tensor([1, 2, 1])
    torch.testing.assert_close(loss(x, y, count.to(dtype)), loss(x[repeated], y[repeated]))


@pytest.mark.parametrize(
    ("options", "learned"),
    [({}, "['sigma', 'd']"), ({"learn_d": False}, "['sigma']"), ({"learn_sigma": False}, "['d']"), (FIXED, "[]")],
)
def test_repr_names_the_learned_parameters(options, learned):
    text = repr(MKCLoss(3, d=2.0, channel_dim=1, reduction="sum", **options))
    normalize = options != FIXED
    assert text == (
        f"MKCLoss(3, sigma=3, d=2, bound=200, objective='likelihood', learns={learned}, normalize={normalize}, "
        "channel_dim=1, reduction='sum')"
    )


def test_repr_shows_the_numbers_of_each_channel_and_marks_auto_values():
    assert "sigma=[0.7, 3, 20], d=[0.5, 1, 2], bound=[9, 40, 1000]" in repr(make_loss())
    assert "d=auto: 1, bound=auto: 10, objective='robust'" in repr(MKCLoss(2))
    assert "d=auto: 1, bound=50, objective='likelihood'" in repr(MKCLoss(2, bound=50.0, objective="likelihood"))
    assert "d=[1, 2, 3, 4, 5, 6, …]" in repr(MKCLoss(9, d=torch.arange(1.0, 10.0)))


# --- transforms of whole modules


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
def test_compiled_loss_equals_eager_over_two_batch_sizes():
    loss = make_loss(sigma=[0.7, 3.0, 100.0])
    compiled = torch.compile(loss, fullgraph=True, dynamic=True)
    for count in (5, 8):
        x, y = data(count, 3)
        x.requires_grad_()
        leaves = [x, loss.raw_kappa, loss.raw_d]
        torch.testing.assert_close(compiled(x, y), loss(x, y), rtol=1e-10, atol=1e-12)
        found = torch.autograd.grad(compiled(x, y), leaves)
        torch.testing.assert_close(found, gradients(loss(x, y), *leaves), rtol=1e-9, atol=1e-12)


def test_an_ensemble_of_losses_under_vmap_equals_a_loop():
    losses = [make_loss(sigma=s, d=d) for s, d in ((0.5, 0.4), (2.0, 1.0), (9.0, 3.0))]
    parameters, buffers = stack_module_state(losses)
    x, y = data(3, 6, 3)

    def value(parameters, buffers, x, y):
        return functional_call(losses[0], (parameters, buffers), (x, y))

    alone = torch.stack([loss(a, b) for loss, a, b in zip(losses, x, y, strict=True)])
    torch.testing.assert_close(vmap(value)(parameters, buffers, x, y), alone)
    slopes = vmap(grad(value))(parameters, buffers, x, y)
    for i, loss in enumerate(losses):
        by_kappa, by_d = gradients(loss(x[i], y[i]), loss.raw_kappa, loss.raw_d)
        torch.testing.assert_close(slopes["raw_kappa"][i], by_kappa)
        torch.testing.assert_close(slopes["raw_d"][i], by_d)


def test_per_sample_gradients_under_vmap_with_masks():
    loss = make_loss(reduction="sum")
    x, y = data(6, 3)
    mask = torch.tensor([True, False, True, True, False, True])
    y[1] = NAN
    slopes = vmap(grad(lambda x, y, m: loss(x, y, m)))(x, y, mask)
    leaf = x.clone().requires_grad_()
    torch.testing.assert_close(slopes, gradients(loss(leaf, y, mask), leaf)[0])


def test_half_keeps_the_parameters_and_bounds_in_float32():
    loss = MKCLoss(1, d=1000.0).half()
    assert {t.dtype for t in loss.state_dict().values()} == {torch.float32}
    assert math.isfinite(loss(torch.ones(3, 1).half(), torch.zeros(3, 1).half()).item())


def test_a_bandwidth_at_the_end_of_its_range_has_a_gradient():
    loss = MKCLoss(1, sigma=0.05)
    assert float(torch.autograd.grad(loss.kappa.sum(), loss.raw_kappa)[0]) > 1e-4


@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_a_target_that_is_not_finite_is_refused_with_a_remedy(reduction, value):
    loss = MKCLoss(2, reduction=reduction)
    target = torch.zeros(3, 2)
    target[1, 0] = value
    with pytest.raises(ValueError, match=r"`target`.*finite.*got 1.*\(1, 0\).*isfinite\(target\)"):
        loss(torch.zeros(3, 2), target)
    masked = loss(torch.zeros(3, 2), target, weight=torch.isfinite(target))
    assert bool(torch.isfinite(masked).all())


def test_targets_whose_sum_overflows_are_accepted():
    loss = MKCLoss(1, bound=3e38, d=1e37)
    assert math.isfinite(loss(torch.zeros(4, 1), torch.full((4, 1), 2e38)).item())


def test_per_sample_gradients_work_with_the_check_of_targets():
    loss, target = MKCLoss(1), torch.arange(4.0).unsqueeze(-1)
    parameters = dict(loss.named_parameters())

    def loss_of_sample(p, x, y):
        return torch.func.functional_call(loss, p, (x, y))

    slopes = torch.func.vmap(torch.func.grad(loss_of_sample), in_dims=(None, 0, 0))(
        parameters, torch.zeros(4, 1), target
    )
    assert slopes["raw_d"].shape == (4, 1)


def test_d_learns_the_scale_of_the_noise():
    loss = MKCLoss(1)
    target = torch.randn(256, 1, generator=torch.Generator().manual_seed(0))
    optimiser = torch.optim.Adam(loss.parameters(), lr=0.1)
    for _ in range(200):
        optimiser.zero_grad()
        loss(torch.zeros(256, 1), target).backward()
        optimiser.step()
    assert 0.7 < float(loss.d.detach()) < 1.3


# --- checks of values


@each_reduction
@pytest.mark.parametrize("bad", [-1.0, NAN, INF])
@pytest.mark.parametrize("shape", [(4, 2), (4,)], ids=["element", "sample"])
def test_weights_that_are_negative_or_not_finite_are_refused(reduction, bad, shape):
    loss, x = MKCLoss(2, reduction=reduction), torch.zeros(4, 2)
    weight = torch.ones(shape)
    weight[1] = bad
    with pytest.raises(ValueError, match=rf"`weight`.*>= 0 and finite.*got {bad:g} at index \(1"):
        loss(x, x, weight)


def test_weights_that_are_not_tensors_or_complex_are_refused():
    loss, x = MKCLoss(2), torch.zeros(4, 2)
    for weight in ([1.0] * 4, np.ones(4), 1.0):
        with pytest.raises(TypeError, match=r"`weight`.*weights.*mask"):
            loss(x, x, weight)
    with pytest.raises(TypeError, match=r"`weight`.*real"):
        loss(x, x, torch.ones(4) + 0j)


@each_reduction
@pytest.mark.parametrize("bad", [NAN, INF, -INF])
@pytest.mark.parametrize("learned", [True, False])
def test_an_unmasked_prediction_that_is_not_finite_is_refused(reduction, bad, learned):
    loss = MKCLoss(2, reduction=reduction, **({} if learned else FIXED))
    x, y = torch.zeros(3, 2), torch.zeros(3, 2)
    x[1, 0] = bad
    message = r"`input` to be finite but got 1 values that are not, the first at index \(1, 0\)\. The network has"
    with pytest.raises(ValueError, match=message):
        loss(x, y)
    with pytest.raises(ValueError, match=message), torch.no_grad():
        loss(x, y, torch.ones(3))
    assert bool(loss(x, y, x.isfinite()).isfinite().all())


def test_infinite_prediction_and_target_do_not_cancel():
    x = torch.full((2, 1), INF)
    with pytest.raises(ValueError, match=r"`target`.*finite.*got 2"):
        MKCLoss(1)(x, x)


def test_values_are_not_checked_under_vmap():
    loss, x = make_loss(reduction="sum"), data(4, 3)[0]
    bad = x.clone()
    bad[1] = NAN
    found = vmap(loss)(bad, x)
    assert found.isnan().tolist() == [False, True, False, False]
    assert vmap(loss, in_dims=(None, 0))(bad[1], x).isnan().all()
    weight = torch.tensor([1.0, -1.0, 2.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(vmap(loss)(x, x, weight.unsqueeze(-1).expand(4, 3)), weight * loss(x, x) / 4)


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
def test_values_are_not_checked_in_a_compiled_loss():
    loss = make_loss(reduction="none", **FIXED)
    compiled = torch.compile(loss, fullgraph=True)
    x, y = data(5, 3)
    weight = torch.tensor([1.0, 0.5, 0.0, 2.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(compiled(x, y, weight), loss(x, y, weight))
    bad = x.clone()
    bad[1, 2] = NAN
    assert compiled(bad, y, weight).isnan().nonzero().tolist() == [[1, 2]]


@pytest.mark.parametrize("name", ["input", "target"])
@pytest.mark.parametrize("value", [np.zeros((4, 2)), [[0.0, 0.0]] * 4, None, 3.0])
def test_data_that_are_not_tensors_are_refused_by_name(name, value):
    arguments = {"input": torch.zeros(4, 2), "target": torch.zeros(4, 2), name: value}
    with pytest.raises(TypeError, match=rf"`{name}`.*floating-point.*got {type(value).__name__}; "):
        MKCLoss(2)(**arguments)


def test_a_missing_channel_dimension_is_refused_with_a_remedy():
    flat, column = torch.zeros(1000), torch.zeros(1000, 1)
    with pytest.raises(ValueError, match=r"1 channel in.*got \(1000,\);.*unsqueeze\(-1\)"):
        MKCLoss(1)(flat, flat)
    with pytest.raises(ValueError, match=r"\(1000, 1\) and \(1000,\); unsqueeze\(-1\) the target"):
        MKCLoss(1)(column, flat)
    with pytest.raises(ValueError, match=r"\(1000,\) and \(1000, 1\); unsqueeze\(-1\) the input"):
        MKCLoss(1)(flat, column)


@pytest.mark.parametrize("name", ["sigma", "d", "bound", "d_min"])
def test_parameters_that_are_not_numbers_are_refused_by_name(name):
    for value in ("a", [[1.0], [1.0, 2.0]], 1j):
        with pytest.raises(TypeError, match=rf"`{name}`.*number"):
            MKCLoss(2, **{name: value})
    loss = MKCLoss(2, d=1.0)
    if name in ("sigma", "d"):
        with pytest.raises(TypeError, match=rf"`{name}`.*number.*got 'a'"):
            setattr(loss, name, "a")


@pytest.mark.parametrize("value", ["last", 1.0, True])
def test_a_channel_dim_that_is_not_an_integer_is_refused(value):
    with pytest.raises(ValueError, match=r"`channel_dim`.*whole number"):
        MKCLoss(2, channel_dim=value)


class Criterion(nn.Module):
    """A loss as the last step of a graph."""

    def __init__(self, loss):
        super().__init__()
        self.loss = loss

    def forward(self, x, y):
        return self.loss(x, y)


@pytest.mark.skipif(
    tuple(map(int, torch.__version__.split(".")[:2])) < (2, 7),
    reason="torch 2.6 loses the size of the batch in an autograd function",
)
@pytest.mark.parametrize("options", [{"d": 1.0}, {"d": 1.0, **FIXED}, {}], ids=["learned", "fixed", "default"])
def test_an_exported_loss_takes_batches_of_any_size(options):
    module = Criterion(MKCLoss(2, **options))
    x, y = data(8, 2, dtype=torch.float32)
    module(x, y)
    module.eval()
    size = torch.export.Dim("samples", min=2)
    program = torch.export.export(module, (x, y), dynamic_shapes={"x": {0: size}, "y": {0: size}})
    x, y = data(5, 2, dtype=torch.float32)
    torch.testing.assert_close(program.module()(x, y), module(x, y))

"""The training objective: the likelihood, or a robust term plus the likelihood of detached residuals."""

import copy
import math

import pytest
import torch
from torch import nn
from torch.autograd import gradcheck, gradgradcheck
from torch.func import functional_call

from mkc_torch import MKCLoss
from mkc_torch.functional import mkc_energy, mkc_nll
from mkc_torch.losses._initial_loss import initial_influence, initial_loss
from mkc_torch.losses.bandwidth_schedule import BandwidthSchedule
from mkc_torch.losses.residual_scale import ResidualScale

ROBUST = {"default": {}, "given d": {"d": 1.5, "objective": "robust"}}
LIKELIHOOD = {"auto d": {"objective": "likelihood"}, "given d": {"d": 1.5}}
NOT_LEARNED = {"learn_sigma": False, "learn_d": False}
each_robust = pytest.mark.parametrize("options", ROBUST.values(), ids=ROBUST)
each_reduction = pytest.mark.parametrize("reduction", ["none", "mean", "sum"])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def data(*shape, seed=0, dtype=torch.float64):
    """Predictions and targets with a tenth of them wrong."""
    x, y = torch.randn(2, *shape, generator=generator(seed), dtype=torch.float64).to(dtype)
    y.view(-1)[::10] += 20.0
    return x, y


def annealing_loss(m=2, share=0.4, **options):
    """A loss with a history, halfway through its schedule, in float64."""
    loss = MKCLoss(m, sigma=2.0, **options).double()
    for seed in range(3):
        loss(*data(40, m, seed=seed))
    if loss.schedule is not None:
        loss.schedule.share.fill_(share)
        loss.schedule.log_bandwidth.fill_(math.log(1.4))
    return loss


def leaf(x):
    return x.clone().requires_grad_()


# --- choice of the objective


def test_the_objective_is_robust_if_d_is_auto():
    assert MKCLoss(1).objective == "robust"
    assert MKCLoss(1, **NOT_LEARNED).objective == "robust"
    assert MKCLoss(1, d=1.0).objective == "likelihood"
    assert MKCLoss(1, d=1.0, objective="robust").objective == "robust"
    assert MKCLoss(1, objective="likelihood").objective == "likelihood"
    assert MKCLoss(1, objective="likelihood").residual_scale is not None
    assert MKCLoss(1, objective="likelihood").schedule is None
    with pytest.raises(ValueError, match=r"`objective`.*'robust', 'likelihood' or None.*got 'median'"):
        MKCLoss(1, objective="median")


@each_reduction
@pytest.mark.parametrize("options", [*ROBUST.values(), *LIKELIHOOD.values()])
def test_in_evaluation_the_value_is_the_likelihood_of_sigma_d_and_bound(reduction, options):
    loss = annealing_loss(reduction=reduction, **options).eval()
    x, y = data(30, 2, seed=7)
    expected = mkc_nll(x - y, loss.sigma, loss.d, loss.bound)
    expected = {"none": expected, "mean": expected.mean(), "sum": expected.sum()}[reduction]
    found = loss(leaf(x), y)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
    wanted = list(loss.parameters())
    torch.testing.assert_close(
        torch.autograd.grad(found.sum(), wanted), torch.autograd.grad(expected.sum(), wanted), rtol=1e-8, atol=1e-9
    )


# --- the two terms


@each_reduction
@each_robust
@pytest.mark.parametrize("weighted", [False, True])
def test_in_training_the_value_is_the_sum_of_the_terms_and_so_are_its_gradients(reduction, options, weighted):
    loss = annealing_loss(reduction=reduction, **options)
    x, y = (leaf(entry) for entry in data(30, 2, seed=7))
    weight = torch.rand(30, 2, generator=generator(), dtype=torch.float64) if weighted else None
    value = loss(x, y, weight)
    network, density = loss.terms(x, y, weight)
    torch.testing.assert_close(value, network + density, rtol=1e-10, atol=1e-12)
    wanted = [x, y, *loss.parameters()]
    found = torch.autograd.grad(value.sum(), wanted)
    expected = [*torch.autograd.grad(network.sum(), wanted[:2]), *torch.autograd.grad(density.sum(), wanted[2:])]
    torch.testing.assert_close(list(found), expected, rtol=1e-9, atol=1e-11)


@each_robust
def test_the_network_term_has_no_gradient_by_parameters_and_the_density_term_none_by_predictions(options):
    loss, (x, y) = annealing_loss(**options), (leaf(value) for value in data(30, 2, seed=7))
    network, density = loss.terms(x, y)
    assert torch.autograd.grad(network, list(loss.parameters()), allow_unused=True, retain_graph=True) == (None, None)
    assert torch.autograd.grad(density, (x, y), allow_unused=True, retain_graph=True) == (None, None)
    assert all(bool((value != 0).any()) for value in torch.autograd.grad(network, (x, y)))
    assert all(bool((value != 0).any()) for value in torch.autograd.grad(density, list(loss.parameters())))


@each_robust
@each_reduction
def test_each_term_has_its_own_gradient_at_a_frozen_state(options, reduction):
    loss, (x, y) = annealing_loss(reduction=reduction, **options), data(4, 2, seed=7)

    def network(x, y):
        return loss.terms(x, y).network

    class Density(nn.Module):
        def __init__(self):
            super().__init__()
            self.loss = loss

        def forward(self):
            return self.loss.terms(x, y).density

    def density(raw_kappa, raw_d):
        return functional_call(Density(), {"loss.raw_kappa": raw_kappa, "loss.raw_d": raw_d}, ())

    before = copy.deepcopy(loss.state_dict())
    raw = [leaf(loss.raw_kappa.detach()), leaf(loss.raw_d.detach())]
    assert gradcheck(network, (leaf(x), leaf(y)))
    assert gradgradcheck(network, (leaf(x), leaf(y)))
    assert gradcheck(density, raw)
    assert gradgradcheck(density, raw)
    torch.testing.assert_close(loss.state_dict(), before, rtol=0.0, atol=0.0)


def test_the_network_term_is_the_energy_of_the_schedule_in_scales():
    loss, (x, y) = annealing_loss(), data(30, 2, seed=7)
    z = (x - y) / loss.residual_scale.scale
    torch.testing.assert_close(loss.terms(x, y).network, loss.schedule.energy(z).mean(), rtol=1e-12, atol=0.0)
    welsch = mkc_energy(z, loss.schedule.bandwidth, 1.0)
    torch.testing.assert_close(loss.schedule.energy(z), 0.4 * welsch + 0.6 * initial_loss(torch, z))


def test_the_density_term_is_the_likelihood():
    loss, (x, y) = annealing_loss(), data(30, 2, seed=7)
    expected = mkc_nll(x - y, loss.sigma, loss.d, loss.bound).mean()
    torch.testing.assert_close(loss.terms(x, y).density, expected, rtol=1e-10, atol=0.0)


def test_with_a_given_d_the_annealed_bandwidth_is_no_wider_than_the_selected():
    loss, (x, y) = annealing_loss(share=1.0, **ROBUST["given d"]), data(30, 2, seed=7)
    with torch.no_grad():
        loss.d = torch.tensor([2.0, 0.4])
    selected = loss.schedule.bandwidth * loss.residual_scale.scale / loss.d
    assert bool(selected[0] < loss.sigma[0])
    assert bool(selected[1] > loss.sigma[1])
    sigma = torch.minimum(loss.sigma, selected).detach()
    expected = mkc_energy(x - y, sigma, loss.d.detach()).mean()
    torch.testing.assert_close(loss.terms(x, y).network, expected, rtol=1e-10, atol=0.0)
    loss.schedule.log_bandwidth.fill_(math.log(40.0))
    unlimited = mkc_energy(x - y, loss.sigma.detach(), loss.d.detach()).mean()
    torch.testing.assert_close(loss.terms(x, y).network, unlimited, rtol=1e-10, atol=0.0)


def test_a_bandwidth_near_the_widest_does_not_limit_a_gaussian():
    loss, (x, y) = MKCLoss(2, sigma=math.inf, d=1.5, objective="robust", **NOT_LEARNED).double(), data(30, 2, seed=7)
    loss(x, y)
    loss.schedule.share.fill_(1.0)
    loss.schedule.log_bandwidth.fill_(math.log(33.0))
    torch.testing.assert_close(loss.terms(x, y).network, 0.5 * ((x - y) / 1.5).square().mean(), rtol=1e-12, atol=0.0)
    loss.schedule.log_bandwidth.fill_(math.log(31.0))
    limited = mkc_energy(x - y, 31.0 * loss.residual_scale.scale / 1.5, 1.5).mean()
    torch.testing.assert_close(loss.terms(x, y).network, limited, rtol=1e-10, atol=0.0)


@pytest.mark.parametrize("options", LIKELIHOOD.values(), ids=LIKELIHOOD)
def test_under_the_likelihood_the_network_term_is_0_and_the_density_term_has_all_gradients(options):
    loss, (x, y) = annealing_loss(**options), (leaf(value) for value in data(30, 2, seed=7))
    network, density = loss.terms(x, y)
    assert network.item() == 0.0
    wanted = [x, y, *loss.parameters()]
    found = torch.autograd.grad(density, wanted)
    expected = torch.autograd.grad(loss.eval()(x, y), wanted)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("options", LIKELIHOOD.values(), ids=LIKELIHOOD)
@each_reduction
@pytest.mark.parametrize("weighted", [False, True])
def test_the_likelihood_is_differentiated_as_a_whole(options, reduction, weighted):
    loss = annealing_loss(reduction=reduction, **options).eval()
    x, y = data(4, 2, seed=7)
    weight = [leaf(torch.rand(4, 2, generator=generator(), dtype=torch.float64) + 0.1)] if weighted else []

    def value(x, y, raw_kappa, raw_d, *weight):
        return functional_call(loss, {"raw_kappa": raw_kappa, "raw_d": raw_d}, (x, y, *weight))

    given = [leaf(entry.detach()) for entry in (x, y, loss.raw_kappa, loss.raw_d)]
    assert gradcheck(value, (*given, *weight))
    assert gradgradcheck(value, (*given, *weight))


@pytest.mark.parametrize("options", LIKELIHOOD.values(), ids=LIKELIHOOD)
def test_under_the_likelihood_value_and_gradients_are_the_same_in_training_and_evaluation(options):
    loss = annealing_loss(**options)
    found = []
    for mode in (True, False):
        x, y = (leaf(entry) for entry in data(30, 2, seed=7))
        value = loss.train(mode)(x, y)  # evaluation sees the state after the batch
        found.append([value.detach(), *torch.autograd.grad(value, [x, y, *loss.parameters()])])
    torch.testing.assert_close(*found, rtol=0.0, atol=0.0)


# --- gradients of the terms


@pytest.mark.parametrize("options", [{}, {"d": 1.5, "objective": "robust"}, {"objective": "likelihood"}, {"d": 1.5}])
def test_the_network_gradient_does_not_depend_on_which_parameters_are_learned(options):
    """At errors of half a scale and of twenty scales."""
    error = torch.randn(200, 1, generator=generator(), dtype=torch.float64)
    error[0], error[1] = 0.5, 20.0
    gradients = []
    for learned in ((True, True), (False, True), (True, False), (False, False)):
        loss = MKCLoss(1, learn_sigma=learned[0], learn_d=learned[1], **options).double()
        for _ in range(2):
            x = leaf(error)
            loss(x, torch.zeros_like(x)).backward()
        gradients.append(x.grad[:2])
    for gradient in gradients[1:]:
        torch.testing.assert_close(gradient, gradients[0], rtol=1e-5, atol=1e-12)  # sigma and d are stored in float32


def test_the_gradient_of_the_initial_loss_is_its_influence():
    error = torch.randn(200, 1, generator=generator(), dtype=torch.float64)
    loss, x = MKCLoss(1, reduction="sum").double(), leaf(error)
    loss(x, torch.zeros_like(x)).backward()
    scale = loss.residual_scale.scale
    torch.testing.assert_close(x.grad, initial_influence(torch, error / scale)[0] / scale, rtol=1e-12, atol=1e-14)


@each_robust
@pytest.mark.parametrize("reduction", ["none", "sum"])
def test_gradients_of_elements_and_sums_equal_the_mean_times_the_weight(reduction, options):
    x, y = data(40, 2)
    weight = torch.rand(40, 2, generator=generator(1), dtype=torch.float64)
    slopes = []
    for kind in (reduction, "mean"):
        inputs = leaf(x)
        value = annealing_loss(reduction=kind, **options)(inputs, y, weight)
        slopes.append(torch.autograd.grad(value.sum() * (1.0 if kind != "mean" else weight.sum()), inputs)[0])
    torch.testing.assert_close(*slopes, rtol=1e-10, atol=1e-12)


@each_reduction
@each_robust
def test_the_gradient_by_the_target_is_the_negative_gradient_by_the_prediction(reduction, options):
    loss, (x, y) = annealing_loss(reduction=reduction, **options), (leaf(value) for value in data(40, 2))
    by_input, by_target = torch.autograd.grad(loss(x, y).sum(), (x, y))
    torch.testing.assert_close(by_input, -by_target, rtol=0.0, atol=0.0)


@each_robust
def test_the_gradient_by_a_weight_is_the_value_of_its_element(options):
    x, y = data(40, 2)
    weight = torch.ones(40, 2, dtype=torch.float64)
    loss, leaf_weight = annealing_loss(reduction="sum", **options), leaf(weight)
    (slope,) = torch.autograd.grad(loss(x, y, leaf_weight), leaf_weight)
    each = annealing_loss(reduction="none", **options)
    torch.testing.assert_close(slope, each(x, y, weight).detach(), rtol=1e-10, atol=1e-12)
    mean, leaf_weight = annealing_loss(**options), leaf(weight)
    value = mean(x, y, leaf_weight)
    (slope,) = torch.autograd.grad(value, leaf_weight)
    expected = annealing_loss(reduction="none", **options)(x, y, weight).detach()
    torch.testing.assert_close(slope, (expected - value.detach()) / 80.0, rtol=1e-8, atol=1e-12)


@each_robust
@pytest.mark.parametrize("options_too", [{}, NOT_LEARNED], ids=["learned", "fixed"])
def test_repeated_backward_passes_are_bitwise_equal_and_scale_with_the_upstream_gradient(options, options_too):
    loss, (x, y) = annealing_loss(**options, **options_too), (leaf(entry) for entry in data(40, 2))
    wanted = [x, y, *loss.parameters()]
    value = loss(x, y)
    loss(*data(40, 2, seed=9))  # another batch in between changes the running state, not this graph
    first = torch.autograd.grad(value, wanted, retain_graph=True)
    second = torch.autograd.grad(value, wanted, retain_graph=True)
    torch.testing.assert_close(first, second, rtol=0.0, atol=0.0)
    scaled = torch.autograd.grad(65536.0 * value, wanted, retain_graph=True)
    torch.testing.assert_close(scaled, tuple(65536.0 * entry for entry in first), rtol=0.0, atol=0.0)
    differentiable = torch.autograd.grad(value, wanted, create_graph=True)
    torch.testing.assert_close(differentiable, first, rtol=1e-8, atol=1e-12)
    by_terms = [*torch.autograd.grad(loss_at(loss, value, x, y)[0], wanted[:2])]
    torch.testing.assert_close(list(first[:2]), by_terms, rtol=1e-9, atol=1e-12)


def loss_at(loss, value, x, y):
    """The terms at the state that gave ``value``, from a loss rebuilt before its last batch."""
    before = annealing_loss(
        **({} if loss._follows else ROBUST["given d"]), **({} if loss.raw_d is not None else NOT_LEARNED)
    )
    found = before(x, y)
    torch.testing.assert_close(found, value, rtol=0.0, atol=0.0)
    return before.terms(x, y)


def test_hessians_by_forward_over_reverse_and_reverse_over_reverse():
    y = data(6, 1)[1]
    loss = annealing_loss(1, d=1.5)

    def value(raw):
        parameters = {"raw_kappa": raw[1:2], "raw_d": raw[2:3]}
        return functional_call(loss, parameters, (raw[0].expand(6, 1), y))

    at = torch.tensor([0.2, -3.0, -2.0], dtype=torch.float64)
    forward = torch.func.jacfwd(torch.func.grad(value))(at)
    torch.testing.assert_close(forward, torch.autograd.functional.hessian(value, at))
    torch.testing.assert_close(forward, forward.mT)


# --- the likelihood after freezing


def test_freezing_the_scale_keeps_the_numbers_and_ends_the_robust_objective():
    for options in ({}, NOT_LEARNED, *ROBUST.values(), LIKELIHOOD["auto d"]):
        loss, (x, y) = annealing_loss(**options), data(30, 2, seed=7)
        value, numbers = loss.eval()(x, y), [getattr(loss, name).detach() for name in ("sigma", "d", "bound", "d_min")]
        loss.train().freeze_scale()
        assert loss.objective == "likelihood"
        assert loss.residual_scale is None
        assert loss.schedule is None
        for name, number in zip(("sigma", "d", "bound", "d_min"), numbers, strict=True):
            torch.testing.assert_close(getattr(loss, name).detach(), number, rtol=1e-6, atol=0.0)
        torch.testing.assert_close(loss(x, y), value, rtol=1e-6, atol=0.0)
        before = copy.deepcopy(loss.state_dict())
        loss(x, 100.0 * y)
        torch.testing.assert_close(loss.state_dict(), before, rtol=0.0, atol=0.0)
        loss.d = 2.0
        torch.testing.assert_close(loss.d.detach(), torch.full((2,), 2.0, dtype=torch.float64))


def test_d_cannot_be_set_while_it_follows_the_residuals():
    with pytest.raises(ValueError, match=r"`d`.*got d=.*takes d from the residuals.*freeze_"):
        MKCLoss(1).d = 2.0


def test_a_loss_frozen_at_its_floor_can_still_learn():
    loss = MKCLoss(1, d_min=1e-3)
    noise = torch.randn(50, 1, generator=generator())
    for size in [1.0, *[1e-9] * 50]:
        loss((size * noise).requires_grad_(), torch.zeros(50, 1))
    torch.testing.assert_close(loss.d, loss.d_min)
    loss.freeze_scale()
    torch.testing.assert_close(loss.d, loss.d_min)
    slopes = torch.autograd.grad(loss(1e-9 * noise, torch.zeros(50, 1)), list(loss.parameters()))
    assert all(bool(torch.isfinite(value).all()) for value in (*slopes, *loss.parameters()))


def minimise_by_lbfgs(loss, steps):
    """Slope and loss values of a line fitted by L-BFGS with a line search to points with wrong targets."""
    g = generator(3)
    x = torch.randn(200, 1, generator=g, dtype=torch.float64)
    y = 2.0 * x + 0.1 * torch.randn(200, 1, generator=g, dtype=torch.float64)
    y[:30] += 10.0
    model = nn.Linear(1, 1).double()
    nn.init.zeros_(model.weight)
    nn.init.zeros_(model.bias)
    groups = [*model.parameters(), *loss.parameters()]
    if loss.objective == "robust":
        first = torch.optim.Adam(groups, lr=0.05)
        for _ in range(100):
            first.zero_grad()
            loss(model(x), y).backward()
            first.step()
        loss.freeze_scale()
    optimiser = torch.optim.LBFGS(
        groups, line_search_fn="strong_wolfe", max_iter=steps, tolerance_grad=1e-9, tolerance_change=1e-15
    )
    values = []

    def closure():
        optimiser.zero_grad()
        value = loss(model(x), y)
        value.backward()
        values.append(value.item())
        return value

    optimiser.step(closure)
    slopes = torch.cat([entry.grad.flatten() for entry in groups])
    return model, slopes, values


def test_with_a_frozen_scale_a_line_search_converges():
    model, slopes, values = minimise_by_lbfgs(MKCLoss(1).double(), 200)
    assert slopes.abs().max() < 1e-6
    assert float(model.weight.detach()) == pytest.approx(2.0, abs=0.03)
    assert float(model.bias.detach()) == pytest.approx(0.0, abs=0.03)
    assert min(values) == pytest.approx(values[-1], abs=1e-9)
    assert values[-1] < values[0]


@pytest.mark.parametrize(("options", "names"), [({}, True), (ROBUST["given d"], True), (LIKELIHOOD["given d"], False)])
def test_a_prediction_that_is_not_finite_is_refused_with_a_remedy_for_line_searches(options, names):
    loss, x = MKCLoss(1, **options), torch.tensor([[math.nan], [0.0]])
    with pytest.raises(ValueError, match=r"`input`.*finite.*got 1") as refused:
        loss(x, torch.zeros(2, 1))
    assert ("such as L-BFGS, needs loss.freeze_scale() first" in str(refused.value)) == names
    if names:
        loss.freeze_scale()
        with pytest.raises(ValueError, match=r"`input`.*finite.*got 1") as refused:
            loss(x, torch.zeros(2, 1))
        assert "freeze_scale" not in str(refused.value)


# --- a guide: a schedule of a trainer


def test_guide_gives_a_loss_with_given_d_the_robust_objective_in_training():
    x, y = data(60, 1)
    plain, loss = MKCLoss(1, d=1.0).double(), MKCLoss(1, d=1.0).double()
    scale, schedule = ResidualScale(1).double(), BandwidthSchedule(1).double()
    keys = set(loss.state_dict())
    loss.guide(scale, schedule)

    def value_and_gradient(loss):
        inputs = leaf(x)
        value = loss(inputs, y)
        return value.detach(), torch.autograd.grad(value, inputs)[0]

    value, gradient = value_and_gradient(loss)
    own = MKCLoss(1, d=1.0, objective="robust").double()
    torch.testing.assert_close((value, gradient), value_and_gradient(own), rtol=0.0, atol=0.0)
    torch.testing.assert_close(scale.state_dict(), own.residual_scale.state_dict(), rtol=0.0, atol=0.0)
    torch.testing.assert_close(schedule.state_dict(), own.schedule.state_dict(), rtol=0.0, atol=0.0)
    assert not torch.allclose(gradient, value_and_gradient(plain)[1], rtol=0.1)
    assert set(loss.state_dict()) == keys
    torch.testing.assert_close(value_and_gradient(loss.eval()), value_and_gradient(plain.eval()))
    assert schedule.steps.tolist() == [1]
    loss.train().guide(None, None)
    torch.testing.assert_close(value_and_gradient(loss), value_and_gradient(plain.train()), rtol=0.0, atol=0.0)
    assert schedule.steps.tolist() == [1]

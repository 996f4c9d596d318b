"""A loss that is used again starts like a new loss after a reset; what a training should be warned of, it is, once."""

import copy
import pickle
import warnings

import pytest
import torch
from torch import nn

from mkc_torch import MKCLoss, outliers
from mkc_torch.losses._training_watch import WATCHED_STEPS

OPTIONS = {
    "default": {},
    "given bound and floor": {"bound": 50.0, "d_min": 1e-4},
    "given d": {"sigma": [2.0, 4.0], "d": [0.5, 2.0], "bound": 30.0},
    "given d, robust": {"d": 0.5, "objective": "robust"},
    "fixed": {"learn_sigma": False, "learn_d": False, "normalize": True},
}
each_option = pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)


def table(seed=0, count=256):
    """Inputs, targets of which a third are wrong, and the truth."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(count, 4, generator=g)
    truth = torch.tanh(x[:, :2] + x[:, 2:])
    y = truth + 0.05 * torch.randn(count, 2, generator=g)
    y[::3] += 4.0
    return x, y, truth


def fit(loss, seed=0, steps=30, batch=64, optimised=True):
    """A network that is trained from its own start; its parameters."""
    torch.manual_seed(seed)
    net = nn.Sequential(nn.Linear(4, 16), nn.Tanh(), nn.Linear(16, 2))
    x, y, _ = table()
    groups = [{"params": net.parameters()}, *(loss.param_groups() if optimised else [])]
    optimizer = torch.optim.Adam(groups, lr=1e-2)
    for _ in range(steps):
        rows = torch.randint(len(x), (batch,))
        optimizer.zero_grad()
        loss(net(x[rows]), y[rows]).backward()
        optimizer.step()
    return dict(net.named_parameters())


def assert_same(left, right):
    assert list(left) == list(right)
    torch.testing.assert_close(dict(left), dict(right), rtol=0.0, atol=0.0)


# --- reset


@each_option
def test_a_reset_loss_trains_the_next_network_as_a_new_loss_does(options):
    used, new = MKCLoss(2, **options), MKCLoss(2, **options)
    fit(used, seed=1, steps=130)
    used.reset_parameters()
    assert_same(used.state_dict(), new.state_dict())
    assert_same(fit(used), fit(new))
    assert_same(used.state_dict(), new.state_dict())


@each_option
def test_a_reset_keeps_the_parameters_that_an_optimizer_has(options):
    loss = MKCLoss(2, **options).double()
    before = [id(parameter) for parameter in loss.parameters()]
    fit(loss, steps=3, batch=16)
    loss.freeze_scale()
    loss.reset_parameters()
    assert [id(parameter) for parameter in loss.parameters()] == before
    assert {value.dtype for value in loss.state_dict().values()} <= {torch.float64, torch.int64}


@each_option
def test_a_frozen_loss_is_reset_to_its_construction(options):
    loss = MKCLoss(2, **options)
    fit(loss)
    loss.freeze_scale()
    loss.reset_parameters()
    assert repr(loss) == repr(MKCLoss(2, **options))
    assert_same(loss.state_dict(), MKCLoss(2, **options).state_dict())


@each_option
def test_a_loss_that_loaded_or_was_copied_is_reset_to_its_construction(options):
    loss, trained = MKCLoss(2, **options), MKCLoss(2, **options)
    fit(trained)
    loss.load_state_dict(trained.state_dict())
    for other in (loss, copy.deepcopy(trained), pickle.loads(pickle.dumps(trained))):
        other.reset_parameters()
        assert_same(other.state_dict(), MKCLoss(2, **options).state_dict())


def test_values_that_were_assigned_are_reset_to_those_of_the_constructor():
    loss = MKCLoss(2, sigma=3.0, d=1.0)
    loss.sigma, loss.d = 5.0, [0.5, 0.25]
    loss.reset_parameters()
    torch.testing.assert_close(loss.sigma, torch.full((2,), 3.0))
    torch.testing.assert_close(loss.d, torch.ones(2))


# --- a loss of another fit


@pytest.mark.parametrize("batch", [16, 64, 256])
def test_a_loss_that_is_used_again_without_a_reset_warns_once(batch):
    loss = MKCLoss(2)
    fit(loss, steps=400, batch=batch)
    with pytest.warns(UserWarning, match=r"call loss.reset_parameters\(\) before it") as caught:
        fit(loss, seed=1, steps=60, batch=batch)
    assert len(caught) == 1
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit(loss, seed=2, steps=60, batch=batch)
    loss.reset_parameters()
    fit(loss, steps=400, batch=batch)
    with pytest.warns(UserWarning, match="reset_parameters"):
        fit(loss, seed=1, steps=60, batch=batch)


@pytest.mark.parametrize("batch", [1, 8, 64, 256])
def test_a_single_fit_does_not_warn(batch):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(2):
            fit(MKCLoss(2), seed, steps=300, batch=batch)


def test_a_reset_loss_does_not_warn():
    loss = MKCLoss(2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(3):
            loss.reset_parameters()
            fit(loss, seed, steps=200)


# --- parameters that no optimizer has


@pytest.mark.parametrize("options", [{}, {"d": 1.0}, {"learn_d": False}, {"learn_sigma": False}])
def test_parameters_that_the_optimizer_lacks_are_reported_once(options):
    loss, other = MKCLoss(2, **options), MKCLoss(2, **options)
    names = " and ".join(n for n, p in (("sigma", loss.raw_kappa), ("d", loss.raw_d)) if p is not None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit(other, steps=WATCHED_STEPS, optimised=False)
    with pytest.warns(UserWarning, match=rf"In 100 training steps {names} of the loss got gradients") as caught:
        fit(loss, steps=2 * WATCHED_STEPS + 20, optimised=False)
    assert len(caught) == 1
    assert caught[0].filename == __file__


def test_a_trainer_that_clears_the_gradients_of_the_whole_module_is_warned():
    module = nn.ModuleDict({"net": nn.Linear(4, 2), "loss": MKCLoss(2)})
    optimizer, (x, y, _) = torch.optim.SGD(module["net"].parameters(), lr=1e-3), table()

    def train():
        for _ in range(WATCHED_STEPS + 1):
            module["loss"](module["net"](x), y).backward()
            optimizer.step()
            module.zero_grad()

    with pytest.warns(UserWarning, match="the optimizer does not have them"):
        train()


def test_the_parameter_that_is_missing_is_named():
    loss, (_, y, _) = MKCLoss(2), table()
    optimizer = torch.optim.Adam([loss.raw_kappa], lr=1e-2)
    for _ in range(WATCHED_STEPS):
        loss(torch.zeros_like(y), y).backward()
        optimizer.step()
    with pytest.warns(UserWarning, match="In 100 training steps d of the loss"):
        loss(torch.zeros_like(y), y)


def test_passes_without_gradients_are_not_training_steps():
    loss, (_, y, _) = MKCLoss(2), table()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(WATCHED_STEPS + 2):
            loss(torch.zeros_like(y), y)
            with torch.no_grad():
                loss(torch.zeros_like(y), y)
        loss.requires_grad_(False)
        for _ in range(WATCHED_STEPS + 2):
            loss(torch.zeros_like(y).requires_grad_(), y).backward()
        loss.eval().requires_grad_(True)
        for _ in range(WATCHED_STEPS + 2):
            loss(torch.zeros_like(y), y).backward()


# --- a network that learns its targets to a small share of their spread


def residuals(size, count, seed):
    """Residuals of which a tenth, the first, are outliers of 30 times the size of the others."""
    errors = size * torch.randn(count, 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    errors[: count // 10] += 30.0 * size
    return errors, torch.zeros_like(errors)


def learned_to(share, **options):
    """A loss after a training whose residuals shrink to a share of their first size."""
    loss = MKCLoss(1, **options).double()
    optimizer = torch.optim.Adam(loss.param_groups() or [torch.zeros(1)], lr=1e-2)
    for step in range(250):
        optimizer.zero_grad()
        loss(*(value.requires_grad_() for value in residuals(1.0 if step < 3 else share, 200, step))).backward()
        optimizer.step()
    return loss


@pytest.mark.parametrize("ratio", [1e2, 1e3, 1e4, 1e5, 1e6, 1e7])
@pytest.mark.parametrize("options", [{}, {"learn_d": False}, {"learn_sigma": False, "learn_d": False}])
def test_outliers_are_found_whatever_the_ratio_of_spread_and_noise(ratio, options):
    loss = learned_to(1.0 / ratio, **options)
    suspects = outliers(loss, *residuals(1.0 / ratio, 4000, 999)).flatten()
    assert suspects[:400].all()
    assert not suspects[400:].any()
    assert loss.d.item() * ratio == pytest.approx(1.0, rel=0.2)
    assert loss.check() == ()


def test_check_advises_to_lower_a_floor_that_the_residuals_have_passed():
    loss = learned_to(1e-4, d_min=1e-3)
    (sentence,) = loss.check()
    assert "close to its floor 0.001" in sentence
    assert "lower `d_min`" in sentence
    assert "raise" not in sentence
    loss = learned_to(1e-4, d_min=1e-9)
    assert loss.check() == ()


def test_check_compares_errors_of_validation_data_with_those_of_the_training():
    loss = learned_to(1e-2)
    assert loss.check(*residuals(2e-2, 400, 5)) == ()
    (sentence,) = loss.check(*residuals(0.2, 400, 5))
    assert "times as large as those of the training" in sentence
    assert MKCLoss(1).check(*(value.float() for value in residuals(1e3, 400, 5))) == ()

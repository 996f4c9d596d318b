"""Networks trained with the default loss: targets of any unit, up to half of them wrong, and clean targets."""

import pytest
import torch
from torch import nn

from mkc_torch import MKCLoss

N = 600


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def sample_data(seed=0, noise=0.3):
    """Inputs, the truth, and targets with Gaussian noise."""
    g = generator(seed)
    x = torch.rand(N, 3, generator=g)
    truth = torch.sin(4.0 * x[:, :1]) + x[:, 1:2] * x[:, 2:]
    return x, truth, truth + noise * torch.randn(N, 1, generator=g)


def with_wrong_targets(target, share, kind, seed=1):
    g = generator(seed)
    count = int(share * N)
    rows = torch.randperm(N, generator=g)[:count]
    target = target.clone()
    if kind == "one-sided":
        target[rows] += 3.0 + 7.0 * torch.rand(count, 1, generator=g)
    elif kind == "factor 1000":
        target[rows] *= 1000.0
    else:
        target[rows] = 20.0 * torch.rand(count, 1, generator=g) - 10.0
    return target


class ScaledNetwork(nn.Module):
    """A network whose last step multiplies by the target's unit, as in a model of a physical quantity."""

    def __init__(self, scale=1.0, offset=0.0):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(3, 32), nn.SiLU(), nn.Linear(32, 1))
        self.scale, self.offset = scale, offset

    def forward(self, x):
        return self.layers(x) * self.scale + self.offset


def trained(loss, x, y, seed=0, steps=500, scale=1.0, offset=0.0):
    torch.manual_seed(seed)
    model = ScaledNetwork(scale, offset)
    groups = [{"params": list(model.parameters())}]
    groups += loss.param_groups(lr=1e-2) if isinstance(loss, MKCLoss) else []
    optimiser = torch.optim.Adam(groups, lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        optimiser.zero_grad()
        loss(model(x), y).backward()
        optimiser.step()
        schedule.step()
    return model


def rmse(model, x, truth):
    with torch.no_grad():
        return float((model(x) - truth).square().mean().sqrt())


@pytest.mark.e2e
@pytest.mark.parametrize(("scale", "offset"), [(1e-6, 0.0), (1e6, 0.0), (1e-3, 0.1), (200.0, 1000.0)])
def test_targets_of_any_unit_and_offset_are_learned_like_standardised_targets(scale, offset):
    x, truth, y = sample_data()
    y = with_wrong_targets(y, 0.2, "uniform")
    plain = rmse(trained(MKCLoss(1), x, y), x, truth)
    other = trained(MKCLoss(1), x, y * scale + offset, scale=scale, offset=offset)
    assert rmse(other, x, truth * scale + offset) / scale == pytest.approx(plain, rel=0.05)
    assert plain < 0.1


@pytest.mark.e2e
def test_a_plain_network_learns_unscaled_targets():
    x, truth, y = sample_data()
    truth, y = 1000.0 + 200.0 * truth, with_wrong_targets(1000.0 + 200.0 * y, 0.2, "factor 1000")
    torch.manual_seed(0)
    errors = []
    for loss in (MKCLoss(1), nn.MSELoss()):
        model = nn.Sequential(nn.Linear(3, 32), nn.SiLU(), nn.Linear(32, 1))
        own = loss.param_groups(lr=1e-2) if isinstance(loss, MKCLoss) else []
        optimiser = torch.optim.Adam([{"params": list(model.parameters())}, *own], lr=0.5)
        for _ in range(600):
            optimiser.zero_grad()
            loss(model(x), y).backward()
            optimiser.step()
        errors.append(rmse(model, x, truth) / 200.0)
    assert errors[0] < 0.25
    assert errors[1] > 10.0


@pytest.mark.e2e
def test_on_clean_targets_the_loss_is_as_good_as_least_squares():
    errors = []
    for seed in range(3):
        x, truth, y = sample_data(seed)
        errors.append([rmse(trained(loss, x, y, seed), x, truth) for loss in (MKCLoss(1), nn.MSELoss())])
    ours, squares = torch.tensor(errors).mean(0).tolist()
    assert ours < 1.02 * squares


@pytest.mark.e2e
@pytest.mark.parametrize("kind", ["one-sided", "factor 1000", "uniform"])
def test_the_truth_is_learned_with_half_of_the_targets_wrong(kind):
    x, truth, y = sample_data()
    error = rmse(trained(MKCLoss(1), x, with_wrong_targets(y, 0.5, kind)), x, truth)
    absolute = rmse(trained(nn.L1Loss(), x, with_wrong_targets(y, 0.5, kind)), x, truth)
    assert error < 0.15
    assert error < absolute


def test_the_truth_is_learned_with_a_given_d_and_half_of_the_targets_wrong():
    x, truth, y = sample_data()
    loss = MKCLoss(1, d=0.3, bound=40.0, objective="robust")
    assert rmse(trained(loss, x, with_wrong_targets(y, 0.5, "one-sided")), x, truth) < 0.15


@pytest.mark.e2e
def test_the_truth_is_learned_with_half_of_the_targets_permuted():
    errors = []
    for seed in (3, 4):
        x, truth, y = sample_data(seed)
        rows = torch.randperm(N, generator=generator(seed))[: N // 2]
        y[rows] = y[rows.roll(1)]
        losses = MKCLoss(1), nn.L1Loss(), nn.MSELoss()
        errors.append([rmse(trained(loss, x, y, seed), x, truth) for loss in losses])
    ours, absolute, squares = torch.tensor(errors).mean(0).tolist()
    assert ours < absolute
    assert ours < 0.9 * squares


@pytest.mark.e2e
def test_learned_sigma_and_d_describe_the_noise():
    x, _, y = sample_data(noise=0.3)
    clean, heavy = MKCLoss(1), MKCLoss(1)
    trained(clean, x, y)
    trained(heavy, x, with_wrong_targets(y, 0.3, "uniform"))
    assert clean.d.item() == pytest.approx(0.3, rel=0.15)
    assert heavy.d.item() == pytest.approx(0.3, rel=0.25)
    assert heavy.sigma.item() < clean.sigma.item()
    assert float(heavy.bound) == pytest.approx(10.0, rel=0.2)


@pytest.mark.e2e
def test_monitored_values_fall_after_the_schedule_as_the_network_improves():
    """The network term in training and the value in evaluation, which a scheduler or early stopping monitors."""
    x, truth, y = sample_data()
    y, loss = with_wrong_targets(y, 0.3, "one-sided"), MKCLoss(1)
    model = trained(loss, x, y, steps=400)
    assert float(loss.schedule.share) == 1.0
    start = copied(model)
    terms = []
    for network in (model, perturbed(start)):
        with torch.no_grad():
            terms.append((float(loss.train().terms(network(x), y).network), float(loss.eval()(network(x), y))))
    assert rmse(model, x, truth) < rmse(perturbed(start), x, truth)
    assert terms[0][0] < terms[1][0]
    assert terms[0][1] < terms[1][1]


def copied(model):
    twin = ScaledNetwork()
    twin.load_state_dict(model.state_dict())
    return twin


def perturbed(model):
    twin = copied(model)
    with torch.no_grad():
        twin.layers[-1].bias += 0.2
    return twin

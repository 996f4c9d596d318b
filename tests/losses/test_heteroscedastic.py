import math

import pytest
import torch
from torch import nn
from torch.autograd import gradcheck, gradgradcheck
from torch.func import grad, vmap

from mkc_torch import HeteroscedasticMKCLoss, MKCConvHead, MKCHead, MKCLoss
from mkc_torch.functional import mkc_nll
from mkc_torch.losses import heteroscedastic as module

INF, NAN = math.inf, math.nan
each_reduction = pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
SIGMA, D, BOUND = [0.7, 3.0, 20.0], [0.5, 1.0, 2.0], [9.0, 40.0, 1e3]


def uniform_values(*shape, low, high, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return (low + (high - low) * torch.rand(*shape, dtype=torch.float64, generator=generator)).to(dtype)


def data(*shape, dtype=torch.float64):
    """Input, target, sigma and d of the same shape."""
    ranges = ((-6, 6), (-6, 6), (0.3, 5), (0.2, 2))
    return [uniform_values(*shape, low=a, high=b, seed=i, dtype=dtype) for i, (a, b) in enumerate(ranges)]


def gradients(value, *leaves):
    return torch.autograd.grad(value.sum(), leaves, retain_graph=True)


def reduced(t, reduction):
    return {"none": t, "mean": t.mean(), "sum": t.sum()}[reduction]


# --- value and gradient


@each_reduction
@pytest.mark.parametrize(("shape", "channel_dim"), [((5, 3), -1), ((3, 5), 0), ((5, 3, 4), 1), ((3,), 0)])
@pytest.mark.parametrize("full", [False, True], ids=["broadcast", "full"])
def test_constant_sigma_and_d_equal_the_mkc_loss(shape, channel_dim, reduction, full):
    sigma, d, bound = (torch.tensor(v, dtype=torch.float64) for v in (SIGMA, D, BOUND))
    reference = MKCLoss(3, sigma=sigma, d=d, bound=bound, channel_dim=channel_dim, reduction=reduction)
    loss = HeteroscedasticMKCLoss(bound, channel_dim=channel_dim, reduction=reduction)
    x, y, *_ = data(*shape)
    x.requires_grad_()
    thin = [3 if i == channel_dim % len(shape) else 1 for i in range(len(shape))]
    wide = shape if full else thin
    s, e = (v.reshape(thin).expand(wide) for v in (reference.sigma, reference.d))
    weight = uniform_values(*shape, low=-0.5, high=1).clamp(min=0)
    for w in (None, weight, weight > 0.3, weight.select(channel_dim, 0)):
        found, expected = loss(x, y, s, e, w), reference(x, y, w)
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
        leaves = (x, *reference.parameters())
        torch.testing.assert_close(gradients(found, *leaves), gradients(expected, *leaves), rtol=1e-9, atol=1e-11)


@each_reduction
def test_each_element_has_its_own_density(reduction):
    x, y, sigma, d = data(6, 3)
    loss = HeteroscedasticMKCLoss(30.0, reduction=reduction)
    expected = reduced(mkc_nll(x - y, sigma, d, 30.0), reduction)
    torch.testing.assert_close(loss(x, y, sigma, d), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("sigma_shape", [(5, 3, 4), (5, 1, 4), (1, 3, 1), (1, 1, 1)])
@pytest.mark.parametrize("d_shape", [(5, 3, 4), (5, 1, 1), (1, 1, 1)])
def test_dimensions_of_size_one_are_shared(sigma_shape, d_shape):
    x, y, *_ = data(5, 3, 4)
    sigma, d = uniform_values(*sigma_shape, low=0.3, high=5), uniform_values(*d_shape, low=0.2, high=2)
    loss = HeteroscedasticMKCLoss(torch.tensor([9.0, 40.0, 90.0]), channel_dim=1)
    whole = loss(x, y, sigma.expand(5, 3, 4), d.expand(5, 3, 4))
    torch.testing.assert_close(loss(x, y, sigma, d), whole, rtol=1e-13, atol=0)


def test_infinite_sigma_equals_the_gaussian_nll_of_each_element():
    x, y, _, d = data(6, 3)
    loss = HeteroscedasticMKCLoss(1e3)
    d.requires_grad_()
    sigma = torch.full((1, 1), INF, dtype=torch.float64, requires_grad=True)
    found = loss(x, y, sigma, d)
    expected = nn.GaussianNLLLoss(full=True)(x, y, d**2)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(gradients(found, d), gradients(expected, d), rtol=1e-10, atol=1e-12)
    assert gradients(found, sigma)[0].item() == 0


def test_the_normaliser_in_chunks_equals_the_whole(monkeypatch):
    x, y, sigma, d = data(7, 3)
    loss = HeteroscedasticMKCLoss(30.0)
    sigma.requires_grad_()
    whole = loss(x, y, sigma, d)
    monkeypatch.setattr(module, "_CHUNK", 4)
    parts = loss(x, y, sigma, d)
    torch.testing.assert_close(parts, whole, rtol=1e-14, atol=0)
    torch.testing.assert_close(gradients(parts, sigma), gradients(whole, sigma), rtol=1e-14, atol=0)


# --- masks and extremes


@each_reduction
@pytest.mark.parametrize("poison", [NAN, INF, -1.0])
@pytest.mark.parametrize("where", [(0,), (1,), (2,), (3,), (0, 1, 2, 3)], ids=["input", "target", "sigma", "d", "all"])
@pytest.mark.parametrize("kind", ["mask", "zero weight"])
@pytest.mark.parametrize("bound", [30.0, 2.5])
def test_masked_elements_affect_neither_value_nor_gradient(reduction, poison, where, kind, bound):
    loss = HeteroscedasticMKCLoss(bound, reduction=reduction)
    mask = torch.ones(5, 3, dtype=torch.bool)
    mask[1, 2] = mask[4, 0] = False
    weight = mask if kind == "mask" else mask.double()

    def value_and_gradients(tensors):
        leaves = [t.clone().requires_grad_() for t in tensors]
        value = loss(*leaves, weight)
        return [value.detach(), *gradients(value, *leaves)]

    tensors = data(5, 3)
    expected = value_and_gradients(tensors)
    for i in where:
        tensors[i][~mask] = poison
    found = value_and_gradients(tensors)
    assert all(map(torch.equal, found, expected))
    assert all(t.isfinite().all() for t in found)
    assert all((t[~mask] == 0).all() for t in found[1:])


def test_sigma_and_d_of_a_fully_masked_sample_are_ignored():
    loss = HeteroscedasticMKCLoss(0.5)  # narrower than 1
    x, y, *_ = data(4, 3)
    sigma, d = torch.full((4, 1), 2.0, dtype=torch.float64), torch.full((4, 1), 0.2, dtype=torch.float64)
    mask = torch.tensor([True, True, False, True])
    expected = loss(x[mask], y[mask], sigma[mask], d[mask])
    sigma[2], d[2] = NAN, NAN
    sigma.requires_grad_()
    found = loss(x, y, sigma, d, mask)
    torch.testing.assert_close(found, expected)
    assert gradients(found, sigma)[0][2] == 0


@each_reduction
def test_all_weights_zero_give_zero_with_zero_gradients(reduction):
    loss = HeteroscedasticMKCLoss(30.0, reduction=reduction)
    leaves = [torch.full((4, 3), NAN, requires_grad=True) for _ in range(4)]
    value = loss(*leaves, torch.zeros(4))
    assert (value == 0).all()
    assert all((g == 0).all() for g in gradients(value, *leaves))


@pytest.mark.parametrize("size", [60.0, 1e10, 1e30])
@pytest.mark.parametrize("sigma", [0.05, 2.0, 1000.0])
def test_an_extreme_outlier_leaves_a_finite_loss_and_finite_gradients(size, sigma):
    x, s, d = (torch.full((4, 2), v, requires_grad=True) for v in (0.0, sigma, 0.1))
    y = torch.zeros(4, 2)
    y[1, 1] = size
    value = HeteroscedasticMKCLoss(50.0)(x, y, s, d)
    assert value.isfinite()
    assert all(g.isfinite().all() for g in gradients(value, x, s, d))


# --- dtypes and transforms


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32_and_autocast_changes_nothing(dtype):
    loss = HeteroscedasticMKCLoss(30.0)
    tensors = data(5, 3, dtype=dtype)
    value = loss(*tensors)
    assert value.dtype == torch.float32
    wide = [t.float() for t in tensors]
    assert torch.equal(value, loss(*wide))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(loss(*wide), value)
    assert loss.to(dtype).bound.dtype == torch.float32
    assert loss.double().bound.dtype == torch.float64


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's forward mode raises its own
def test_gradcheck_in_input_target_sigma_and_d():
    leaves = [t.requires_grad_() for t in data(3, 2)]
    weight = torch.tensor([[1.0, 0.5], [0.0, 2.0], [1.5, 0.2]], dtype=torch.float64)
    for loss in (HeteroscedasticMKCLoss(30.0), HeteroscedasticMKCLoss(torch.tensor([9.0, 40.0]), reduction="none")):
        assert gradcheck(lambda *t: loss(*t, weight), leaves, check_forward_ad=True)  # noqa: B023 - called in this round of the loop
        assert gradgradcheck(lambda *t: loss(*t, weight), leaves)  # noqa: B023 - called in this round of the loop


def test_vmap_of_the_loss_and_its_gradient_equals_a_loop():
    loss = HeteroscedasticMKCLoss(30.0)
    tensors = data(4, 6, 3)
    alone = torch.stack([loss(*(t[i] for t in tensors)) for i in range(4)])
    torch.testing.assert_close(vmap(loss)(*tensors), alone)
    slopes = torch.stack([grad(loss, 2)(*(t[i] for t in tensors)) for i in range(4)])
    torch.testing.assert_close(vmap(grad(loss, 2))(*tensors), slopes)


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
def test_traced_loss_equals_eager_over_two_batch_sizes():
    loss = HeteroscedasticMKCLoss(30.0)
    compiled = torch.compile(loss, fullgraph=True, dynamic=True, backend="aot_eager")
    for count in (5, 8):
        leaves = [t.requires_grad_() for t in data(count, 3)]
        weight = uniform_values(count, 3, low=-0.5, high=1).clamp(min=0)
        torch.testing.assert_close(compiled(*leaves, weight), loss(*leaves, weight), rtol=1e-10, atol=1e-12)
        found = torch.autograd.grad(compiled(*leaves, weight), leaves)
        torch.testing.assert_close(found, gradients(loss(*leaves, weight), *leaves), rtol=1e-9, atol=1e-12)


# --- the head


@pytest.mark.parametrize("shape", [(5,), (7, 5), (2, 3, 5)])
def test_sigma_and_d_start_as_given_whatever_the_features(shape):
    sigma, d = torch.tensor([0.06, 900.0]), torch.tensor([0.011, 40.0])
    head = MKCHead(5, 2, bound=50.0, d_min=0.01, sigma_init=sigma, d_init=d)
    features = 1e3 * torch.randn(*shape, generator=torch.Generator().manual_seed(0))
    location, found_sigma, found_d = head(features)
    assert location.shape == found_sigma.shape == found_d.shape == (*shape[:-1], 2)
    torch.testing.assert_close(found_sigma, sigma.expand_as(found_sigma), rtol=1e-4, atol=0)
    torch.testing.assert_close(found_d, d.expand_as(found_d), rtol=1e-4, atol=0)
    assert location.std() > 1


@pytest.mark.parametrize("raw", [-1e4, -100.0, -15.0, 0.0, 15.0, 100.0, 1e4])
def test_bounds_hold_with_finite_gradients_for_all_raw_values(raw):
    head, loss = MKCHead(3, 2, bound=50.0, d_min=1e-3), HeteroscedasticMKCLoss(50.0)
    with torch.no_grad():
        head.scales.bias.fill_(raw)
    location, sigma, d = head(torch.ones(4, 3))
    assert ((sigma >= 0.05 * (1 - 1e-6)) & (sigma <= 1000 * (1 + 1e-6))).all()
    assert ((d >= 1e-3) & (d <= 50 * (1 + 1e-6))).all()
    y = torch.tensor([[0.0, 1.0], [1e-3, 30.0], [1e4, 2.0], [0.0, 0.0]])
    value = loss(location, y, sigma, d)
    assert value.isfinite()
    assert all(g.isfinite().all() for g in gradients(value, *head.parameters()))


def test_head_under_autocast_and_in_bfloat16_gives_float32_scales():
    head, features = MKCHead(5, 2, bound=1e6, d_min=1e-3, d_init=0.5), torch.ones(3, 5)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        location, sigma, d = head(features)
    assert (location.dtype, sigma.dtype, d.dtype) == (torch.bfloat16, torch.float32, torch.float32)
    torch.testing.assert_close(d, torch.full((3, 2), 0.5), rtol=1e-4, atol=0)
    head = head.half()
    assert head.location.weight.dtype == head.scales.weight.dtype == torch.float16
    assert head.bound.tolist() == [1e6, 1e6]
    location, sigma, d = head(features.half())
    assert (location.dtype, d.dtype) == (torch.float16, torch.float32)
    torch.testing.assert_close(d, torch.full((3, 2), 0.5), rtol=0.02, atol=0)


def test_state_dict_carries_the_bounds():
    head = MKCHead(5, 2, bound=50.0, d_min=1e-3)
    other = MKCHead(5, 2, bound=20.0, d_min=1e-2, sigma_init=1.0)
    other.load_state_dict(head.state_dict())
    features = torch.ones(3, 5)
    assert all(map(torch.equal, other(features), head(features)))


def test_heteroscedastic_noise_is_distinguished_from_outliers():
    generator = torch.Generator().manual_seed(0)
    x = torch.linspace(0, 1, 400).unsqueeze(-1)
    d = 0.2 + 0.8 * x
    y = torch.sin(3 * x) + d * torch.randn(400, 1, generator=generator)
    anywhere = 100 * torch.rand(400, 1, generator=generator) - 50
    y = torch.where(torch.rand(400, 1, generator=generator) < 0.1, anywhere, y)
    torch.manual_seed(0)
    head = MKCHead(16, 1, bound=50.0, d_min=0.01)
    model, loss = nn.Sequential(nn.Linear(1, 16), nn.Tanh(), head), HeteroscedasticMKCLoss(50.0)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-2)
    for _ in range(400):
        optimiser.zero_grad()
        location, sigma, found = model(x)
        loss(location, y, sigma, found).backward()
        optimiser.step()
    ratio = (found / d).detach()
    assert ratio[:40].mean().item() == pytest.approx(1, abs=0.25)
    assert ratio[-40:].mean().item() == pytest.approx(1, abs=0.25)
    assert (location - torch.sin(3 * x)).abs().max() < 0.5


# --- bad arguments


@pytest.mark.parametrize("name", ["sigma", "d"])
@pytest.mark.parametrize("shape", [(3,), (), (4,), (4, 2), (2, 3), (1, 4, 3), (4, 3, 1)])
def test_sigma_and_d_of_any_other_shape_are_refused(name, shape):
    x = torch.zeros(4, 3)
    given = {"sigma": torch.ones(4, 3), "d": torch.ones(4, 3), name: torch.ones(shape)}
    with pytest.raises(ValueError, match=rf"`{name}` .*shape of `input`, \(4, 3\), or of size 1 in any dimension"):
        HeteroscedasticMKCLoss(30.0)(x, x, **given)


@pytest.mark.parametrize("name", ["sigma", "d", "input", "target"])
def test_integers_and_numbers_are_refused(name):
    given = {k: torch.ones(4, 3) for k in ("input", "target", "sigma", "d")}
    loss = HeteroscedasticMKCLoss(30.0)
    with pytest.raises(TypeError, match=rf"`{name}`.*floating-point.*got torch.int64"):
        loss(**{**given, name: torch.ones(4, 3, dtype=torch.int64)})
    with pytest.raises(TypeError, match=rf"`{name}`.*floating-point.*got float; make"):
        loss(**{**given, name: 1.0})


@pytest.mark.parametrize(
    ("sigma", "d", "message"),
    [
        (0.049, 1.0, r"`sigma` in \[0\.05, inf\] but got 0\.049 at index \(2, 1\)\. Map the network's output"),
        (-1.0, 1.0, r"`sigma` in \[0\.05, inf\] but got -1 at"),
        (NAN, 1.0, r"`sigma` in \[0\.05, inf\] but got nan at"),
        (1.0, 0.0, r"`d` in \(0, bound\] but got 0 at index \(2, 1\)\. Map the network's output"),
        (1.0, -1.0, r"`d` in \(0, bound\] but got -1 at"),
        (1.0, 30.1, r"`d` in \(0, bound\] but got 30\.1 at"),
        (1.0, NAN, r"`d` in \(0, bound\] but got nan at"),
        (1.0, INF, r"`d` in \(0, bound\] but got inf at"),
    ],
)
def test_sigma_and_d_out_of_range_are_refused_by_index_with_a_remedy(sigma, d, message):
    x, s, e = torch.zeros(4, 3), torch.ones(4, 3), torch.ones(4, 3)
    s[2, 1], e[2, 1] = sigma, d
    with pytest.raises(ValueError, match=message):
        HeteroscedasticMKCLoss(30.0)(x, x, s, e)


def test_arguments_that_mkc_loss_refuses_are_refused():
    loss, scale = HeteroscedasticMKCLoss(torch.tensor([9.0, 40.0])), torch.ones(1, 1)
    x, bad = torch.zeros(4, 2), torch.zeros(4, 2)
    bad[1, 0] = NAN
    for arguments, message in (
        ((x, torch.zeros(4, 1)), "`input` and `target` of the same shape"),
        ((torch.zeros(4, 3), torch.zeros(4, 3)), "Expected 2 channels, as `bound` has, in dimension -1"),
        ((x[:0], x[:0]), "at least one element"),
        ((torch.zeros(()), torch.zeros(())), "for the channels"),
        ((x, bad), r"`target` to be finite but got 1 values that are not, the first at index \(1, 0\)"),
        ((bad, x), r"`input` to be finite but got 1 values that are not, the first at index \(1, 0\)"),
    ):
        with pytest.raises(ValueError, match=message):
            loss(*arguments, scale, scale)
    with pytest.raises(ValueError, match="`weight` of shape"):
        loss(x, x, scale, scale, torch.ones(3))
    with pytest.raises(ValueError, match=r"`weight`.*>= 0 and finite.*got -1 at index"):
        loss(x, x, scale, scale, -torch.ones(4))
    assert bool(loss(bad, x, scale, scale, bad.isfinite()).isfinite())


@pytest.mark.parametrize("bound", [0.0, -1.0, INF, NAN, torch.ones(2, 2)])
def test_bad_bounds_and_reductions_are_refused(bound):
    with pytest.raises(ValueError, match="`bound` to be"):
        HeteroscedasticMKCLoss(bound)
    with pytest.raises(ValueError, match="`channel_dim` to be"):
        HeteroscedasticMKCLoss(1.0, channel_dim="last")
    with pytest.raises(TypeError, match=r"`bound`.*number"):
        HeteroscedasticMKCLoss("a")
    with pytest.raises(ValueError, match="`reduction` to be"):
        HeteroscedasticMKCLoss(1.0, reduction="average")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"in_features": 0}, "`in_features` to be a whole number of at least 1 but got 0"),
        ({"num_channels": True}, "`num_channels` to be a whole number of at least 1 but got True"),
        ({"bound": INF}, "`bound` to be positive and finite"),
        ({"bound": torch.ones(3)}, r"`bound` to be a number or of shape \(2,\) but got \(3,\)"),
        ({"d_min": 0.0}, "`d_min` to be positive and finite"),
        ({"d_min": 1.0}, "`d_init` between `d_min`"),
        ({"d_init": 50.0}, "`d_init` between `d_min`"),
        ({"sigma_init": 0.049}, r"`sigma_init` in \(0\.05, 1000\) but got 0\.049"),
        ({"sigma_init": 1e3 + 1}, r"`sigma_init` in \(0\.05, 1000\)"),
        ({"sigma_init": INF}, "`sigma_init` to be positive and finite"),
    ],
)
def test_bad_heads_are_refused_with_a_reason(options, message):
    with pytest.raises(ValueError, match=message):
        MKCHead(**{"in_features": 5, "num_channels": 2, "bound": 50.0, "d_min": 1e-3, **options})


def test_another_number_of_features_is_refused():
    with pytest.raises(ValueError, match=r"`features` of shape \(\*, 5\).*got \(4, 3\)"):
        MKCHead(5, 2, bound=50.0, d_min=1e-3)(torch.zeros(4, 3))
    with pytest.raises(TypeError, match=r"`features`.*floating-point.*got ndarray"):
        MKCHead(5, 2, bound=50.0, d_min=1e-3)(torch.zeros(4, 5).numpy())
    with pytest.raises(TypeError, match=r"`d_min`.*number"):
        MKCHead(5, 2, bound=50.0, d_min="small")


def test_a_head_of_images_equals_the_head_at_every_place():
    torch.manual_seed(0)
    head = MKCConvHead(5, 2, bound=50.0, d_min=1e-3)
    nn.init.normal_(head.scales.weight)
    plain = MKCHead(5, 2, bound=50.0, d_min=1e-3)
    plain.load_state_dict(head.state_dict())
    features = torch.randn(3, 5, 4, 6)
    for found, expected in zip(head(features), plain(features.movedim(1, -1)), strict=True):
        assert found.shape == (3, 2, 4, 6)
        torch.testing.assert_close(found, expected.movedim(-1, 1))
    kernel = nn.functional.conv2d(features, head.location.weight[:, :, None, None], head.location.bias)
    torch.testing.assert_close(head(features).location, kernel)
    target = torch.randn(3, 2, 4, 6)
    HeteroscedasticMKCLoss(50.0, channel_dim=1)(head(features).location, target, *head(features)[1:]).backward()
    assert head.scales.weight.grad.abs().sum() > 0
    with pytest.raises(ValueError, match=r"`features` of shape \(N, 5, \.\.\.\).*got \(3, 4, 5\)"):
        head(torch.zeros(3, 4, 5))

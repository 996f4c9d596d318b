import copy
import importlib.util
import math
import pickle
import sys
from pathlib import Path

import pytest
import torch
from torch import nn

import mkc_torch
from mkc_torch import MKCLoss
from mkc_torch.functional import mkc_nll

pytest.importorskip("torchmetrics")

from torchmetrics import MetricCollection

from mkc_torch.metrics import MKCNegativeLogLikelihood

NAN = math.nan


def make_loss(**options):
    settings = {"sigma": [0.7, 3.0], "d": [0.5, 1.0], "bound": [9.0, 40.0]}
    return MKCLoss(2, **{k: torch.tensor(v, dtype=torch.float64) for k, v in settings.items()}, **options)


def data(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [3 * torch.randn(*shape, dtype=torch.float64, generator=generator) for _ in range(2)]


def nll(loss, x, y):
    return mkc_nll(x - y, loss.sigma, loss.d, loss.bound).detach()


@pytest.mark.parametrize("options", [{}, {"learn_sigma": False, "learn_d": False, "reduction": "sum"}])
def test_metric_is_the_mean_nll_over_elements_and_per_channel(options):
    loss = make_loss(**options)
    x, y = data(50, 2)
    whole, channels = MKCNegativeLogLikelihood(loss), MKCNegativeLogLikelihood(loss, per_channel=True)
    whole.update(x, y)
    channels.update(x, y)
    torch.testing.assert_close(whole.compute(), nll(loss, x, y).mean(), rtol=1e-13, atol=0)
    torch.testing.assert_close(channels.compute(), nll(loss, x, y).mean(0), rtol=1e-13, atol=0)


def test_metric_equals_the_learned_loss_in_float32():
    loss = MKCLoss(2, sigma=1.5, d=0.5, bound=30.0)
    x, y = (t.float().requires_grad_() for t in data(20, 2))
    metric = MKCNegativeLogLikelihood(loss)
    metric.update(x, y)
    assert metric.compute().dtype == torch.float64
    assert not metric.compute().requires_grad
    assert metric.compute().item() == pytest.approx(loss(x, y).item(), rel=1e-6)


@pytest.mark.parametrize("cut", [1, 13, 25])
def test_the_mean_does_not_depend_on_the_batches(cut):
    loss, (x, y) = make_loss(), data(50, 2)
    weight = torch.rand(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    whole, parts = MKCNegativeLogLikelihood(loss, per_channel=True), MKCNegativeLogLikelihood(loss, per_channel=True)
    whole.update(x, y, weight)
    for x_part, y_part, w_part in zip(*(t.split(cut) for t in (x, y, weight)), strict=True):
        parts.update(x_part, y_part, w_part)
    torch.testing.assert_close(parts.compute(), whole.compute(), rtol=1e-13, atol=0)
    expected = (weight * nll(loss, x, y)).sum(0) / weight.sum(0)
    torch.testing.assert_close(whole.compute(), expected, rtol=1e-13, atol=0)


def test_summed_states_of_ranks_equal_the_whole():
    loss, (x, y) = make_loss(), data(50, 2)
    whole, *ranks = (MKCNegativeLogLikelihood(loss) for _ in range(3))
    whole.update(x, y)
    ranks[0].update(x[:20], y[:20])
    ranks[1].update(x[20:], y[20:])
    assert all(reduction.__name__ == "dim_zero_sum" for reduction in whole._reductions.values())
    joined = MKCNegativeLogLikelihood(loss)
    for name in joined.metric_state:
        states = torch.stack([rank.metric_state[name] for rank in ranks])
        setattr(joined, name, joined._reductions[name](states))
    joined._update_count = 2
    torch.testing.assert_close(joined.compute(), whole.compute(), rtol=1e-14, atol=0)
    ranks[0].merge_state(ranks[1])
    torch.testing.assert_close(ranks[0].compute(), whole.compute(), rtol=1e-14, atol=0)


def test_forward_returns_the_batch_value_and_adds_it_and_reset_clears():
    loss, (x, y) = make_loss(), data(50, 2)
    metric = MKCNegativeLogLikelihood(loss)
    first = metric(x[:10], y[:10])
    second = metric(x[10:], y[10:])
    torch.testing.assert_close(first, nll(loss, x[:10], y[:10]).mean(), rtol=1e-13, atol=0)
    torch.testing.assert_close(second, nll(loss, x[10:], y[10:]).mean(), rtol=1e-13, atol=0)
    torch.testing.assert_close(metric.compute(), nll(loss, x, y).mean(), rtol=1e-13, atol=0)
    metric.reset()
    metric.update(x[:3], y[:3])
    torch.testing.assert_close(metric.compute(), nll(loss, x[:3], y[:3]).mean(), rtol=1e-13, atol=0)


def test_masked_elements_are_ignored_even_if_nan():
    loss, (x, y) = make_loss(channel_dim=1), data(6, 2, 4)
    mask = torch.ones(6, 4, dtype=torch.bool)
    mask[2, 3] = mask[5, 0] = False
    metric = MKCNegativeLogLikelihood(loss)
    expected = nll(loss, x.movedim(1, -1)[mask], y.movedim(1, -1)[mask]).mean()
    y[2, :, 3], x[5, :, 0] = NAN, NAN
    metric.update(x, y, mask)
    torch.testing.assert_close(metric.compute(), expected, rtol=1e-13, atol=0)
    with pytest.raises(ValueError, match=r"`target`.*finite.*got 2"):
        metric.update(x, y)


def test_without_counted_elements_the_metric_is_nan():
    metric = MKCNegativeLogLikelihood(make_loss(), per_channel=True)
    weight = torch.tensor([[1.0, 0.0]] * 4)
    metric.update(*data(4, 2), weight)
    assert metric.compute().isnan().tolist() == [False, True]


def test_sigma_and_d_are_read_at_each_update():
    loss, (x, y) = make_loss(), data(8, 2)
    metric = MKCNegativeLogLikelihood(loss)
    metric.update(x, y)
    before = nll(loss, x, y).mean()
    loss.sigma, loss.d = 5.0, 2.0
    metric.update(x, y)
    torch.testing.assert_close(metric.compute(), 0.5 * (before + nll(loss, x, y).mean()))


def test_millions_of_small_batches_lose_no_digits():
    loss = MKCLoss(1, sigma=2.0, d=1.0, bound=50.0)
    metric = MKCNegativeLogLikelihood(loss)
    metric.total, metric.weight = torch.tensor([1e9], dtype=torch.float64), torch.tensor([1e9], dtype=torch.float64)
    metric.update(torch.zeros(1, 1), torch.zeros(1, 1))
    assert metric.weight.item() == 1e9 + 1
    assert metric.half().total.dtype == torch.float64


def test_the_metric_has_no_parameters_and_its_clones_refer_to_the_loss():
    loss, (x, y) = make_loss(), data(8, 2)
    metric = MKCNegativeLogLikelihood(loss)
    assert list(metric.parameters()) == []
    assert dict(metric.state_dict()) == {}
    for twin in (metric.clone(), copy.deepcopy(metric), MetricCollection({"nll": metric}).clone("val_")["nll"]):
        assert twin.loss is loss
        loss.d = 0.8
        twin.update(x, y)
        torch.testing.assert_close(twin.compute(), nll(loss, x, y).mean())


def test_a_metric_copied_with_its_loss_refers_to_the_copy():
    module = nn.Module()
    module.criterion = make_loss()
    module.nll = MKCNegativeLogLikelihood(module.criterion)
    for twin in (copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        assert twin.nll.loss is twin.criterion
        assert twin.criterion is not module.criterion
        assert set(dict(twin.named_parameters())) == {"criterion.raw_kappa", "criterion.raw_d"}


def test_another_loss_and_bad_batches_are_refused():
    with pytest.raises(TypeError, match=r"`loss`.*MKCLoss.*got MSELoss"):
        MKCNegativeLogLikelihood(nn.MSELoss())
    metric = MKCNegativeLogLikelihood(make_loss())
    with pytest.raises(ValueError, match="`input` and `target` of the same shape"):
        metric.update(torch.zeros(4, 2), torch.zeros(4, 1))
    with pytest.raises(TypeError, match=r"`target`.*floating-point"):
        metric.update(torch.zeros(4, 2), torch.zeros(4, 2, dtype=torch.int64))
    x = torch.zeros(4, 2)
    with pytest.raises(ValueError, match=r"`input`.*finite.*got 8"):
        metric.update(x * NAN, x)
    with pytest.raises(ValueError, match=r"`weight`.*>= 0 and finite"):
        metric.update(x, x, -torch.ones(4))
    assert float(metric.weight.sum()) == 0.0


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
def test_a_compiled_loss_is_accepted():
    loss = make_loss()
    assert MKCNegativeLogLikelihood(torch.compile(loss)).loss is loss


def test_without_torchmetrics_the_error_names_the_package_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchmetrics", None)
    path = Path(mkc_torch.__file__).parent / "metrics.py"
    spec = importlib.util.spec_from_file_location("without_torchmetrics", path)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'mkc-torch\[lightning\]'"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))

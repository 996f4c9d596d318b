import ast
import copy
import importlib.util
import math
import pickle
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import multiprocessing, nn
from torch.utils.data import DataLoader, IterableDataset, TensorDataset

import mkc_torch
from mkc_torch import MKCDistribution, MKCLoss, fit_density
from mkc_torch.linear import MKCRegression

pytest.importorskip("lightning")

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.utilities import CombinedLoader

from mkc_torch.lightning._owned import SIGMA_CAP
from mkc_torch.lightning.callback import MKCExpectationMaximization

# advice such as more workers for the loader
pytestmark = [
    pytest.mark.filterwarnings("ignore::lightning.fabric.utilities.warnings.PossibleUserWarning"),
    pytest.mark.filterwarnings(r"ignore:.*LeafSpec.* is deprecated"),
]

INF, NAN = math.inf, math.nan
FIXED = {"learn_sigma": False, "learn_d": False, "normalize": True}
LEARNED = {"learn_sigma": True, "learn_d": True}
each_kind = pytest.mark.parametrize("kind", [FIXED, LEARNED], ids=["fixed", "learned"])


def residual_draws(*shape, sigma=2.5, d=0.5, bound=100.0, seed=0):
    """Residuals of a heavy-tailed density."""
    torch.manual_seed(seed)
    return MKCDistribution(torch.tensor(sigma), torch.tensor(d), bound).sample(shape)


class Replay(LightningModule):
    """Every training step calls the loss with the residuals of the batch: (error,) or (error, weight)."""

    def __init__(self, num_channels=2, growth=1.0, **options):
        super().__init__()
        self.criterion = MKCLoss(num_channels, **{"sigma": 3.0, "d": 1.0, "bound": 100.0, **FIXED, **options})
        self.shift = nn.Parameter(torch.zeros(()))
        self.growth = growth

    def training_step(self, batch):
        error, *weight = batch
        return self.criterion(
            error * self.growth**self.current_epoch + 0 * self.shift, torch.zeros_like(error), *weight
        )

    def validation_step(self, batch):
        self.log("val_loss", self.criterion(7 * batch[0], torch.zeros_like(batch[0])))

    test_step = validation_step

    def configure_optimizers(self):
        return torch.optim.SGD([self.shift], lr=0.0)


class Regression(LightningModule):
    """A network of one linear layer."""

    def __init__(self, inputs=3, outputs=1, lr=0.05, **options):
        super().__init__()
        torch.manual_seed(1)
        self.net = nn.Linear(inputs, outputs)
        self.lr = lr
        self.criterion = MKCLoss(outputs, **{"sigma": 3.0, "d": 1.0, "bound": 150.0, **FIXED, **options})

    def training_step(self, batch):
        x, y = batch
        return self.criterion(self.net(x), y)

    def validation_step(self, batch):
        self.log("val_loss", self.criterion(self.net(batch[0]), batch[1]))

    def configure_optimizers(self):
        optimiser = torch.optim.Adam(self.net.parameters(), lr=self.lr)
        return [optimiser], [torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.95)]


class ParameterHistory(Callback):
    """Records the parameters after each training batch and each epoch."""

    def __init__(self):
        self.batches, self.epochs = [], []

    @staticmethod
    def values(trainer, module):
        loss = module.criterion
        return trainer.global_step, loss.sigma.detach().clone(), loss.d.detach().clone()

    def on_train_batch_end(self, trainer, pl_module, *_):
        self.batches.append(self.values(trainer, pl_module))

    def on_train_epoch_end(self, trainer, pl_module):
        self.epochs.append(self.values(trainer, pl_module))

    def steps_of_change(self, start=1.0):
        before = torch.full_like(self.batches[0][2], start)
        steps = []
        for step, _, d in self.batches:
            if not torch.equal(d, before):
                steps.append(step)
            before = d
        return steps


def loader(*tensors, batch_size=100, **options):
    return DataLoader(TensorDataset(*tensors), batch_size=batch_size, **options)


def trainer_of(*callbacks, max_epochs=1, **options):
    quiet = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False, "devices": 1}
    if not any(isinstance(c, ModelCheckpoint) for c in callbacks):
        quiet["enable_checkpointing"] = False
    return Trainer(accelerator="cpu", max_epochs=max_epochs, callbacks=list(callbacks), **quiet | options)


def trained(module, data, *callbacks, val=None, **options):
    """The module after training with the callback first, and the trainer."""
    callbacks = callbacks or (MKCExpectationMaximization(),)
    trainer = trainer_of(*callbacks, **options)
    trainer.fit(module, data, val)
    return module, trainer


def assert_fitted(loss, error, weight=None, rtol=5e-4):
    """Assert that σ and d have the maximum likelihood for these residuals."""
    fit = fit_density(error.double(), weight=weight, bound=loss.bound.double(), d_min=loss.d_min.double())
    torch.testing.assert_close(loss.d.detach().double(), fit.d, rtol=rtol, atol=0)
    torch.testing.assert_close(loss.sigma.detach().double().pow(-2), fit.sigma.pow(-2), rtol=rtol, atol=5e-5)


def warnings_of(record):
    """Warnings of the callback among all warnings."""
    return [str(w.message) for w in record if "of the loss `criterion`" in str(w.message)]


# --- fitted values


@each_kind
def test_each_epoch_ends_with_the_maximum_likelihood_density_of_its_residuals(kind):
    error = residual_draws(1000, 2)
    module, _ = trained(Replay(**kind), loader(error), max_epochs=2)
    assert_fitted(module.criterion, error)


@pytest.mark.e2e
def test_a_linear_model_agrees_with_mkc_regression():
    torch.manual_seed(0)
    x, truth = torch.randn(1000, 3), torch.tensor([1.0, -2.0, 0.5])
    y = (x @ truth + residual_draws(1000)).unsqueeze(-1)
    module, trainer = trained(Regression(), loader(x, y, batch_size=200), max_epochs=50)
    design = torch.cat([x, torch.ones(1000, 1)], -1)
    fit = MKCRegression(bound=150.0).fit(design.double(), y.squeeze(-1).double())
    coef = torch.cat([module.net.weight.detach().flatten(), module.net.bias.detach()]).double()
    torch.testing.assert_close(coef, fit.coef_, rtol=0, atol=5e-3)
    torch.testing.assert_close(module.criterion.d.double(), fit.d_.flatten(), rtol=2e-3, atol=0)
    torch.testing.assert_close(module.criterion.sigma.double(), fit.sigma_.flatten(), rtol=2e-3, atol=0)
    assert module.criterion.d.item() == pytest.approx(0.5, rel=0.1)
    assert module.criterion.sigma.item() == pytest.approx(2.5, rel=0.1)
    found = trainer.callback_metrics["criterion/log_likelihood_0"].item()
    assert found == pytest.approx(fit.log_likelihood_.item() / 1000, abs=1e-3)


def test_alternation_raises_the_likelihood():
    class Likelihood(Callback):
        def __init__(self):
            self.values = []

        def on_train_epoch_end(self, trainer, *_):
            self.values.append(trainer.callback_metrics["criterion/log_likelihood_0"].item())

    x = torch.randn(600, 3, generator=torch.Generator().manual_seed(0))
    y = x.sum(-1, keepdim=True) + residual_draws(600, 1)
    likelihood = Likelihood()
    trained(Regression(lr=0.02), loader(x, y), MKCExpectationMaximization(graduated=False), likelihood, max_epochs=12)
    rise = torch.tensor(likelihood.values).diff()
    assert len(rise) == 11
    assert (rise > -1e-3).all()
    assert rise.sum() > 0.3


def quantiles(count):
    """Quantiles of a Gaussian as residuals."""
    return torch.erfinv(2 * (torch.arange(count) + 0.5) / count - 1) * 2**0.5


def test_a_clean_channel_becomes_gaussian_and_a_contaminated_channel_does_not():
    error = torch.stack([0.3 * quantiles(2000), residual_draws(2000)], -1)
    fixed, _ = trained(Replay(**FIXED), loader(error))
    learned, _ = trained(Replay(**LEARNED), loader(error))
    assert fixed.criterion.sigma[0] == INF
    assert fixed.criterion.sigma[1].item() == pytest.approx(2.5, rel=0.1)
    torch.testing.assert_close(learned.criterion.d, fixed.criterion.d, rtol=1e-4, atol=0)


def test_infinite_sigma_is_exact_for_a_fixed_loss_and_capped_for_a_learned_one_and_in_the_log():
    error = quantiles(2000).unsqueeze(-1)
    fixed, trainer = trained(Replay(1, **FIXED), loader(error))
    assert fixed.criterion.sigma.item() == INF
    assert trainer.callback_metrics["criterion/sigma_0"].item() == SIGMA_CAP
    learned, _ = trained(Replay(1, **LEARNED), loader(error))
    assert learned.criterion.sigma.item() == pytest.approx(SIGMA_CAP, rel=1e-3)
    assert torch.isfinite(learned.criterion.raw_kappa).all()


def test_channels_in_another_dimension_weights_per_sample_and_masked_nans_are_accepted():
    error, keep = residual_draws(300, 3, 4), torch.rand(300, 4) < 0.7
    holed = torch.where(keep.unsqueeze(1), error, NAN)
    module, _ = trained(Replay(3, channel_dim=1), loader(holed, keep, batch_size=32))
    assert_fitted(module.criterion, error.movedim(1, -1)[keep])


def test_weights_given_by_keyword_are_used():
    class ByKeyword(Replay):
        def training_step(self, batch):
            error, weight = batch
            return self.criterion(target=0 * error, weight=weight, input=error + 0 * self.shift)

    error, weight = residual_draws(600, 2), torch.rand(600, 2)
    module, _ = trained(ByKeyword(), loader(error, weight))
    assert_fitted(module.criterion, error, weight.double())


# --- timing of the E-steps


def test_gradient_accumulation_counts_optimiser_steps():
    watch = ParameterHistory()
    data = loader(residual_draws(1600, 2))  # 16 batches, 6 steps an epoch: the last of 1 batch
    callback = MKCExpectationMaximization(every_n_steps=2)
    trained(Replay(), data, callback, watch, max_epochs=2, accumulate_grad_batches=3)
    assert [step for step, *_ in watch.batches[:6]] == [0, 0, 1, 1, 1, 2]
    assert watch.steps_of_change() == [2, 4, 6, 8, 10, 12]


def test_steps_are_counted_over_epochs():
    watch = ParameterHistory()
    trained(Replay(), loader(residual_draws(500, 2)), MKCExpectationMaximization(every_n_steps=3), watch, max_epochs=3)
    assert watch.steps_of_change() == [3, 6, 9, 12, 15]
    assert len(watch.batches) == 15


def test_steps_of_several_optimisers_are_counted():
    class Manual(Replay):
        automatic_optimization = False

        def __init__(self):
            super().__init__()
            self.automatic_optimization = False

        def training_step(self, batch):
            loss = super().training_step(batch)
            for optimiser in self.optimizers():
                optimiser.step()
            return loss

        def configure_optimizers(self):
            return [super(Manual, self).configure_optimizers() for _ in range(2)]

    watch = ParameterHistory()
    trained(Manual(), loader(residual_draws(500, 2)), MKCExpectationMaximization(every_n_steps=3), watch)
    assert watch.steps_of_change() == [4, 6, 10]


def test_the_epoch_ends_before_its_validation():
    seen = []

    class Validated(Replay):
        def validation_step(self, _batch):
            seen.append(self.criterion.d.clone())

    module, _ = trained(
        Validated(), loader(residual_draws(500, 2)), val=loader(residual_draws(50, 2)), num_sanity_val_steps=0
    )
    assert torch.equal(seen[-1], module.criterion.d)
    assert not torch.equal(seen[-1], torch.ones(2))


def test_training_that_stops_within_an_epoch_uses_the_collected_residuals():
    error = residual_draws(1000, 2)
    module, _ = trained(Replay(), loader(error), max_epochs=None, max_steps=4)
    assert_fitted(module.criterion, error[:400])


def test_warm_up_changes_no_values_and_its_residuals_are_not_used():
    watch, module = ParameterHistory(), Replay(growth=3.0, bound=900.0)
    error = residual_draws(500, 2)
    trained(module, loader(error), MKCExpectationMaximization(warmup_epochs=2), watch, max_epochs=3)
    assert all(torch.equal(d, torch.ones(2)) for _, _, d in watch.batches[:14])
    assert_fitted(module.criterion, 9 * error)


@pytest.mark.parametrize("every_n_steps", [None, 5])
def test_annealing_brings_sigma_down_and_refits_d(every_n_steps):
    watch, error = ParameterHistory(), residual_draws(1000, 1)
    callback = MKCExpectationMaximization(warmup_epochs=1, anneal_epochs=4, every_n_steps=every_n_steps)
    trained(Replay(1), loader(error, batch_size=200), callback, watch, max_epochs=6)
    fit = fit_density(error.double(), bound=100.0, d_min=1e-3)
    sigma = torch.stack([s for _, s, _ in watch.epochs[1:]]).double()
    share = torch.tensor([0.25, 0.5, 0.75, 1.0, 1.0]).double().unsqueeze(-1)
    torch.testing.assert_close(sigma, fit.sigma / share.sqrt(), rtol=1e-3, atol=0)
    d = fit_density(error.double(), bound=100.0, d_min=1e-3, sigma=2 * fit.sigma).d
    torch.testing.assert_close(watch.epochs[1][2].double(), d, rtol=1e-3, atol=0)


def test_damping_keeps_part_of_the_values_from_the_second_step_on():
    watch, error = ParameterHistory(), residual_draws(1000, 1)
    trained(Replay(1, growth=0.25), loader(error), MKCExpectationMaximization(damping=0.5), watch, max_epochs=2)
    first, second = (fit_density(0.25**t * error.double(), bound=100.0, d_min=1e-3) for t in (0, 1))
    torch.testing.assert_close(watch.epochs[0][2].double(), first.d, rtol=1e-3, atol=0)
    torch.testing.assert_close(watch.epochs[1][2].double(), (first.d * second.d).sqrt(), rtol=1e-3, atol=0)
    between = ((first.sigma.pow(-2) + 0.02) * (second.sigma.pow(-2) + 0.02)).sqrt() - 0.02
    torch.testing.assert_close(watch.epochs[1][1].double().pow(-2), between, rtol=2e-3, atol=0)


# --- collected residuals


def test_only_residuals_of_the_last_epoch_are_used():
    error = residual_draws(500, 2)
    module, _ = trained(Replay(growth=2.0, bound=400.0), loader(error), max_epochs=3)
    assert_fitted(module.criterion, 4 * error)


def test_sanity_check_and_validation_add_nothing():
    error = residual_draws(500, 2)
    module, _ = trained(
        Replay(),
        loader(error),
        val=loader(residual_draws(300, 2)),
        num_sanity_val_steps=2,
        val_check_interval=2,
        max_epochs=2,
    )
    assert_fitted(module.criterion, error)


def test_calls_without_gradients_or_in_evaluation_mode_add_nothing():
    class Chatty(Replay):
        def training_step(self, batch):
            with torch.no_grad():
                self.criterion(9 * batch[0], torch.zeros_like(batch[0]))
            self.criterion.eval()
            self.criterion(9 * batch[0], torch.zeros_like(batch[0]))
            self.criterion.train()
            return super().training_step(batch)

    error = residual_draws(500, 2)
    module, _ = trained(Chatty(), loader(error))
    assert_fitted(module.criterion, error)


@pytest.mark.parametrize("call", ["validate", "test"])
def test_validate_and_test_change_nothing(call):
    module = Replay(**LEARNED)
    before = copy.deepcopy(module.state_dict())
    trainer = trainer_of(MKCExpectationMaximization())
    getattr(trainer, call)(module, loader(residual_draws(100, 2)), verbose=False)
    assert all(torch.equal(v, before[k]) for k, v in module.state_dict().items())
    assert all(p.requires_grad for p in module.parameters())
    assert not module.criterion._forward_hooks


def test_mixed_precision_keeps_the_residuals_in_float32():
    error = residual_draws(1000, 2)
    module, _ = trained(Replay(), loader(error), precision="bf16-mixed")
    assert_fitted(module.criterion, error)


def test_double_precision_is_kept():
    error = residual_draws(500, 2).double()
    module, _ = trained(Replay(), loader(error), MKCExpectationMaximization(damping=0.5), precision="64-true")
    assert module.criterion.d.dtype == torch.float64
    assert_fitted(module.criterion, error)


def test_low_precision_residuals_are_subtracted_in_float32():
    class Far(Replay):
        def training_step(self, batch):
            target = torch.full_like(batch[0], 64.0)
            return self.criterion((batch[0] + 64).bfloat16() + 0 * self.shift, target)

    error = residual_draws(1000, 2)
    module, _ = trained(Far(), loader(error))
    assert_fitted(module.criterion, (error + 64).bfloat16().float() - 64)


def test_a_network_in_mixed_precision_learns_the_scale():
    x = torch.randn(600, 3, generator=torch.Generator().manual_seed(0))
    y = x.sum(-1, keepdim=True) + residual_draws(600, 1)
    module, _ = trained(Regression(), loader(x, y), max_epochs=15, precision="bf16-mixed")
    assert module.criterion.d.item() == pytest.approx(0.5, rel=0.2)


def test_residuals_of_several_loaders_are_collected():
    class Two(Replay):
        def training_step(self, batch):
            return sum(Replay.training_step(self, batch[k]) for k in ("a", "b"))

    a, b = residual_draws(300, 2), residual_draws(300, 2, d=1.0, seed=1)
    data = CombinedLoader({"a": loader(a), "b": loader(b)}, "max_size_cycle")
    module, _ = trained(Two(), data)
    assert_fitted(module.criterion, torch.cat([a, b]))


def test_residuals_of_a_stream_and_of_a_limited_number_of_batches_are_collected():
    class Stream(IterableDataset):
        def __iter__(self):
            yield from error

    error = residual_draws(450, 2)
    module, _ = trained(Streamed(), DataLoader(Stream(), batch_size=100))
    assert_fitted(module.criterion, error)
    module, _ = trained(Replay(), loader(error), limit_train_batches=2)
    assert_fitted(module.criterion, error[:200])


class Streamed(Replay):
    def training_step(self, batch):
        return super().training_step((batch,))


@pytest.mark.parametrize("batches", [True, 3])
def test_a_fast_dev_run_fits_its_batches(batches):
    error = residual_draws(1000, 2)
    module, _ = trained(Replay(), loader(error), val=loader(error), fast_dev_run=batches)
    assert_fitted(module.criterion, error[: 100 * batches])


def test_batches_of_none_are_skipped():
    class Sparse(Replay):
        def on_before_batch_transfer(self, batch, _):
            return None if batch[0][0, 0] == 0 else batch

    error = residual_draws(500, 2)
    error[200] = error[400] = 0
    with pytest.warns(UserWarning, match="train_dataloader yielded None") as record:
        trained(Sparse(), loader(error), MKCExpectationMaximization(every_n_steps=2))
    assert not warnings_of(record)


class Dropped(Regression):
    """A network that differs between training and evaluation."""

    def __init__(self):
        super().__init__(outputs=2)
        self.net = nn.Sequential(nn.Linear(3, 2), nn.Dropout(0.5), nn.BatchNorm1d(2))
        self.net[2].eval()
        self.order = []

    def training_step(self, batch):
        self.order.append(batch[0][:, 0].clone())
        return super().training_step(batch)


def pairs(count=500):
    x = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return x, residual_draws(count, 2)


@pytest.mark.parametrize("combined", [False, True])
def test_a_separate_pass_uses_the_module_in_evaluation_mode(combined):
    x, y = pairs()
    data = loader(x, y)
    if combined:
        data = CombinedLoader({"a": data, "b": loader(x[:200], y[:200])}, "min_size")

    class Module(Dropped):
        def training_step(self, batch):
            return super().training_step(batch["a"] if combined else batch)

    def residuals(module, batch):
        assert not module.training
        assert not torch.is_grad_enabled()
        x, y = batch["a"] if combined else batch
        return module.net(x), y, torch.ones(len(x))

    count = 200 if combined else 500
    with pytest.warns(UserWarning, match="module.* in eval mode"):
        module, _ = trained(Module(), data, MKCExpectationMaximization(residuals=residuals), max_epochs=2)
    modes = [m.training for m in module.modules()]
    assert modes.count(False) == 1
    assert not module.net[2].training
    module.eval()
    with torch.no_grad():
        assert_fitted(module.criterion, (module.net(x) - y)[:count])


def test_a_separate_pass_does_not_change_the_order_of_training():
    orders = []
    for options in ({}, {"residuals": lambda module, batch: (module.net(batch[0]), batch[1])}):
        torch.manual_seed(3)
        module = Dropped()
        module.net[2].train()
        trained(module, loader(*pairs(), shuffle=True), MKCExpectationMaximization(**options), max_epochs=3)
        orders.append(torch.cat(module.order))
    assert torch.equal(*orders)


def test_a_separate_pass_runs_every_n_steps():
    watch = ParameterHistory()
    callback = MKCExpectationMaximization(every_n_steps=2, residuals=lambda _, batch: (batch[0], 0 * batch[0]))
    error = residual_draws(500, 2)
    trained(Replay(), loader(error), callback, watch)
    assert watch.steps_of_change() == [2]  # the same residuals each time
    assert len(watch.batches) == 5
    callback = MKCExpectationMaximization(residuals=lambda _, batch: batch[0])
    with pytest.raises(TypeError, match=r"`residuals` to return \(input, target\)"):
        trained(Replay(), loader(error), callback)


def test_persistent_workers_with_a_separate_pass_are_refused():
    error = residual_draws(100, 2)
    callback = MKCExpectationMaximization(every_n_steps=2, residuals=lambda _, batch: (batch[0], 0 * batch[0]))
    data = loader(error, num_workers=1, persistent_workers=True)
    trainer = SimpleNamespace(global_step=1, num_training_batches=4, train_dataloader={"a": loader(error), "b": data})
    module = Replay()
    callback.setup(SimpleNamespace(callbacks=[callback]), module, "fit")
    with pytest.raises(ValueError, match="persistent_workers=False"):
        callback.on_train_start(trainer, module)


# --- finding and owning the loss


class TwoLosses(Replay):
    def __init__(self, **options):
        super().__init__(2, **options)
        self.heads = nn.ModuleDict({"b": MKCLoss(1, bound=100.0, **FIXED)})

    def training_step(self, batch):
        error = batch[0]
        return super().training_step((error[:, :2],)) + self.heads["b"](error[:, 2:], 0 * error[:, 2:])


def test_two_losses_have_a_callback_each():
    error = residual_draws(500, 3)
    callbacks = MKCExpectationMaximization("criterion"), MKCExpectationMaximization(loss="heads.b", log=False)
    module, trainer = trained(TwoLosses(), loader(error), *callbacks)
    assert_fitted(module.criterion, error[:, :2])
    assert_fitted(module.heads["b"], error[:, 2:])
    assert "criterion/d_1" in trainer.callback_metrics
    assert "heads.b/d_0" not in trainer.callback_metrics
    assert callbacks[0].state_key != callbacks[1].state_key


def test_a_loss_of_two_names_is_a_single_loss():
    module, error = Replay(bound=200.0), residual_draws(300, 2)
    module.alias = module.criterion
    trained(module, loader(error), MKCExpectationMaximization("alias"))
    assert_fitted(module.criterion, error)
    trained(module, loader(2 * error))
    assert_fitted(module.criterion, 2 * error)


def test_a_loss_made_in_configure_model_is_found():
    class Late(Replay):
        def __init__(self):
            super().__init__()
            self.criterion = None

        def configure_model(self):
            if self.criterion is None:
                self.criterion = MKCLoss(2, bound=100.0, **FIXED)

    error = residual_draws(300, 2)
    module, _ = trained(Late(), loader(error))
    assert_fitted(module.criterion, error)


def assert_refused(module, *callbacks, error=None, match):
    before = [p.requires_grad for p in module.parameters()]
    with pytest.raises(ValueError, match=match):
        trained(module, loader(residual_draws(300, 3) if error is None else error), *callbacks)
    assert not any(m._forward_hooks for m in module.modules())
    assert [p.requires_grad for p in module.parameters()] == before


def test_several_losses_without_a_name_are_refused():
    assert_refused(TwoLosses(), match=r"`loss` to name one of `criterion`, `heads.b`.*got None")


def test_another_name_is_refused():
    assert_refused(TwoLosses(), MKCExpectationMaximization("b"), match=r"one of `criterion`, `heads.b`.*got 'b'")


def test_a_module_without_a_loss_is_refused():
    module = Replay()
    module.criterion = nn.MSELoss()
    assert_refused(module, match=r"Replay to hold an MKCLoss.*got none; make it an attribute")


def test_two_callbacks_for_one_loss_are_refused():
    callbacks = MKCExpectationMaximization(), MKCExpectationMaximization("criterion")
    assert_refused(Replay(), *callbacks, match=r"one MKCExpectationMaximization for the loss `criterion`.*got two")


@pytest.mark.parametrize(("learned", "named"), [("sigma", "raw_kappa"), ("d", "raw_d")])
def test_parameters_in_an_optimiser_are_refused_with_a_remedy(learned, named):
    class Joint(Replay):
        def configure_optimizers(self):
            return torch.optim.SGD(self.parameters(), lr=0.1)

    module = Joint(**{"learn_sigma": False, "learn_d": False, f"learn_{learned}": True})
    assert_refused(
        module, error=residual_draws(300, 2), match=f"got criterion.{named}: .*learn_sigma=False.*configure_optimizers"
    )


def test_learned_parameters_have_no_gradient_while_the_callback_owns_them():
    class Checked(Replay):
        def training_step(self, batch):
            assert not self.criterion.raw_kappa.requires_grad
            assert not self.criterion.raw_d.requires_grad
            return super().training_step(batch)

    module, _ = trained(Checked(**LEARNED), loader(residual_draws(300, 2)))
    assert module.criterion.raw_kappa.requires_grad
    assert module.criterion.raw_d.requires_grad
    assert module.criterion.raw_d.grad is None


def test_an_exception_releases_the_loss():
    class Failing(Replay):
        def training_step(self, _batch):
            raise RuntimeError("broken")

    module = Failing(**LEARNED)
    with pytest.raises(RuntimeError, match="broken"):
        trained(module, loader(residual_draws(300, 2)))
    assert module.criterion.raw_d.requires_grad
    assert not module.criterion._forward_hooks


def test_a_copy_of_the_module_adds_nothing_and_the_module_can_be_pickled():
    class Copies(Callback):
        def on_train_batch_start(self, _, pl_module, *__):
            twin, thawed = copy.deepcopy(pl_module.criterion), pickle.loads(pickle.dumps(pl_module.criterion))
            for other in (twin, thawed):
                other(torch.full((50, 2), 5.0, requires_grad=True), torch.zeros(50, 2))

    error = residual_draws(500, 2)
    module, _ = trained(Replay(), loader(error), MKCExpectationMaximization(), Copies())
    assert_fitted(module.criterion, error)


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@pytest.mark.filterwarnings("ignore:.* should not be instantiated. Methods on autograd functions")
@pytest.mark.parametrize("how", ["module", "in place", "whole"])
def test_residuals_of_compiled_losses_are_collected(how):
    torch._dynamo.reset()
    error, module = residual_draws(500, 2), Replay()
    if how == "module":
        module.criterion = torch.compile(module.criterion, backend="eager")
    elif how == "in place":
        module.criterion.compile(backend="eager")
    else:
        module = torch.compile(module, backend="eager")
    _, trainer = trained(module, loader(error), max_epochs=2)
    assert "criterion/d_0" in trainer.callback_metrics
    assert_fitted(_losses_of(module), error)


def _losses_of(module):
    return next(m for m in module.modules() if isinstance(m, MKCLoss))


# --- errors and warnings


@pytest.mark.parametrize("bad", [NAN, INF])
def test_residuals_that_are_not_finite_are_refused_with_step_channel_and_remedy(bad, monkeypatch):
    error = residual_draws(500, 2)
    error[320, 1] = bad
    assert_refused(Replay(), error=error, match=r"`input`.*finite.*got 1.*\(20, 1\)")
    # as on an accelerator, for which the loss does not wait
    monkeypatch.setattr("mkc_torch.losses.mkc.refuse_bad_batch", lambda *_: None)
    assert_refused(
        Replay(), error=error, match=r"step 3 of the loss `criterion`.*channel 1; .*torch.isfinite\(target\)"
    )


def test_a_loss_without_collected_residuals_warns_once():
    class Silent(Replay):
        def training_step(self, batch):
            return self.criterion.forward(batch[0] + 0 * self.shift, 0 * batch[0])

    with pytest.warns(UserWarning, match=r"No residual of the loss `criterion`.*`self.criterion\(input, ") as record:
        module, _ = trained(Silent(), loader(residual_draws(300, 2)), max_epochs=3)
    assert len(warnings_of(record)) == 1
    assert torch.equal(module.criterion.d, torch.ones(2))


@each_kind
def test_channels_with_too_few_residuals_keep_bitwise_equal_values(kind):
    error, weight = residual_draws(500, 9), torch.ones(500, 9)
    weight[:, 1] = 0
    weight[29:, 2:] = 0
    sigma = torch.cat([torch.linspace(1.0, 3.0, 8), torch.tensor([5 * SIGMA_CAP])])
    module = Replay(9, sigma=sigma, d=torch.linspace(0.3, 5.0, 9), **kind)
    before = copy.deepcopy(module.criterion.state_dict())
    with pytest.warns(UserWarning, match="Fewer than 30 residuals .* in channel 1, 2, .*8 of the loss") as record:
        trained(module, loader(error, weight), max_epochs=2)
    assert len(warnings_of(record)) == 1
    for key, value in module.criterion.state_dict().items():
        assert torch.equal(value[1:], before[key][1:]), key
    fit = fit_density(error[:, :1].double(), bound=100.0, d_min=1e-3)
    torch.testing.assert_close(module.criterion.d[:1].detach().double(), fit.d, rtol=1e-3, atol=0)


def test_zero_weights_change_nothing():
    module = Replay()
    before = copy.deepcopy(module.state_dict())
    with pytest.warns(UserWarning, match="Fewer than 30 residuals"):
        _, trainer = trained(module, loader(residual_draws(300, 2), torch.zeros(300, 2)))
    assert all(torch.equal(v, before[k]) for k, v in module.state_dict().items())
    assert "criterion/log_likelihood_0" not in trainer.callback_metrics


def test_residuals_beyond_the_bound_are_counted_with_a_warning():
    error = residual_draws(1000, 2)
    error[:50, 1] = 140.0
    error[:5, 0] = 140.0
    with pytest.warns(UserWarning, match="More than 1 % of the residuals .* in channel 1; ") as record:
        module, trainer = trained(Replay(), loader(error), max_epochs=2)
    assert len(warnings_of(record)) == 1
    found = [trainer.callback_metrics[f"criterion/share_beyond_bound_{i}"].item() for i in (0, 1)]
    assert found == pytest.approx([0.005, 0.05])
    assert_fitted(module.criterion, error)


@each_kind
def test_a_narrow_bound_falls_back_to_least_squares(kind):
    error = residual_draws(500, 2) * torch.tensor([1.0, 1e5])
    with pytest.warns(UserWarning, match="less than twice the typical residual in channel 1: least squares"):
        module, _ = trained(Replay(**kind), loader(error))
    assert module.criterion.d[1].item() == pytest.approx(50)
    assert module.criterion.sigma[1] >= 0.99 * SIGMA_CAP


@each_kind
def test_a_network_that_interpolates_warns_once(kind):
    module = Replay(growth=0.3, **kind)
    with pytest.warns(UserWarning, match=r"collapses in channel .*validation set.*d_min.*weight decay") as record:
        trained(module, loader(residual_draws(300, 2)), max_epochs=9)
    assert sorted(c for text in warnings_of(record) for c in text.partition(":")[0] if c.isdigit()) == ["0", "1"]
    assert (module.criterion.d >= module.criterion.d_min).all()


@each_kind
def test_residuals_of_zero_end_at_the_floor_with_a_warning(kind):
    with pytest.warns(UserWarning, match="collapses in channel 0, 1"):
        module, _ = trained(Replay(**kind), loader(torch.zeros(300, 2)))
    torch.testing.assert_close(module.criterion.d.detach(), module.criterion.d_min, rtol=1e-4, atol=0)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"every_n_steps": 0}, "`every_n_steps` to be an integer >= 1 but got 0"),
        ({"every_n_steps": 2.5}, "`every_n_steps` to be an integer"),
        ({"warmup_epochs": -1}, "`warmup_epochs` to be an integer >= 0 but got -1"),
        ({"warmup_epochs": True}, "`warmup_epochs`"),
        ({"anneal_epochs": 0}, "`anneal_epochs` to be an integer >= 1"),
        ({"damping": 1.0}, r"`damping` to be in \[0, 1\) but got 1.0"),
        ({"damping": NAN}, "`damping`"),
    ],
)
def test_arguments_out_of_range_are_refused(options, match):
    with pytest.raises(ValueError, match=match):
        MKCExpectationMaximization(**options)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"damping": "a"}, r"`damping` to be a number in \[0, 1\) but got 'a'"),
        (
            {"loss": MKCLoss(2)},
            "`loss` to be the loss's name in the module, or None but got MKCLoss.*; for example 'criterion'",
        ),
        ({"loss": 3}, "`loss` to be the loss's name in the module, or None but got 3"),
        (
            {"residuals": 3},
            r"`residuals` to be a function \(pl_module, batch\) -> .* but got 3; None uses the residuals",
        ),
    ],
)
def test_arguments_of_another_type_are_refused(options, match):
    with pytest.raises(TypeError, match=match):
        MKCExpectationMaximization(**options)


# --- log


def test_a_logger_gets_finite_values_of_each_channel(tmp_path):
    error = torch.stack([quantiles(500), residual_draws(500)], -1)
    logger = CSVLogger(tmp_path)
    _, trainer = trained(Replay(), loader(error), max_epochs=2, logger=logger)
    lines = (Path(logger.log_dir) / "metrics.csv").read_text().splitlines()
    expected = {f"criterion/{n}_{i}" for n in ("sigma", "d", "log_likelihood", "share_beyond_bound") for i in (0, 1)}
    assert expected <= set(lines[0].split(","))
    assert len(lines) == 3
    assert all(torch.isfinite(v) for v in trainer.callback_metrics.values())
    fit = fit_density(error.double(), bound=100.0, d_min=1e-3)
    for i in (0, 1):
        assert trainer.callback_metrics[f"criterion/log_likelihood_{i}"].item() == pytest.approx(
            fit.log_likelihood[i].item(), abs=1e-4
        )


def test_a_logger_gets_each_step_with_every_n_steps(tmp_path):
    logger = CSVLogger(tmp_path)
    callback = MKCExpectationMaximization(every_n_steps=2)
    trained(
        Replay(1, growth=0.5),
        loader(residual_draws(600, 1)),
        callback,
        max_epochs=2,
        logger=logger,
        log_every_n_steps=1,
    )
    lines = (Path(logger.log_dir) / "metrics.csv").read_text().splitlines()
    assert len(lines) > 6


@pytest.mark.parametrize("options", [{"barebones": True, "logger": None}, {}])
def test_logging_can_be_switched_off(options):
    callback = MKCExpectationMaximization(log=bool(options))
    quiet = {"enable_progress_bar": None, "enable_model_summary": None, "enable_checkpointing": None} if options else {}
    error = residual_draws(300, 2)
    module, trainer = trained(Replay(), loader(error), callback, **options, **quiet)
    assert "criterion/d_0" not in trainer.callback_metrics
    assert_fitted(module.criterion, error)


# --- checkpoints


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore:Checkpoint directory .* exists and is not empty")
@pytest.mark.parametrize(
    ("saved", "kind", "options"),
    [
        ("epoch", FIXED, {}),
        ("epoch", LEARNED, {"every_n_steps": 4, "damping": 0.6}),
        ("epoch", LEARNED, {"warmup_epochs": 1, "anneal_epochs": 4}),
        ("validation", LEARNED, {}),
        ("validation", FIXED, {"every_n_steps": 4, "damping": 0.6}),
        ("by hand", FIXED, {"damping": 0.3, "anneal_epochs": 3}),
    ],
)
def test_a_resumed_run_equals_the_uninterrupted_one_bit_for_bit(tmp_path, saved, kind, options):
    x = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    y = torch.stack([x.sum(-1), x[:, 0]], -1) + residual_draws(500, 2)
    val = {"val": loader(x[:100], y[:100])} if saved == "validation" else {}
    data = loader(x, y)  # five steps an epoch: every fourth leaves residuals over

    def run(max_epochs, ckpt_path=None):
        module, callback = Regression(outputs=2, **kind), MKCExpectationMaximization(**options)
        keeper = ModelCheckpoint(tmp_path, "{epoch}", save_top_k=-1, save_on_train_epoch_end=saved != "validation")
        trainer = trainer_of(callback, *([] if saved == "by hand" else [keeper]), max_epochs=max_epochs)
        trainer.fit(module, data, val.get("val"), ckpt_path=ckpt_path)
        return module, callback, trainer

    module, _, trainer = run(2)
    path = tmp_path / "epoch=1.ckpt"
    if saved == "by hand":
        trainer.save_checkpoint(path)
    assert path.exists()
    straight, expected, _ = run(5)
    resumed, found, _ = run(5, path)
    for key, value in straight.state_dict().items():
        assert torch.equal(resumed.state_dict()[key], value), key
    for key, value in expected.state_dict().items():
        other = found.state_dict()[key]
        if key == "guide":
            torch.testing.assert_close(other, value, rtol=0.0, atol=0.0)
        elif key == "histogram":
            assert (value["sums"] is None) == (other["sums"] is None) == ("every_n_steps" not in options)
            assert value["sums"] is None or torch.equal(value["sums"], other["sums"])
        else:
            assert torch.equal(value, other) if isinstance(value, torch.Tensor) else value == other, key
    assert not torch.equal(module.criterion.d, straight.criterion.d)


def test_a_checkpoint_restores_the_bound(tmp_path):
    error = residual_draws(500, 2)
    _, trainer = trained(Replay(bound=400.0), loader(error))
    trainer.save_checkpoint(tmp_path / "c.ckpt")
    module = Replay(bound=50.0)
    trainer_of(MKCExpectationMaximization(), max_epochs=2).fit(module, loader(4 * error), ckpt_path=tmp_path / "c.ckpt")
    assert_fitted(module.criterion, 4 * error)


def test_the_state_contains_only_tensors_and_plain_values(tmp_path):
    callback = MKCExpectationMaximization(every_n_steps=2)
    assert callback.state_dict() == {}
    trained(Replay(), loader(residual_draws(500, 2)), callback)
    torch.save(callback.state_dict(), tmp_path / "state.pt")
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    assert state["last_epoch"] == 0
    assert state["histogram"]["sums"].dtype == torch.float64


def test_a_checkpoint_of_other_channels_is_refused():
    few, many = MKCExpectationMaximization(), MKCExpectationMaximization()
    trained(Replay(2), loader(residual_draws(300, 2)), few)
    many.load_state_dict(few.state_dict())
    with pytest.raises(ValueError, match=r"a checkpoint of 3 channels.*got 2"):
        trained(Replay(3), loader(residual_draws(300, 3)), many)


def test_a_second_fit_continues_and_a_new_training_starts_afresh():
    callback, error = MKCExpectationMaximization(damping=0.5), residual_draws(500, 2)
    module, trainer = trained(Replay(bound=400.0), loader(error), callback)
    first = module.criterion.d.clone()
    trainer.fit_loop.max_epochs = 2
    trainer.fit(module, loader(4 * error))
    again, _ = trained(Replay(bound=400.0), loader(4 * error), callback)
    torch.testing.assert_close(module.criterion.d, (first * again.criterion.d).sqrt(), rtol=1e-5, atol=0)
    assert_fitted(again.criterion, 4 * error)


def test_the_callback_may_be_added_to_a_resumed_run(tmp_path):
    error = residual_draws(500, 2)
    _, trainer = trained(Replay(), loader(error), ParameterHistory(), max_epochs=2)
    trainer.save_checkpoint(tmp_path / "c.ckpt")
    watch = ParameterHistory()
    trainer = trainer_of(MKCExpectationMaximization(every_n_steps=4), watch, max_epochs=3)
    trainer.fit(Replay(), loader(error), ckpt_path=tmp_path / "c.ckpt")
    assert watch.steps_of_change() == [12]


# --- processes


class SaveParameters(Callback):
    """Each process writes its final state."""

    def __init__(self, folder):
        self.folder = folder

    def on_fit_end(self, trainer, pl_module):
        loss = pl_module.criterion
        torch.save((loss.sigma.detach(), loss.d.detach()), self.folder / f"{trainer.global_rank}.pt")


# forked processes start in a second; new processes import everything again
@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="needs fork")
@pytest.mark.skipif(torch.cuda.is_initialized(), reason="a process that uses CUDA cannot fork")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded, use of fork")
def test_processes_end_with_equal_parameters_from_all_their_residuals(tmp_path):
    error = residual_draws(800, 2) * torch.linspace(0.3, 1.0, 800).unsqueeze(-1)
    options = {"strategy": "ddp_fork", "devices": 2, "max_epochs": 2}
    data = loader(error, batch_size=100)
    # learned, so that DistributedDataParallel would wait for gradients of parameters that have none
    trained(Replay(**LEARNED), data, MKCExpectationMaximization(), SaveParameters(tmp_path), **options)
    left, other = (torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1))
    assert all(torch.equal(a, b) for a, b in zip(left, other, strict=True))
    alone, _ = trained(Replay(**LEARNED), data, max_epochs=2)
    torch.testing.assert_close(left, (alone.criterion.sigma.detach(), alone.criterion.d.detach()), rtol=1e-6, atol=0)


# --- without Lightning


@pytest.mark.process
def test_nothing_else_imports_lightning():
    root = Path(mkc_torch.__file__).parent
    importers = set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(n.split(".")[0] == "lightning" or n.startswith("mkc_torch.lightning") for n in names):
                importers.add(path.relative_to(root).parts[0])
    assert importers == {"lightning"}


def test_without_lightning_the_error_names_the_package_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "lightning", None)
    path = Path(mkc_torch.__file__).parent / "lightning" / "__init__.py"
    spec = importlib.util.spec_from_file_location("without_lightning", path)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'mkc-torch\[lightning\]'"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


def test_a_running_scale_is_frozen_and_fitted_from_the_first_e_step_on():
    error = residual_draws(400, 2)
    module = Replay(d="auto")
    trainer_of(MKCExpectationMaximization()).fit(module, loader(error))
    given = Replay()
    trainer_of(MKCExpectationMaximization()).fit(given, loader(error))
    assert module.criterion.residual_scale is None
    torch.testing.assert_close(module.criterion.d, given.criterion.d, rtol=0.02, atol=0.0)
    torch.testing.assert_close(module.criterion.sigma, given.criterion.sigma, rtol=0.1, atol=0.0)


@pytest.mark.e2e
def test_automatic_d_and_bound_have_the_unit_of_the_targets():
    x, y = permuted(1)
    found = []
    for unit in (1.0, 1e-4, 1e4):
        module = Regression(lr=0.05, sigma=3.0, d="auto", bound="auto", **FIXED)
        module.net = nn.Sequential(module.net, TimesUnit(unit))
        trained(module, loader(x, unit * y), max_epochs=20)
        loss = module.criterion
        assert not loss.tails(module.net(x), unit * y).is_gaussian.any()
        found.append([loss.sigma.item(), loss.d.item() / unit, loss.bound.item() / unit])
    assert 0.15 < found[0][1] < 0.45
    assert found[1] == pytest.approx(found[0], rel=1e-2)
    assert found[2] == pytest.approx(found[0], rel=1e-2)


class TimesUnit(nn.Module):
    """The unit of the targets as the last step of a network."""

    def __init__(self, unit):
        super().__init__()
        self.unit = unit

    def forward(self, x):
        return self.unit * x


def test_a_run_resumed_after_freezing_equals_the_uninterrupted_run(tmp_path):
    x, y = permuted(2)

    def fitted(epochs, path=None):
        torch.manual_seed(0)
        module = Regression(lr=0.05, sigma=3.0, d="auto", bound="auto", **FIXED)
        trainer = trainer_of(MKCExpectationMaximization(), max_epochs=epochs)
        trainer.fit(module, loader(x, y), ckpt_path=path, weights_only=False)
        trainer.save_checkpoint(tmp_path / f"{epochs}.ckpt")
        return module

    fitted(2)
    resumed, whole = fitted(5, tmp_path / "2.ckpt"), fitted(5)
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], value, rtol=0.0, atol=0.0, msg=name)


def test_a_default_loss_trains_a_network_for_any_sigma_and_d():
    torch.manual_seed(0)
    x = torch.randn(400, 3)
    y = 1000.0 * (x @ torch.tensor([[1.0], [-2.0], [0.5]])) + 10.0 * torch.randn(400, 1)
    y[::5] += 1e5
    module = Regression(lr=30.0, sigma=3.0, d="auto", bound="auto", learn_sigma=True, learn_d=True)
    with pytest.warns(UserWarning, match="the optimizer does not have them"):
        trainer_of(max_epochs=60).fit(module, loader(x, y))
    torch.testing.assert_close(module.net.weight[0].detach(), torch.tensor([1e3, -2e3, 500.0]), rtol=0.05, atol=0.0)


@pytest.mark.parametrize("options", [FIXED, LEARNED, {**FIXED, "d": "auto", "bound": "auto"}, {"d": "auto", **LEARNED}])
def test_a_module_that_is_fitted_again_starts_like_a_new_loss(options):
    torch.manual_seed(0)
    x = torch.randn(400, 3)
    y = x @ torch.tensor([[1.0], [-2.0], [0.5]]) + 0.1 * torch.randn(400, 1)
    module, expected = Regression(**options), Regression(**options)
    for fitted, fits in ((module, 2), (expected, 1)):
        for _ in range(fits):
            fitted.net.load_state_dict(Regression().net.state_dict())
            trained(fitted, loader(x, y, shuffle=False), max_epochs=4)
    for name, value in expected.state_dict().items():
        torch.testing.assert_close(module.state_dict()[name], value, rtol=0.0, atol=0.0, msg=name)


@pytest.mark.filterwarnings("ignore:The d of the loss `criterion` collapses")
@each_kind
def test_d_follows_residuals_that_shrink(kind):
    error = torch.randn(800, 2, generator=torch.Generator().manual_seed(0))
    module, _ = trained(Replay(d="auto", bound="auto", growth=0.02, **kind), loader(error), max_epochs=4)
    torch.testing.assert_close(module.criterion.d, torch.full((2,), 0.02**3), rtol=0.1, atol=0.0)


def test_a_floor_that_was_given_stays():
    module = Replay(d="auto", bound="auto", d_min=0.01, growth=1e-2)
    with pytest.warns(UserWarning, match=r"reached its floor.*If they are as small, lower a given `d_min`"):
        trained(module, loader(residual_draws(800, 2)), max_epochs=4)
    torch.testing.assert_close(module.criterion.d, torch.full((2,), 0.01))


TRUTH = torch.tensor([[1.0], [-2.0], [0.5]])


def permuted(seed, count=1200):
    """Inputs, and targets of a linear truth of which half are permuted among each other."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(count, 3, generator=g)
    y = x @ TRUTH + 0.2 * torch.randn(count, 1, generator=g)
    y[::2] = y[::2].roll(1, 0)
    return x, y


@pytest.mark.e2e
@pytest.mark.parametrize(("kind", "d"), [(FIXED, 1.0), (LEARNED, 1.0), (FIXED, 5.0), (LEARNED, "auto")])
def test_the_truth_is_learned_from_any_start_with_half_of_the_targets_permuted(kind, d):
    x, y = permuted(0)
    module, _ = trained(Regression(d=d, sigma=3.0, **kind), loader(x, y), max_epochs=40)
    torch.testing.assert_close(module.net.weight.detach().T, TRUTH, rtol=0.0, atol=0.05)
    assert module.criterion._guide is None  # the guide ends with the training


def test_without_graduated_the_likelihood_alone_trains_the_network():
    x, y = permuted(0)
    weights = []
    for graduated in (True, False):
        module, _ = trained(
            Regression(sigma=math.inf), loader(x, y), MKCExpectationMaximization(graduated=graduated), max_epochs=1
        )
        weights.append(module.net.weight.detach())
    module, _ = trained(Regression(sigma=math.inf), loader(x, y), ParameterHistory(), max_epochs=1)
    torch.testing.assert_close(weights[1], module.net.weight.detach())
    assert not torch.equal(*weights)

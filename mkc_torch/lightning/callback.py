"""MKC-EM for networks: a Lightning callback that fits σ and d of a loss to the residuals of each epoch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import CombinedLoader
from torch import Tensor, nn
from typing_extensions import override

from mkc_torch._support.arguments import checked_number, format_value, refuse_other_type
from mkc_torch.density.expectation_step import damped, damped_kappa, expectation_step
from mkc_torch.functional import mkc_nll
from mkc_torch.lightning._owned import SIGMA_CAP, OwnedLoss
from mkc_torch.lightning._progress import MIN_RESIDUALS, Progress
from mkc_torch.lightning._schedule_pace import Guide
from mkc_torch.lightning.residual_histogram import ResidualHistogram
from mkc_torch.losses.mkc import MKCLoss

if TYPE_CHECKING:
    from jaxtyping import Float

    Residuals = Callable[[LightningModule, Any], tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Tensor]]


class MKCExpectationMaximization(Callback):
    """Alternate between the network's weights and the loss's (σ, d): MKC-EM with an optimiser for the M-step.

    The optimiser treats σ and d as constants. At the end of each training epoch, before its validation, or every
    ``every_n_steps`` optimiser steps, an E-step sets them to the maximum-likelihood values for the residuals of the
    training steps since the last E-step. The residuals are collected from the calls of the loss, in a histogram of
    bounded memory: there is no second pass over the data, and the ``LightningModule`` needs no change. In distributed
    training the residuals of all processes are used, and all processes get the same values.

    The weights change during an epoch, and the network is in training mode (dropout), while residuals are collected.
    With ``residuals`` the residuals come from a separate pass.

    The recommended loss is ``MKCLoss(m, learn_sigma=False, learn_d=False, normalize=True)``: it has no parameters,
    reaches σ = ∞ exactly, and its values, for example on a validation set, are comparable between epochs. Without a
    given ``d`` and ``bound``, both follow the residuals until the first E-step and are then frozen; a physical bound is
    better. If the loss learns σ and d, their gradients are switched off during the fit: no optimiser may have these
    parameters, and σ is at most ``SIGMA_CAP``.

    A fit that does not resume from a checkpoint starts with ``loss.reset_parameters()``, at the constructor's values.
    The gradient of the loss is proportional to 1/d². Adam and similar optimisers are not affected; for plain SGD adapt
    the learning rate.

    Logged at the end of each epoch and, with ``every_n_steps``, at each E-step: ``criterion/sigma_i`` (∞ as
    ``SIGMA_CAP``), ``criterion/d_i``, ``criterion/log_likelihood_i`` (nats per residual, at the new σ and d) and
    ``criterion/share_beyond_bound_i``, for channel i and the loss's name in the module as prefix.

    Checkpoints contain the state; a run resumed at the end of an epoch continues as if uninterrupted. In distributed
    training a checkpoint within a collection keeps the residuals of the first process only.

    Args:
        loss: name of the loss in the module, for example ``"criterion"``; None if there is a single loss. Several
            losses need a callback each.
        every_n_steps: optimiser steps (``trainer.global_step``) per E-step; None: an E-step at the end of each epoch.
        warmup_epochs: epochs before the first E-step, with the initial σ and d of the loss.
        damping: share in [0, 1) of the previous values after an E-step, in log d and log(1/σ² + 0.02); the first E-step
            of a channel is not damped.
        anneal_epochs: number T of epochs after the warm-up in which σ decreases from large values: the t-th epoch uses
            t/T of the maximum-likelihood 1/σ², and d fitted for it. None: no annealing.
        graduated: whether the network starts with a loss sharper than the absolute value and is annealed to the
            likelihood, no wider than its residuals support; else the likelihood trains it throughout.
        residuals: ``(pl_module, batch) -> (input, target)`` or ``(input, target, weight)``, as for the loss. If given,
            each E-step makes a pass over the training data, with the module in evaluation mode and without gradients,
            instead of using the residuals of the training steps. A loader with its own generator shuffles by it;
            torch's generator is restored.
        log: whether to log.

    Raises:
        ValueError: an argument out of range. When the trainer runs: no loss, or several losses and no name; the loss's
            σ or d in an optimiser, or owned by another callback; a residual that is not finite, or a negative weight.
        TypeError: an argument of another type, or another return type of ``residuals``.

    Warns:
        UserWarning: no residual was collected, because the loss was called by its ``forward`` or a compiler removed its
            hooks. Once per channel: too few residuals; more than 1 % of them beyond the bound; a bound too narrow for
            them (least squares is used until they are smaller); a d that collapses as the network interpolates its
            targets.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), Algorithm 2 (MKC-EM).

    Example:
        >>> callback = MKCExpectationMaximization(warmup_epochs=2, damping=0.5)

        ::

            class Regression(LightningModule):
                def __init__(self):
                    super().__init__()
                    self.net = nn.Linear(8, 2)
                    self.criterion = MKCLoss(2, bound=50.0, learn_sigma=False, learn_d=False, normalize=True)

                def training_step(self, batch, batch_idx):
                    x, y = batch
                    return self.criterion(self.net(x), y)

                def configure_optimizers(self):
                    return torch.optim.Adam(self.parameters(), lr=1e-3)


            Trainer(max_epochs=20, callbacks=[callback]).fit(Regression(), loader)
    """

    def __init__(
        self,
        loss: str | None = None,
        *,
        every_n_steps: int | None = None,
        warmup_epochs: int = 0,
        damping: float = 0.0,
        anneal_epochs: int | None = None,
        graduated: bool = True,
        residuals: Residuals | None = None,
        log: bool = True,
    ) -> None:
        super().__init__()
        for name, value, low in (
            ("every_n_steps", every_n_steps, 1),
            ("warmup_epochs", warmup_epochs, 0),
            ("anneal_epochs", anneal_epochs, 1),
        ):
            if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < low):
                raise ValueError(f"Expected argument `{name}` to be an integer >= {low} but got {value!r}.")
        checked_number("damping", damping, 0.0, 1.0, "[)", "0 is no damping")
        if loss is not None:
            refuse_other_type("loss", loss, str, "the loss's name in the module, or None", "for example 'criterion'")
        if residuals is not None and not callable(residuals):
            raise TypeError(
                f"Expected argument `residuals` to be a function (pl_module, batch) -> (input, target) but got "
                f"{format_value(residuals)}; None uses the residuals of the training steps."
            )
        self.loss = loss
        self.every_n_steps = every_n_steps
        self.warmup_epochs = warmup_epochs
        self.damping = damping
        self.anneal_epochs = anneal_epochs
        self.graduated = graduated
        self.residuals = residuals
        self._logs = log  # the trainer overwrites an attribute `log`
        self._owned: OwnedLoss | None = None
        self._progress: Progress | None = None
        self._restored: dict[str, Any] | None = None
        self._collecting = False
        self._step = 0  # before the training batch

    @property
    @override
    def state_key(self) -> str:
        return self._generate_state_key(loss=self.loss)

    @override
    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        # before DistributedDataParallel collects the parameters with gradients
        if stage == "fit" and _losses(pl_module):
            self._take(trainer, pl_module)

    @override
    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._owned is None:  # the loss was made in configure_model
            self._take(trainer, pl_module)
        owned, progress = self._running()
        owned.refuse_optimised(trainer)
        if self._restored is not None:
            progress.load_state_dict(self._restored)
            self._restored = None
            if not trainer.is_global_zero:  # the saved residuals are those of the first process
                progress.histogram.clear()
        if owned.loss.fixed_bound is not None:  # the bound of the checkpoint
            progress.histogram.set_bound(owned.loss.bound)
        progress.histogram.to(pl_module.device)

    @override
    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            self._progress = Progress(self._running()[0].restart(trainer))
        owned, progress = self._running()
        if self.graduated and progress.guide is None and owned.loss.schedule is None:
            progress.guide = Guide.of_channels(owned.loss.num_channels)
        owned.guide(progress.guide if self.graduated else None, trainer)
        self._step = trainer.global_step
        if self.residuals is not None and self.every_n_steps is not None:
            _refuse_persistent_workers(trainer)

    @override
    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        self._collecting = self.residuals is None and trainer.current_epoch >= self.warmup_epochs

    @override
    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self._collecting = False
        before, self._step = self._step, trainer.global_step
        if trainer.current_epoch < self.warmup_epochs:
            return
        if self.every_n_steps is None:
            if trainer.is_last_batch:
                self._expectation(trainer, pl_module)
        elif self._step // self.every_n_steps > before // self.every_n_steps:
            self._expectation(trainer, pl_module)
            self._log_values(trainer, pl_module, on_step=True)

    @override
    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._collecting = False
        progress = self._running()[1]
        ended_early = progress.last_epoch < trainer.current_epoch
        if self.every_n_steps is None and ended_early and trainer.current_epoch >= self.warmup_epochs:
            self._expectation(trainer, pl_module)
        self._log_values(trainer, pl_module, on_step=False)

    @override
    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._release()

    @override
    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._release()

    @override
    def state_dict(self) -> dict[str, Any]:
        return {} if self._progress is None else self._progress.state_dict()

    @override
    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if self._owned is None or self._progress is None:
            self._restored = state_dict
        else:
            self._progress.load_state_dict(state_dict)

    def _take(self, trainer: Trainer, pl_module: LightningModule) -> None:
        name, loss = _find_loss(pl_module, self.loss)
        for other in trainer.callbacks:  # type: ignore[attr-defined]
            if isinstance(other, MKCExpectationMaximization) and other._owned is not None and other._owned.loss is loss:
                raise ValueError(
                    f"Expected one MKCExpectationMaximization for the loss `{name}` but got two; "
                    "give each callback the name of another loss, or remove a callback."
                )
        self._owned = OwnedLoss.of(name, loss, self._collect)
        if self._progress is None or len(self._progress.histogram.bound) != loss.num_channels:
            self._progress = Progress(self._owned.histogram())

    def _release(self) -> None:
        self._collecting = False
        if self._owned is not None:
            self._owned.release()
            self._owned = None

    def _running(self) -> tuple[OwnedLoss, Progress]:
        assert self._owned is not None
        assert self._progress is not None
        return self._owned, self._progress

    @torch.compiler.disable  # type: ignore[untyped-decorator]
    def _collect(self, loss: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any], _output: Any) -> None:
        if self._collecting and loss.training and torch.is_grad_enabled():
            owned, progress = self._running()
            try:
                _add_residuals(progress.histogram, owned.loss, *args, **kwargs)
            except ValueError as error:
                raise ValueError(f"In step {self._step} of the loss `{owned.name}`: {error}") from None

    def _expectation(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """The E-step, which every process makes at the same step."""
        owned, progress = self._running()
        if self.residuals is not None:
            _collect_by_pass(progress.histogram, owned.loss, self.residuals, trainer, pl_module)
        if trainer.world_size > 1:
            progress.histogram.all_reduce()
        try:
            progress.histogram.check()
        except ValueError as error:
            raise ValueError(f"Since the last E-step of the loss `{owned.name}`: {error}") from None
        if bool(progress.histogram.batches == 0):
            progress.warn_once("silent", owned.name, torch.ones_like(progress.start_d, dtype=torch.bool))
        else:
            self._update(trainer)
        progress.histogram.clear()
        progress.last_epoch = trainer.current_epoch

    @torch.no_grad()
    def _update(self, trainer: Trainer) -> None:
        owned, progress = self._running()
        loss, histogram = owned.loss, progress.histogram
        if loss.residual_scale is not None:  # d and bound followed the residuals; from here on the E-step sets d
            guide = owned.freeze()
            if self.graduated:
                progress.guide = guide
            owned.guide(progress.guide, trainer)
            histogram.set_bound(loss.bound)
        error, weight = histogram.residuals()
        owned.follow_floor(error, weight)
        own = (loss.kappa, loss.d, loss.bound, loss.d_min)
        kappa, d, bound, d_min = (t.detach().to(histogram.bound, copy=True) for t in own)
        usable = (histogram.count >= MIN_RESIDUALS) & (histogram.weight() > 0)
        narrow = torch.zeros_like(usable)
        if bool(usable.any()):
            share = self._share_of_kappa(trainer.current_epoch)
            found = expectation_step(
                error[:, usable], weight[:, usable], bound=bound[usable], d_min=d_min[usable], share=share
            )
            keep = torch.where(torch.isnan(progress.start_d.to(d)[usable]), 0.0, self.damping)
            kappa[usable] = damped_kappa(kappa[usable], found.kappa, keep)
            d[usable] = damped(d[usable], found.d, keep)
            narrow[usable] = found.narrow
            if trainer.world_size > 1:
                # the sums are equal in all processes, but processors may round differently
                kappa, d = (t.to(kappa) for t in trainer.strategy.broadcast((kappa.cpu(), d.cpu())))
            owned.assign(usable, kappa, d)
        improved = progress.record(loss, usable, _log_likelihood(loss, error, weight))
        progress.warn(owned, usable=usable.cpu(), narrow=narrow.cpu(), improved=improved)

    def _share_of_kappa(self, epoch: int) -> float:
        """Share of the maximum-likelihood 1/σ² used in an epoch."""
        return 1.0 if self.anneal_epochs is None else min(1.0, (epoch - self.warmup_epochs + 1) / self.anneal_epochs)

    def _log_values(self, trainer: Trainer, pl_module: LightningModule, *, on_step: bool) -> None:
        if not self._logs or trainer.barebones:
            return
        owned, progress = self._running()
        for name, values in (
            ("sigma", owned.loss.sigma.clamp(max=SIGMA_CAP)),
            ("d", owned.loss.d),
            ("log_likelihood", progress.log_likelihood),
            ("share_beyond_bound", progress.share_beyond),
        ):
            for i, value in enumerate(values.tolist()):
                if value == value:  # NaN before the first E-step of a channel
                    pl_module.log(
                        f"{owned.name}/{name}_{i}",
                        value,
                        on_step=on_step,
                        on_epoch=not on_step,
                        batch_size=1,
                        # the values are equal; without sync_dist Lightning warns
                        sync_dist=trainer.world_size > 1,
                    )


def _losses(module: nn.Module) -> dict[str, MKCLoss]:
    """Every MKCLoss of a module by each of its names; a compiled loss has its uncompiled name."""
    return {
        ".".join(part for part in name.split(".") if part != "_orig_mod"): child
        for name, child in module.named_modules(remove_duplicate=False)
        if isinstance(child, MKCLoss)
    }


def _find_loss(module: nn.Module, name: str | None) -> tuple[str, MKCLoss]:
    """The loss of a name, or the single loss for None."""
    losses = _losses(module)
    names = ", ".join(f"`{n}`" for n in losses)
    if not losses:
        raise ValueError(
            f"Expected {type(module).__name__} to hold an MKCLoss but got none; "
            "make it an attribute, `self.criterion = MKCLoss(...)`."
        )
    if name is not None:
        if name not in losses:
            raise ValueError(f"Expected argument `loss` to be one of {names} but got {name!r}.")
        return name, losses[name]
    if len({id(loss) for loss in losses.values()}) > 1:
        raise ValueError(
            f"Expected argument `loss` to name one of {names} but got None; "
            "pass a callback for each loss, MKCExpectationMaximization(loss=...)."
        )
    return next(iter(losses.items()))


def _add_residuals(
    histogram: ResidualHistogram, loss: MKCLoss, input: Tensor, target: Tensor, weight: Tensor | None = None
) -> None:
    """Add the residuals of a call of the loss, which has checked the shapes."""
    half = input.dtype in (torch.float16, torch.bfloat16)
    finite = torch.isfinite(input.detach())
    input, target = (t.detach().to(torch.promote_types(t.dtype, torch.float32)) for t in (input, target))
    error = input - target
    if weight is not None:
        if weight.dim() < error.dim():
            weight = weight.unsqueeze(loss.channel_dim % error.dim())
        weight = weight.detach().expand(error.shape)
    if half:  # the gradient scaler handles overflows; they are not residuals
        weight = finite if weight is None else weight * finite
    histogram.add(error, weight, loss.channel_dim)


def _collect_by_pass(
    histogram: ResidualHistogram, loss: MKCLoss, residuals: Residuals, trainer: Trainer, pl_module: LightningModule
) -> None:
    """Fill the histogram with the residuals of the training data at the current weights."""
    histogram.clear()
    with _evaluating(pl_module), trainer.precision_plugin.forward_context():
        for batch in _training_batches(trainer, pl_module):
            found = residuals(pl_module, batch)
            if not isinstance(found, tuple) or len(found) not in (2, 3):
                raise TypeError(
                    "Expected `residuals` to return (input, target) or (input, target, weight) "
                    f"but got {type(found).__name__}."
                )
            loss(*found)  # raises for arguments that it refuses in training
            _add_residuals(histogram, loss, *found)


@contextmanager
def _evaluating(module: nn.Module) -> Iterator[None]:
    """Evaluation mode without gradients; on exit each submodule's mode and torch's random state are restored."""
    modes = [(m, m.training) for m in module.modules()]
    module.eval()
    try:
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            yield
    finally:
        for m, mode in modes:
            m.training = mode


def _training_batches(trainer: Trainer, pl_module: LightningModule) -> Iterator[Any]:
    """The batches of a training epoch, on the module's device, passed through the module's hooks."""
    # a separate loader, because the trainer's is being iterated
    mode: Any = getattr(trainer.fit_loop._combined_loader, "_mode", "max_size_cycle")
    loader = CombinedLoader(trainer.train_dataloader, mode)
    for batch, index, _ in loader:
        if index >= trainer.num_training_batches:
            return
        batch = pl_module.on_before_batch_transfer(trainer.precision_plugin.convert_input(batch), 0)
        yield trainer.strategy.batch_to_device(batch)


def _refuse_persistent_workers(trainer: Trainer) -> None:
    for loader in CombinedLoader(trainer.train_dataloader).flattened:
        if getattr(loader, "persistent_workers", False):
            raise ValueError(
                "Expected a training loader with `persistent_workers=False` if `residuals` and `every_n_steps` are "
                "given but got True: persistent workers serve a single pass, and the pass of an E-step would end the "
                "epoch's."
            )


def _log_likelihood(loss: MKCLoss, error: Float[Tensor, "N m"], weight: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """Mean log-density of the residuals of each channel, in nats; NaN for a channel without residuals."""
    sigma, d, bound = (t.detach().to(error) for t in (loss.sigma, loss.d, loss.bound))
    return -(weight * mkc_nll(error, sigma, d, bound)).sum(0) / weight.sum(0)

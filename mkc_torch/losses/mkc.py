"""The MKC likelihood as a loss module."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor, nn

from mkc_torch._support.arguments import as_numbers, refuse_bad_batch, told
from mkc_torch._support.torch_internals import in_backward, is_transformed
from mkc_torch.density.energy import KAPPA_MAX, as_computed, inverse_square
from mkc_torch.density.normalizer import log_partition
from mkc_torch.losses._checks import (
    Reduction,
    checked_axis,
    checked_weight,
    refuse_no_dimension,
    refuse_other_reduction,
    refuse_other_shapes,
    shortly,
)
from mkc_torch.losses._curves import ChannelCurves
from mkc_torch.losses._fused import fused_loss
from mkc_torch.losses._implementation import Implementation, checked_implementation, runs_kernels
from mkc_torch.losses._parameters import ChannelState, logistic, to_d
from mkc_torch.losses._snapshot import snapshot
from mkc_torch.losses._state_dict import logit_of_kappa, logit_of_scale, translate
from mkc_torch.losses._terms import Batch, LossTerms, Settings, loss_terms, loss_value
from mkc_torch.losses.bandwidth_schedule import BandwidthSchedule
from mkc_torch.losses.residual_scale import SCALES_IN_BOUND, ResidualScale

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["DEFAULT_BOUND_IN_D", "DEFAULT_D_MIN_IN_D", "MKCLoss", "Objective", "checked_loss"]

Objective = Literal["robust", "likelihood"]

DEFAULT_BOUND_IN_D = 100.0
"""Half-width of the domain, in units of the initial d, where no bound is given."""

DEFAULT_D_MIN_IN_D = 1e-3
"""Floor under d, in units of the initial d, where none is given."""

DEFAULT_LEARNING_RATE = 1e-2
"""Learning rate of σ and d in :meth:`MKCLoss.param_groups`."""


class MKCLoss(ChannelCurves, nn.Module):
    """Multi-kernel correntropy loss with a bandwidth σ and a scale d for each channel.

    The likelihood is (17) of Li et al. (2023): ``energy + log_normalizer`` where anything is learned, and with σ and d
    fixed the paper's loss, ``energy = σ² (1 - exp(-e² / (2 d² σ²)))``, e being input less target. Learning
    un-normalised σ and d is refused: the energy alone is smallest at σ → 0 or d → ∞, whatever the data.

    ``objective`` says by what the network learns:

    - ``"likelihood"``: the value is the likelihood, and every gradient is its own.
    - ``"robust"``: in training the value is the sum of two terms, as in any stop-gradient objective. ``network`` moves
      the network alone: a :class:`BandwidthSchedule` of residuals over their running :class:`ResidualScale`, at first
      sharper than the absolute value, later Welsch's loss of the widest bandwidth whose estimated risk is within a
      tenth of the smallest. ``density``, the likelihood at detached residuals, moves σ and d alone. In evaluation the
      value is the likelihood. Up to half of the targets may be wrong.

    Without a ``d`` the scales follow the residuals while the network learns, robustly and for each channel, so that
    targets of any unit need no tuning.

    Args:
        num_channels: m, the size of the channel dimension.
        sigma: initial or fixed bandwidths in [0.05, inf], a number or (m,). ``inf`` is the Gaussian; a σ that is to be
            learned must start finite, since its gradient is 0 at ``inf``.
        d: initial or fixed scales > 0 in the unit of the target, a number or (m,); "auto" takes them from the
            residuals of each training batch, and ``learn_d`` then learns a factor on them.
        bound: half-width a of the domain of the errors, in the unit of the target, a number or (m,). "auto" means half
            the range of the residuals and no less than ten scales where ``d`` is "auto"; with a given d, as None, 100
            times that d, and it stays there while d is learned. The likelihood of σ depends on it: a physical bound
            is better, and likelihoods compare only at equal bounds. Errors beyond it keep a finite loss and gradient.
        objective: "robust" or "likelihood"; None is robust where d is "auto".
        learn_sigma: whether σ is a parameter.
        learn_d: whether d is a parameter; it stays in [d_min, bound].
        normalize: whether to add the log-normaliser; None does so if anything is learned.
        channel_dim: the dimension of the input that holds the channels, 1 for (N, C, H, W); None for the last. An input
            of four dimensions or more whose second and last both have size m is refused until one is named.
        reduction: "none", "mean" (over elements, weighted where weights are given) or "sum".
        d_min: floor under d, a number or (m,); None means a thousandth of the initial d, or of the spread of the first
            residuals. The likelihood of a network that interpolates its targets grows without limit as d → 0.
        impl: "auto" runs Triton kernels on a GPU that has them and torch elsewhere; "eager", "compile" and "triton"
            name one. All compute the same.

    Attributes:
        sigma, d: current values (m,), differentiable; assign to set them.
        bound, d_min: current values (m,).
        residual_scale: the :class:`ResidualScale`, or None where d is given and the objective is the likelihood.
        schedule: the :class:`BandwidthSchedule`, or None where the objective is the likelihood.

    Raises:
        TypeError: an argument that is no number.
        ValueError: an argument out of range, or learning asked for with ``normalize=False``.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (9) and (17).

    Example:
        >>> loss = MKCLoss(2, sigma=3.0, d=1.0, bound=50.0)
        >>> output = torch.zeros(4, 2, requires_grad=True)
        >>> value = loss(output, torch.tensor([[0.1, -0.2], [0.3, 0.0], [-0.1, 0.2], [0.0, 40.0]]))
        >>> value.backward()
        >>> bool(output.grad[3, 1].abs() < 1e-6)  # the outlier has no influence
        True
    """

    fixed_bound: Tensor | None
    fixed_d_min: Tensor | None
    fixed_kappa: Tensor | None
    fixed_d: Tensor | None
    residual_scale: ResidualScale | None
    schedule: BandwidthSchedule | None

    def __init__(
        self,
        num_channels: int,
        *,
        sigma: float | Float[Tensor, " m"] = 3.0,
        d: float | Float[Tensor, " m"] | Literal["auto"] = "auto",
        bound: float | Float[Tensor, " m"] | Literal["auto"] | None = "auto",
        objective: Objective | None = None,
        learn_sigma: bool = True,
        learn_d: bool = True,
        normalize: bool | None = None,
        channel_dim: int | None = None,
        reduction: Reduction = "mean",
        d_min: float | Float[Tensor, " m"] | None = None,
        impl: Implementation = "auto",
    ) -> None:
        super().__init__()
        if isinstance(num_channels, bool) or not isinstance(num_channels, int) or num_channels < 1:
            raise ValueError(f"Expected argument `num_channels` to be a positive integer but got {num_channels!r}.")
        refuse_other_reduction(reduction)
        refuse_no_dimension(-1 if channel_dim is None else channel_dim)
        learned = learn_sigma or learn_d
        if normalize is None:
            normalize = learned
        if learned and not normalize:
            raise ValueError(
                "Expected `learn_sigma=False, learn_d=False` with `normalize=False`: without the normaliser the loss "
                "is smallest at sigma -> 0 or d -> inf, whatever the data. Drop `normalize=False` to learn them."
            )
        follows = _is_auto(d)
        if objective not in (None, "robust", "likelihood"):
            raise ValueError(f"Expected argument `objective` to be 'robust', 'likelihood' or None but got {objective!r}.")
        robust = objective == "robust" or (objective is None and follows)
        self.num_channels = num_channels
        self.normalize = normalize
        self.channel_dim, self._named_dim = -1 if channel_dim is None else channel_dim, channel_dim is not None
        self.reduction = reduction
        self.impl = checked_implementation(impl)
        self._follows = follows
        self.residual_scale = ResidualScale(num_channels) if follows or robust else None
        self.schedule = BandwidthSchedule(num_channels) if robust else None
        self.__dict__["_guide"] = None  # no part of the state_dict
        kappa = inverse_square(self._sigma_in_range(sigma))
        own_bound = not (bound is None or _is_auto(bound))
        d = torch.ones(num_channels) if _is_auto(d) else self._per_channel("d", d, low=0.0)
        half_width = self._per_channel("bound", bound, low=0.0) if own_bound else DEFAULT_BOUND_IN_D * d
        floor = DEFAULT_D_MIN_IN_D * d if d_min is None else self._per_channel("d_min", d_min, low=0.0)
        if not follows and not bool((half_width > d).all()):
            raise ValueError(f"Expected argument `bound` to exceed `d` but got {half_width.tolist()} and {d.tolist()}.")
        if not follows and learn_d and not bool((floor < d).all()):
            raise ValueError(f"Expected argument `d_min` below `d` but got {floor.tolist()} and {d.tolist()}.")
        self.register_buffer("fixed_bound", half_width if own_bound or not follows else None)
        self.register_buffer("fixed_d_min", floor if d_min is not None or not follows else None)
        self.register_buffer("fixed_kappa", None if learn_sigma else kappa)
        self.register_buffer("fixed_d", None if learn_d or follows else d)
        self.raw_kappa = nn.Parameter(torch.empty_like(kappa)) if learn_sigma else None
        self.raw_d = nn.Parameter(torch.zeros_like(d)) if learn_d else None
        self._set_kappa(kappa)
        if not follows:
            self._set_d(d)

    def _per_channel(self, name: str, value: object, *, low: float) -> Tensor:
        (t,) = as_computed(as_numbers(name, value).detach())
        if t.dim() > 1 or (t.dim() == 1 and t.shape[0] not in (1, self.num_channels)):
            raise ValueError(
                f"Expected argument `{name}` to be a number or of shape ({self.num_channels},) but got {tuple(t.shape)}"
            )
        if not bool(((t > low) & torch.isfinite(t)).all()):
            raise ValueError(f"Expected argument `{name}` to be positive and finite but got {value}.")
        return t.expand(self.num_channels).clone()

    def _sigma_in_range(self, value: float | Tensor) -> Tensor:
        (t,) = as_computed(as_numbers("sigma", value).detach())
        least = KAPPA_MAX**-0.5
        if not bool((t >= least).all()):
            raise ValueError(f"Expected argument `sigma` in [{least:g}, inf] but got {value}; 3 is a usual start.")
        finite = self._per_channel("sigma", torch.where(torch.isinf(t), 1.0, t), low=0.0)
        return torch.where(torch.isinf(t).expand_as(finite), torch.inf, finite)

    @property
    def kappa(self) -> Float[Tensor, " m"]:
        """``1 / sigma²`` in [0, 400]."""
        if self.raw_kappa is None:
            assert self.fixed_kappa is not None
            return self.fixed_kappa
        return KAPPA_MAX * logistic(self.raw_kappa)

    @torch.no_grad()
    def _set_kappa(self, kappa: Tensor) -> None:
        if self.raw_kappa is not None:
            if bool((kappa == 0).any()):
                raise ValueError(
                    "Expected a finite `sigma` with `learn_sigma=True` but got inf, where its gradient is 0; "
                    "start large, at 10 say, or pass `learn_sigma=False`."
                )
            self.raw_kappa.copy_(logit_of_kappa(kappa))
        elif self.fixed_kappa is not None:
            self.fixed_kappa.copy_(kappa)

    @property
    def sigma(self) -> Float[Tensor, " m"]:
        """Bandwidths; assign a number or (m,) in [0.05, inf] to set them."""
        return self.kappa.rsqrt()

    @sigma.setter
    def sigma(self, value: float | Tensor) -> None:
        self._set_kappa(inverse_square(self._sigma_in_range(as_numbers("sigma", value, self._dtype))))

    @property
    def objective(self) -> Objective:
        """By what the network learns: "robust" or "likelihood"."""
        return "likelihood" if self.schedule is None else "robust"

    @property
    def bound(self) -> Float[Tensor, " m"]:
        """Half-width of the domain of the errors, in the unit of the target."""
        return self._state().bound

    @property
    def d_min(self) -> Float[Tensor, " m"]:
        """Floor under d, in the unit of the target."""
        return self._state().floor

    @property
    def d(self) -> Float[Tensor, " m"]:
        """Scales in the unit of the target; assign a number or (m,) in (d_min, bound) to set them, where given."""
        if not self._follows and self.raw_d is None:
            assert self.fixed_d is not None
            return self.fixed_d
        return to_d(self.raw_d, self._state(), follows=self._follows)

    @d.setter
    def d(self, value: float | Tensor) -> None:
        if self._follows:
            raise ValueError(
                f"Expected a loss with a given `d` to set it but got one that takes d from the residuals, d={value}; "
                "call freeze_scale() first, or make the loss with `d=` and `bound=`."
            )
        bound, d_min = self.bound, self.d_min
        d = self._per_channel("d", as_numbers("d", value, self._dtype), low=0.0).to(bound)
        if self.raw_d is not None and not bool(((d > d_min) & (d < bound)).all()):
            raise ValueError(
                f"Expected `d` between `d_min` {d_min.tolist()} and `bound` {bound.tolist()} but got {value}."
            )
        self._set_d(d)

    @torch.no_grad()
    def _set_d(self, d: Tensor) -> None:
        if self.raw_d is not None:
            self.raw_d.copy_(logit_of_scale(d, self.d_min, self.bound))
        elif self.fixed_d is not None:
            self.fixed_d.copy_(d)

    @property
    def _dtype(self) -> torch.dtype:
        given = (self.raw_kappa, self.fixed_kappa, self.raw_d, self.fixed_d, self.fixed_bound)
        dtype = torch.float32
        for one in given:
            if one is not None:
                dtype = torch.promote_types(dtype, one.dtype)
        return dtype

    @torch.no_grad()
    def freeze_scale(self) -> None:
        """Stop following the residuals: d and bound stay as they are and the objective becomes the likelihood.

        For an optimiser that needs the same function at every call, L-BFGS say, and to compare likelihoods.

        Example:
            >>> loss = MKCLoss(1)
            >>> _ = loss(torch.tensor([[-1.0], [1.0], [3.0]]), torch.zeros(3, 1))
            >>> loss.freeze_scale()
            >>> loss.objective, bool(loss.bound > 5.0 * loss.d)
            ('likelihood', True)
        """
        if self._follows:
            state = self._state()
            d = to_d(self.raw_d, state, follows=True)
            d = torch.minimum(torch.maximum(d, state.floor * (1.0 + 1e-6)), 0.5 * state.bound)
            self.fixed_bound, self.fixed_d_min, self._follows = state.bound.clone(), state.floor.clone(), False
            if self.raw_d is None:
                self.fixed_d = d
            else:
                self.raw_d.copy_(logit_of_scale(d, state.floor, state.bound))
        self.residual_scale, self.schedule = None, None

    def guide(self, residual_scale: ResidualScale | None, schedule: BandwidthSchedule | None) -> None:
        """Let the network learn by a schedule, as under ``objective="robust"``, that is no part of the loss.

        For trainers that own σ and d: the loss stays the likelihood of given numbers, its ``state_dict`` has nothing of
        the schedule, and in training the network learns by the likelihood's energy at a bandwidth no wider than the
        selected bandwidth. None and None end it.
        """
        self.__dict__["_guide"] = None if residual_scale is None or schedule is None else (residual_scale, schedule)

    def _running(self) -> tuple[ResidualScale | None, BandwidthSchedule | None]:
        """The modules that are updated in training."""
        guide = self.__dict__["_guide"]
        if guide is not None:
            return guide
        modules: Any = self._modules  # attributes of modules take a microsecond each
        return modules.get("residual_scale"), modules.get("schedule")

    def _state(self, batch: Batch | None = None, *, robust: bool = False) -> ChannelState:
        """The buffers as one forward pass takes them: copies, for the next batch changes the buffers.

        With a batch, channels that have had none take their scale from it.
        """
        running, schedule = self._running() if robust else (self.residual_scale, None)
        bound, floor, scale = self.fixed_bound, self.fixed_d_min, None
        if running is not None:
            log_scale, half_range, own_floor = running.log_scale, running.half_range, running.floor
            if batch is not None:
                weight = batch.weight
                _, log_scale, half_range, own_floor = running.with_batch(batch.input, batch.target, weight, batch.axis)
            scale = log_scale.exp()
            bound = torch.maximum(half_range, SCALES_IN_BOUND * scale) if bound is None else bound
            floor = own_floor.clone() if floor is None else floor
        assert bound is not None
        assert floor is not None
        state = ChannelState(bound, floor, scale)
        if schedule is not None:
            state = ChannelState(bound, floor, scale, schedule.log_bandwidth.clone(), schedule.share.clone())
        if running is None or not (self.training and torch.compiler.is_compiling()):
            return state
        kept = iter(snapshot([one for one in state if one is not None]))
        return ChannelState(*(None if one is None else next(kept) for one in state))

    def _settings(self, batch: Batch, *, robust: bool, updated: bool) -> Settings:
        running = self._running()[0] if robust else self.residual_scale
        fresh = not (updated or running is None or torch.compiler.is_compiling())
        if fresh and running is not None and running.batches.device.type == "cpu" and not is_transformed(running.batches):
            fresh = bool((running.batches == 0).any())
        state = self._state(batch if fresh else None, robust=robust)
        return Settings(self.fixed_kappa, self.fixed_d, state, self._follows, self.normalize, self.reduction)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> MKCLoss:
        """Parameters and buffers stay in float32 at least: half would round them, or overflow."""

        def keep(t: Tensor) -> Tensor:
            out = fn(t)
            return t.to(out.device) if out.dtype in (torch.float16, torch.bfloat16) else out

        super()._apply(keep, recurse)  # type: ignore[no-untyped-call]
        return self

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        if self._follows and prefix + "fixed_bound" in state_dict and prefix + "residual_scale.recent" not in state_dict:
            self._freeze_as(state_dict, prefix)
        translate(
            state_dict,
            prefix,
            learns_kappa=self.raw_kappa is not None,
            learns_d=self.raw_d is not None,
            follows=self._follows,
            robust=self.residual_scale is not None,
        )
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def _freeze_as(self, state_dict: dict[str, Any], prefix: str) -> None:
        """Become a loss of given numbers, which a state_dict of a frozen loss is loaded into."""
        like = self.residual_scale.log_scale if self.residual_scale is not None else torch.zeros(self.num_channels)
        self._follows, self.residual_scale, self.schedule = False, None, None
        self.fixed_bound, self.fixed_d_min = torch.ones_like(like), torch.full_like(like, DEFAULT_D_MIN_IN_D)
        self.fixed_d = torch.full_like(like, 0.1) if self.raw_d is None else None

    def log_normalizer(self) -> Float[Tensor, " m"]:
        """``log(d Z)`` of each channel: what the negative log-likelihood adds to the energy."""
        d, bound = self.d, self.bound
        return torch.log(d) + log_partition(self.kappa, bound / d)

    def param_groups(self, *, lr: float = DEFAULT_LEARNING_RATE, **options: Any) -> list[dict[str, Any]]:
        """Optimiser groups of the learned σ and d, without weight decay, which would pull them to arbitrary values.

        Args:
            lr: their learning rate, for Adam and its like; the rate of the network, which may be anything, is not theirs.
            options: further options of the group.

        Example:
            >>> model, loss = torch.nn.Linear(3, 2), MKCLoss(2)
            >>> groups = [{"params": model.parameters()}, *loss.param_groups()]
            >>> optimiser = torch.optim.AdamW(groups, weight_decay=0.1)
        """
        parameters = [p for p in (self.raw_kappa, self.raw_d) if p is not None]
        return [{"params": parameters, "weight_decay": 0.0, "lr": lr, **options}] if parameters else []

    def forward(
        self,
        input: Float[Tensor, "*shape"],
        target: Float[Tensor, "*shape"],
        weight: Float[Tensor, "*shape"] | Bool[Tensor, "*shape"] | None = None,
    ) -> Tensor:
        """The loss of predictions against targets.

        Args:
            input: predictions, any shape whose ``channel_dim`` has size m.
            target: targets of the same shape; nothing is broadcast.
            weight: non-negative weights, or a boolean mask that is True where an element counts; of the shape of the
                input, of size 1 where it is the same, or that shape without the channel dimension. What an element of
                weight 0 or False holds, NaN included, reaches neither the value nor a gradient.

        Returns:
            A scalar, or for reduction "none" the shape of the input with 0 where masked; float32 at least. The mean is
            the weighted mean over elements, and 0 if no element counts.

        Raises:
            TypeError: integer or complex input or target, or what is no tensor.
            ValueError: shapes differ, are empty, or have another number of channels; a weight is negative, NaN or
                infinite; an input or a target that counts is NaN or infinite. For the last two the loss does not wait
                for an accelerator, nor are they seen in compiled code or under vmap: there a NaN comes out as NaN, as
                for predictions of float16, so that a gradient scaler sees an overflow. The running scale leaves out
                what is not finite.
        """
        if runs_kernels(self, input):
            from mkc_torch.losses.kernels.loss import kernel_loss

            return kernel_loss(self, input, target, weight)
        if self.impl == "compile" and not torch.compiler.is_compiling():
            return _compiled()(self, input, target, weight)
        return self._computed(input, target, weight)

    def _computed(self, input: Tensor, target: Tensor, weight: Tensor | None) -> Tensor:
        batch = self._batch(input, target, weight)
        updated = self._update(batch)
        settings = self._settings(batch, robust=self.training and self._running()[1] is not None, updated=updated)
        compiling = torch.compiler.is_compiling()
        plain = not compiling and not any(is_transformed(one) for one in self._differentiated(batch))
        if not plain or self.reduction == "none" or (batch.weight is not None and batch.weight.requires_grad):
            return loss_value(batch, self.raw_kappa, self.raw_d, settings)
        return fused_loss(batch, self.raw_kappa, self.raw_d, settings)

    def terms(
        self,
        input: Float[Tensor, "*shape"],
        target: Float[Tensor, "*shape"],
        weight: Float[Tensor, "*shape"] | Bool[Tensor, "*shape"] | None = None,
    ) -> LossTerms:
        """The two terms of the robust objective at the present state, which is not changed.

        ``network`` has a gradient by input and target alone, ``density`` by σ and d alone. A scheduler or early
        stopping watches ``network`` once the schedule has ended, or the value in evaluation. Under the likelihood
        ``network`` is 0 and ``density`` the likelihood, with all gradients.

        Args:
            input, target, weight: as in :meth:`forward`.

        Example:
            >>> loss = MKCLoss(1)
            >>> x, y = torch.randn(2, 50, 1, generator=torch.Generator().manual_seed(0))
            >>> value = loss(x, y)
            >>> network, density = loss.terms(x, y)
            >>> bool(torch.isclose(network + density, value))
            True
        """
        batch = self._batch(input, target, weight)
        settings = self._settings(batch, robust=self._running()[1] is not None, updated=False)
        return loss_terms(batch, self.raw_kappa, self.raw_d, settings)

    def _differentiated(self, batch: Batch) -> list[Tensor]:
        given = (batch.input, batch.target, batch.weight, self.raw_kappa, self.raw_d)
        return [one for one in given if one is not None]

    def _batch(self, input: Tensor, target: Tensor, weight: Tensor | None) -> Batch:
        """The batch, checked, in the dtype of the computation."""
        axis = self._checked_axis(input, target)
        dtype = torch.promote_types(torch.promote_types(input.dtype, target.dtype), self._dtype)
        prediction, wanted, counts = input.to(dtype), target.to(dtype), None
        error = None
        if weight is not None:
            weight, counts = checked_weight(weight, prediction, axis)
            error = torch.where(counts, prediction - wanted, 0.0)
        advice = "" if self.schedule is None else _SEVERAL_CALLS
        # an overflow of half precision is the gradient scaler's to see
        overflows = input.dtype == torch.float16
        refuse_bad_batch(None if overflows else prediction, wanted, counts, None if overflows else error, advice)
        return Batch(prediction, wanted, weight, counts, axis)

    def _update(self, batch: Batch) -> bool:
        """Take the batch into the running state, in training; whether it was."""
        scale, schedule = self._running()
        if scale is None or not self.training:
            return False
        if not torch.compiler.is_compiling():
            # transforms of functions have no state; activation checkpointing calls a second time, in the backward pass
            if any(is_transformed(one) for one in batch[:3] if isinstance(one, Tensor)) or in_backward():
                return False
        scale.update(batch.input, batch.target, batch.weight, batch.axis)
        if schedule is not None:
            schedule.update(scale)
        return True

    def _checked_axis(self, input: Tensor, target: Tensor) -> int:
        refuse_other_shapes(input, target)
        axis = checked_axis(input, self.channel_dim)
        m = self.num_channels
        if input.shape[axis] != m:
            mend = "; give each sample a dimension for its channel, unsqueeze(-1)" if m == 1 else ""
            if input.dim() > 2 and input.shape[1] == m:
                mend = "; give the loss `channel_dim=1` where the channels are the second dimension, (N, C, ...)"
            raise ValueError(
                f"Expected {m} channels in dimension {self.channel_dim} but got {tuple(input.shape)}{mend}."
            )
        if not self._named_dim and input.dim() > 3 and input.shape[1] == m:
            raise ValueError(
                f"Expected argument `channel_dim` to be named for an input of shape {tuple(input.shape)}, whose second "
                f"and last dimension both have size {m}: 1 for (N, C, ...), -1 for channels last."
            )
        return axis

    def __repr__(self) -> str:
        learned = [n for n, p in (("sigma", self.raw_kappa), ("d", self.raw_d)) if p is not None]
        with torch.no_grad():
            sigma, d, bound = (shortly(values) for values in (self.sigma, self.d, self.bound))
        if self._follows:
            d, bound = f"auto: {d}", bound if self.fixed_bound is not None else f"auto: {bound}"
        return (
            f"MKCLoss({self.num_channels}, sigma={sigma}, d={d}, bound={bound}, objective={self.objective!r}, learns={learned}, "
            f"normalize={self.normalize}, channel_dim={self.channel_dim}, reduction={self.reduction!r})"
        )


_SEVERAL_CALLS = "An optimiser that calls the loss several times a step, such as L-BFGS, needs loss.freeze_scale() first"


@functools.cache
def _compiled() -> Callable[..., Tensor]:
    return torch.compile(MKCLoss._computed)


def _is_auto(value: object) -> bool:
    return isinstance(value, str) and value == "auto"


def checked_loss(loss: nn.Module) -> MKCLoss:
    """The MKCLoss itself, taken out of a compiled one."""
    own = getattr(loss, "_orig_mod", loss)
    if not isinstance(own, MKCLoss):
        got = told(loss) if isinstance(loss, type) else type(loss).__name__
        raise TypeError(
            f"Expected argument `loss` to be an MKCLoss but got {got}; pass the loss that is trained with. "
            "MKCDistribution and mkc_torch.functional take σ and d of each sample."
        )
    return own

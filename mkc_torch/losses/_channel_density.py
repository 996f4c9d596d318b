"""Parameters and running state of a loss: σ and d of each channel, learned, fixed or taken from residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor, nn

from mkc_torch._support.arguments import as_numbers
from mkc_torch._support.initial_values import InitialValues, has_values, initial_numbers
from mkc_torch.density.energy import KAPPA_MAX, as_computed, inverse_square
from mkc_torch.density.normalizer import log_partition
from mkc_torch.losses._parameters import ChannelState, logistic, to_d
from mkc_torch.losses._snapshot import snapshot
from mkc_torch.losses._state_dict import logit_of_kappa, logit_of_scale, translate
from mkc_torch.losses._terms import Batch
from mkc_torch.losses._training_watch import TrainingWatch
from mkc_torch.losses.bandwidth_schedule import BandwidthSchedule
from mkc_torch.losses.residual_scale import FLOOR_IN_SCALE, SCALES_IN_BOUND, ResidualScale

if TYPE_CHECKING:
    from jaxtyping import Float

Objective = Literal["robust", "likelihood"]

DEFAULT_BOUND_IN_D = 100.0
"""Default half-width of the domain, in units of the initial d."""

DEFAULT_D_MIN_IN_D = 1e-3
"""Default floor of d, in units of the initial d."""

DEFAULT_LEARNING_RATE = 1e-2
"""Default learning rate of σ and d in :meth:`ChannelDensity.param_groups`."""


class ChannelDensity(InitialValues):
    """Density of each channel: parameters and running state of a loss, without its computation.

    Args:
        num_channels: m.
        sigma, d, bound, d_min, learn_sigma, learn_d: as for :class:`mkc_torch.MKCLoss`.
        robust: whether a :class:`BandwidthSchedule` trains the network.
    """

    num_channels: int
    fixed_bound: Tensor | None
    fixed_d_min: Tensor | None
    fixed_kappa: Tensor | None
    fixed_d: Tensor | None
    raw_kappa: nn.Parameter | None
    raw_d: nn.Parameter | None
    residual_scale: ResidualScale | None
    schedule: BandwidthSchedule | None

    def __init__(
        self,
        num_channels: int,
        *,
        sigma: float | Float[Tensor, " m"],
        d: float | Float[Tensor, " m"] | Literal["auto"],
        bound: float | Float[Tensor, " m"] | Literal["auto"] | None,
        d_min: float | Float[Tensor, " m"] | None,
        learn_sigma: bool,
        learn_d: bool,
        robust: bool,
    ) -> None:
        super().__init__()
        self.num_channels = num_channels
        self._follows = follows = is_auto(d)
        self._running_at_start = (follows, robust)
        self._add_running_state()
        self._watch = TrainingWatch()
        self.__dict__["_guide"] = None  # not saved in the state_dict
        kappa = inverse_square(self._sigma_in_range(sigma))
        own_bound = not (bound is None or is_auto(bound))
        self._bound_was_given = own_bound or not follows
        d = initial_numbers("d", 1.0).expand(num_channels) if is_auto(d) else self._per_channel("d", d, low=0.0)
        half_width = self._per_channel("bound", bound, low=0.0) if own_bound else DEFAULT_BOUND_IN_D * d
        floor = DEFAULT_D_MIN_IN_D * d if d_min is None else self._per_channel("d_min", d_min, low=0.0)
        if not follows and has_values(half_width, d) and not bool((half_width > d).all()):
            raise ValueError(f"Expected argument `bound` to exceed `d` but got {half_width.tolist()} and {d.tolist()}.")
        if not follows and learn_d and has_values(floor, d) and not bool((floor < d).all()):
            raise ValueError(f"Expected argument `d_min` below `d` but got {floor.tolist()} and {d.tolist()}.")
        self._register("fixed_bound", half_width if own_bound or not follows else None)
        self._register("fixed_d_min", floor if d_min is not None or not follows else None)
        self._register("fixed_kappa", None if learn_sigma else kappa)
        self._register("fixed_d", None if learn_d or follows else d)
        raw_d = torch.zeros_like(d) if follows else logit_of_scale(d, floor, half_width)
        self._register("raw_kappa", _raw_kappa(kappa) if learn_sigma else None, learned=True)
        self._register("raw_d", raw_d if learn_d else None, learned=True)

    def _add_running_state(self) -> None:
        follows, robust = self._running_at_start
        self.residual_scale = ResidualScale(self.num_channels) if follows or robust else None
        self.schedule = BandwidthSchedule(self.num_channels) if robust else None

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Set σ, d, the running scale and the schedule to their initial values, for a new fit or after ``to_empty``.

        The parameters stay the same objects. A loss that :meth:`freeze_scale` or a loaded state_dict has frozen takes d
        and bound from the residuals again, as it was constructed.

        Raises:
            ValueError: an initial value was given as a tensor of the meta device, which has no values.

        Example:
            >>> from mkc_torch import MKCLoss
            >>> loss = MKCLoss(1)
            >>> for fold in range(5):
            ...     loss.reset_parameters()
            ...     _ = loss(torch.randn(20, 1), torch.zeros(20, 1))
            >>> loss.residual_scale.batches
            tensor([1])
        """
        follows, robust = self._running_at_start
        if self._follows != follows or (self.residual_scale is None and (follows or robust)):
            for name in ("fixed_bound", "fixed_d_min", "fixed_d"):
                if name not in self._initial:
                    setattr(self, name, None)
            self._follows = follows
            self._add_running_state()
            own = self.raw_kappa if self.fixed_kappa is None else self.fixed_kappa
            assert own is not None
            for module in self.children():
                module.to(own)
        super().reset_parameters()
        self._watch = TrainingWatch()
        for module in self.children():
            module.reset_parameters()  # type: ignore[operator]

    def _per_channel(self, name: str, value: object, *, low: float) -> Tensor:
        if isinstance(value, str) and name in ("d", "bound"):
            raise TypeError(
                f"Expected argument `{name}` to be a number, a tensor of numbers or 'auto' but got {value!r}."
            )
        (t,) = as_computed(initial_numbers(name, value).detach())
        if t.dim() > 1 or (t.dim() == 1 and t.shape[0] not in (1, self.num_channels)):
            raise ValueError(
                f"Expected argument `{name}` to be a number or of shape ({self.num_channels},) but got "
                f"{tuple(t.shape)}; pass one number for each channel, or a single number for all."
            )
        if has_values(t) and not bool(((t > low) & torch.isfinite(t)).all()):
            raise ValueError(
                f"Expected argument `{name}` to be positive and finite but got {value}; its unit is that of the target."
            )
        return t.expand(self.num_channels).clone()

    def _sigma_in_range(self, value: float | Tensor) -> Tensor:
        (t,) = as_computed(initial_numbers("sigma", value).detach())
        least = KAPPA_MAX**-0.5
        if has_values(t) and not bool((t >= least).all()):
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
            self.raw_kappa.copy_(_raw_kappa(kappa))
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
        """The loss that trains the network: "robust" or "likelihood"."""
        return "likelihood" if self.schedule is None else "robust"

    @property
    def bound(self) -> Float[Tensor, " m"]:
        """Half-width of the domain of the errors, in the unit of the target."""
        return self._state().bound

    @property
    def d_min(self) -> Float[Tensor, " m"]:
        """Floor of d, in the unit of the target."""
        return self._state().floor

    @property
    def d(self) -> Float[Tensor, " m"]:
        """Scales in the unit of the target; assign a number or (m,) in (d_min, bound) to set a given d."""
        if not self._follows and self.raw_d is None:
            assert self.fixed_d is not None
            return self.fixed_d
        return to_d(self.raw_d, self._state(), follows=self._follows)

    @d.setter
    def d(self, value: float | Tensor) -> None:
        if self._follows:
            raise ValueError(
                f"Expected a loss with a given `d` but got d={value} for a loss that takes d from the residuals; "
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
        given = (*self._parameters.values(), *self._buffers.values())
        wide = any(value is not None and value.dtype == torch.float64 for value in given)
        return torch.float64 if wide else torch.float32

    @torch.no_grad()
    def freeze_scale(self) -> None:
        """Fix d and bound at their current values and make the likelihood the objective.

        Needed for optimisers that require the same function at every call, such as L-BFGS, and to compare likelihoods.

        Example:
            >>> from mkc_torch import MKCLoss
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
        """Train the network by an external schedule, as with ``objective="robust"``; None and None end it.

        For trainers that own σ and d. The loss stays the likelihood of given numbers, and its ``state_dict`` does not
        contain the schedule. In training the network learns by the likelihood's energy at a bandwidth no wider than the
        selected bandwidth.
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
        """Copies of the buffers for a forward pass, because the next batch changes the buffers.

        With a batch, channels without a batch so far take their scale from it.
        """
        running, schedule = self._running() if robust else (self.residual_scale, None)
        bound, floor, scale = self.fixed_bound, self.fixed_d_min, None
        if running is not None:
            log_scale, half_range = running.log_scale, running.half_range
            if batch is not None:
                weight = batch.weight
                _, log_scale, half_range = running.with_batch(batch.input, batch.target, weight, batch.axis)
            scale = log_scale.exp()
            bound = torch.maximum(half_range, SCALES_IN_BOUND * scale) if bound is None else bound
            floor = FLOOR_IN_SCALE * scale if floor is None else floor
        assert bound is not None
        assert floor is not None
        state = ChannelState(bound, floor, scale)
        if schedule is not None:
            state = ChannelState(bound, floor, scale, schedule.log_bandwidth.clone(), schedule.share.clone())
        if running is None or not (self.training and torch.compiler.is_compiling()):
            return state
        kept = iter(snapshot([value for value in state if value is not None]))
        return ChannelState(*(None if value is None else next(kept) for value in state))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        frozen = all(prefix + name in state_dict for name in ("fixed_bound", "fixed_d_min"))
        if self._follows and frozen and prefix + "residual_scale.recent" not in state_dict:
            self._take_given_numbers()
        translate(
            state_dict,
            prefix,
            learns_kappa=self.raw_kappa is not None,
            learns_d=self.raw_d is not None,
            follows=self._follows,
            robust=self.residual_scale is not None,
        )
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def _take_given_numbers(self) -> None:
        """Turn into a loss with given d and bound, before the state_dict of a frozen loss is loaded."""
        like = self.residual_scale.log_scale if self.residual_scale is not None else torch.zeros(self.num_channels)
        self._follows, self.residual_scale, self.schedule = False, None, None
        self.fixed_bound, self.fixed_d_min = torch.ones_like(like), torch.full_like(like, DEFAULT_D_MIN_IN_D)
        self.fixed_d = torch.full_like(like, 0.1) if self.raw_d is None else None

    def log_normalizer(self) -> Float[Tensor, " m"]:
        """``log(d Z)`` of each channel, (m,): the difference of the negative log-likelihood and the energy."""
        d, bound = self.d, self.bound
        return torch.log(d) + log_partition(self.kappa, bound / d)

    def param_groups(self, *, lr: float = DEFAULT_LEARNING_RATE, **options: Any) -> list[dict[str, Any]]:
        """Optimiser groups of the learned σ and d, without weight decay, which would bias them.

        Args:
            lr: learning rate of σ and d for Adam and similar optimisers, independent of the network's.
            options: further options of the group.

        Example:
            >>> from mkc_torch import MKCLoss
            >>> model, loss = torch.nn.Linear(3, 2), MKCLoss(2)
            >>> groups = [{"params": model.parameters()}, *loss.param_groups()]
            >>> optimiser = torch.optim.AdamW(groups, weight_decay=0.1)
        """
        parameters = [p for p in (self.raw_kappa, self.raw_d) if p is not None]
        return [{"params": parameters, "weight_decay": 0.0, "lr": lr, **options}] if parameters else []


def _raw_kappa(kappa: Tensor) -> Tensor:
    if has_values(kappa) and bool((kappa == 0).any()):
        raise ValueError(
            "Expected a finite `sigma` with `learn_sigma=True` but got inf, where its gradient is 0; start large, for "
            "example at 10, or pass `learn_sigma=False`."
        )
    return logit_of_kappa(kappa)


def is_auto(value: object) -> bool:
    """Whether an argument is "auto": taken from the residuals."""
    return isinstance(value, str) and value == "auto"

"""The MKC likelihood as a loss module."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor, nn

from mkc_torch._support.arguments import as_numbers, refuse_bad_batch, told
from mkc_torch.density.energy import KAPPA_MAX, as_computed, energy, inverse_square
from mkc_torch.density.normalizer import log_partition
from mkc_torch.losses._checks import (
    Reduction,
    at_least_float32,
    checked_axis,
    checked_weight,
    refuse_no_dimension,
    refuse_other_reduction,
    refuse_other_shapes,
    shortly,
)
from mkc_torch.losses._curves import ChannelCurves
from mkc_torch.losses._energy_sums import energy_sums
from mkc_torch.losses._following import Followed, Following
from mkc_torch.losses._follows_residuals import FollowsResiduals
from mkc_torch.losses._logistic import logistic
from mkc_torch.losses._state_dict import logit_of_kappa, logit_of_scale, translate
from mkc_torch.losses._watch import Watch

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["DEFAULT_BOUND_IN_D", "DEFAULT_D_MIN_IN_D", "MKCLoss", "checked_loss"]

DEFAULT_BOUND_IN_D = 100.0
"""Half-width of the domain, in units of the initial d, where no bound is given."""

DEFAULT_D_MIN_IN_D = 1e-3
"""Floor under d, in units of the initial d, where none is given."""


class MKCLoss(FollowsResiduals, ChannelCurves, nn.Module):
    """Multi-kernel correntropy loss with a bandwidth σ and a scale d for each channel.

    With anything learned it is the negative log-likelihood of (17) of Li et al. (2023), ``energy + log_normalizer``;
    with σ and d fixed it is the paper's loss, ``energy = σ² (1 - exp(-e² / (2 d² σ²)))``, e being input less target.
    Learning un-normalised σ and d is refused: the energy alone is smallest at σ → 0 or d → ∞, whatever the data.

    Without a ``d`` the scales are taken from the residuals and follow them while the network learns, robustly and for
    each channel, so that targets of any unit and offset need no tuning. The value is then the same likelihood; the
    gradient by the input, in training, is that of a loss chosen for its robustness: at first one sharper than the
    absolute value, later Welsch's of the widest bandwidth at which the estimated risk, variance and shrinkage of the
    predictions, is within a tenth of the smallest. σ and d then describe the noise. With given numbers the gradient is
    the likelihood's own.

    Args:
        num_channels: m, the size of the channel dimension.
        sigma: initial or fixed bandwidths in [0.05, inf], a number or (m,). ``inf`` is the Gaussian; a σ that is to be
            learned must start finite, since its gradient is 0 at ``inf``.
        d: initial or fixed scales > 0 in the unit of the target, a number or (m,); "auto" takes them from the
            residuals of each forward pass in training, and ``learn_d`` is then a factor beside that.
        bound: half-width a of the domain of the errors, in the unit of the target, a number or (m,). "auto" means half
            the range of the residuals and no less than ten scales where ``d`` is "auto"; with a given d, as None, 100
            times that d, and it stays there while d is learned. The likelihood of σ depends on it: a physical bound
            is better, and likelihoods compare only at equal bounds. Errors beyond it keep a finite loss and gradient.
        learn_sigma: whether σ is a parameter.
        learn_d: whether d is a parameter; it stays in [d_min, bound].
        normalize: whether to add the log-normaliser; None does so if anything is learned.
        channel_dim: the dimension of the input that holds the channels, 1 for (N, C, H, W); None for the last. An input
            of four dimensions or more whose second and last both have size m is refused until one is named.
        reduction: "none", "mean" (over elements, weighted where weights are given) or "sum".
        d_min: floor under d, a number or (m,); None means a thousandth of the initial d, or of the spread of the first
            residuals. The likelihood of a network that interpolates its targets grows without limit as d → 0.

    Attributes:
        sigma, d: current values (m,), differentiable; assign to set them.
        bound, d_min: buffers (m,), saved in the state_dict.

    Raises:
        TypeError: an argument that is no number.
        ValueError: an argument out of range, or learning asked for with ``normalize=False``.

    Warns:
        UserWarning: once each, in training: a d near its floor, for the network may fit every point; a share of the
            errors beyond a given bound; σ and d that get gradients and that no optimiser moves.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (9) and (17).

    Example:
        >>> loss = MKCLoss(2, sigma=3.0, d=1.0, bound=50.0)
        >>> output = torch.zeros(4, 2, requires_grad=True)
        >>> value = loss(output, torch.tensor([[0.1, -0.2], [0.3, 0.0], [-0.1, 0.2], [0.0, 40.0]]))
        >>> value.backward()
        >>> bool(output.grad[3, 1].abs() < 1e-6)  # the outlier pulls at nothing
        True
    """

    bound: Tensor
    d_min: Tensor
    fixed_kappa: Tensor | None
    fixed_d: Tensor | None

    def __init__(
        self,
        num_channels: int,
        *,
        sigma: float | Float[Tensor, " m"] = 3.0,
        d: float | Float[Tensor, " m"] | Literal["auto"] = "auto",
        bound: float | Float[Tensor, " m"] | Literal["auto"] | None = "auto",
        learn_sigma: bool = True,
        learn_d: bool = True,
        normalize: bool | None = None,
        channel_dim: int | None = None,
        reduction: Reduction = "mean",
        d_min: float | Float[Tensor, " m"] | None = None,
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
        self._watch, self._has_begun, self._turned, self._passes = Watch(), False, False, 0
        self.num_channels = num_channels
        self.normalize = normalize
        self.channel_dim, self._named_dim = -1 if channel_dim is None else channel_dim, channel_dim is not None
        self.reduction = reduction
        kappa = inverse_square(self._sigma_in_range(sigma))
        followed, own_bound = _is_auto(d), not (bound is None or _is_auto(bound))
        self.following = Following(num_channels) if followed else None
        self.__dict__["_guide"] = None  # no part of the state_dict
        self._own_bound = own_bound or not followed
        self._own_floor = d_min is not None or not followed
        d = torch.ones(num_channels) if _is_auto(d) else self._per_channel("d", d, low=0.0)
        half_width = self._per_channel("bound", bound, low=0.0) if own_bound else DEFAULT_BOUND_IN_D * d
        floor = DEFAULT_D_MIN_IN_D * d if d_min is None else self._per_channel("d_min", d_min, low=0.0)
        if not followed and not bool((half_width > d).all()):
            raise ValueError(f"Expected argument `bound` to exceed `d` but got {half_width.tolist()} and {d.tolist()}.")
        if not followed and learn_d and not bool((floor < d).all()):
            raise ValueError(f"Expected argument `d_min` below `d` but got {floor.tolist()} and {d.tolist()}.")
        self.register_buffer("bound", half_width)
        self.register_buffer("d_min", floor)
        self.register_buffer("fixed_kappa", None if learn_sigma else kappa)
        self.register_buffer("fixed_d", None if learn_d or followed else d)
        self.raw_kappa = nn.Parameter(torch.empty_like(kappa)) if learn_sigma else None
        self.raw_d = nn.Parameter(torch.zeros_like(d)) if learn_d else None
        self._set_kappa(kappa)
        if not followed:
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
        self._set_kappa(inverse_square(self._sigma_in_range(as_numbers("sigma", value, self.bound.dtype))))

    @property
    def d(self) -> Float[Tensor, " m"]:
        """Scales in the unit of the target; assign a number or (m,) in (d_min, bound) to set them, where given."""
        if self.following is not None:
            return self._followed_d(self.following.state)
        if self.raw_d is None:
            assert self.fixed_d is not None
            return self.fixed_d
        return self.d_min + (self.bound - self.d_min) * logistic(self.raw_d)

    @d.setter
    def d(self, value: float | Tensor) -> None:
        if self.following is not None:
            raise ValueError(
                f"Expected a loss with a given `d` to set it but got one that takes d from the residuals, d={value}; "
                "make it with `d=` and `bound=`."
            )
        d = self._per_channel("d", as_numbers("d", value, self.bound.dtype), low=0.0).to(self.bound)
        if self.raw_d is not None and not bool(((d > self.d_min) & (d < self.bound)).all()):
            raise ValueError(
                f"Expected `d` between `d_min` {self.d_min.tolist()} and `bound` {self.bound.tolist()} but got {value}."
            )
        self._set_d(d)

    @torch.no_grad()
    def _set_d(self, d: Tensor) -> None:
        if self.raw_d is not None:
            self.raw_d.copy_(logit_of_scale(d, self.d_min, self.bound))
        elif self.fixed_d is not None:
            self.fixed_d.copy_(d)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> MKCLoss:
        """Parameters and bounds stay in float32 at least: half would round them, or overflow."""

        def keep(t: Tensor) -> Tensor:
            out = fn(t)
            return t.to(out.device) if out.dtype in (torch.float16, torch.bfloat16) else out

        super()._apply(keep, recurse)  # type: ignore[no-untyped-call]
        return self

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        translate(
            state_dict,
            prefix,
            learns_kappa=self.raw_kappa is not None,
            learns_d=self.raw_d is not None,
            follows=self.following is not None,
        )
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def log_normalizer(self) -> Float[Tensor, " m"]:
        """``log(d Z)`` of each channel: what the negative log-likelihood adds to the energy."""
        return self._log_normalizer(self.kappa, self.d, self.bound)

    @staticmethod
    def _log_normalizer(kappa: Tensor, d: Tensor, bound: Tensor) -> Float[Tensor, " m"]:
        if not kappa.dtype == d.dtype == bound.dtype:
            kappa, d, bound = as_computed(kappa, d, bound)
        return torch.log(d) + log_partition(kappa, bound / d)

    def param_groups(self, **options: Any) -> list[dict[str, Any]]:
        """Optimiser groups of the learned σ and d, without weight decay, which would pull them to arbitrary values.

        Args:
            options: further options of the group, ``lr=1e-2`` say.

        Example:
            >>> model, loss = torch.nn.Linear(3, 2), MKCLoss(2)
            >>> groups = [{"params": model.parameters()}, *loss.param_groups(lr=1e-2)]
            >>> optimiser = torch.optim.AdamW(groups, weight_decay=0.1)
        """
        parameters = [p for p in (self.raw_kappa, self.raw_d) if p is not None]
        return [{"params": parameters, "weight_decay": 0.0, **options}] if parameters else []

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
                for an accelerator, nor are they seen in compiled code or under vmap: there a NaN comes out as NaN.
        """
        axis = self._checked_axis(input, target)
        dtype = torch.promote_types(at_least_float32(input), at_least_float32(target))
        input, wanted = input.to(dtype), target.to(dtype)
        error: Tensor | None = None  # of a whole batch laid out only where it is needed
        if weight is not None:
            weight, counts = checked_weight(weight, input, axis)
            error = torch.where(counts, input - wanted, 0.0)
        refuse_bad_batch(input, wanted, None if weight is None else counts, error)
        if not torch.compiler.is_compiling():
            self._look(input, wanted, error, axis)
        kappa, d, bound = self.kappa, self.d, self.bound
        pull: Tensor | None = None
        steered: Followed | None = None
        learning = self.training and torch.is_grad_enabled()
        if self.following is not None:
            state = self._state(input, wanted, error, weight, axis)
            d, bound = self._followed_d(state), self._domain(state)[0]
            steered = state if learning and self.raw_kappa is not None else None
        elif learning:
            steered = self._guided(input, wanted, error, weight, axis)
        if steered is not None:
            first, second = (input, wanted) if error is None else (error, None)
            pull = self._pull(first, second, None if weight is None else weight.detach(), axis, steered)
            input, wanted, error = input.detach(), wanted.detach(), None if error is None else error.detach()
        norm = self._log_normalizer(kappa, d, bound).to(dtype) if self.normalize else None
        kappa, d = (p.to(torch.promote_types(p.dtype, dtype)) for p in (kappa, d))
        if self.reduction == "none":
            shape = [1] * input.dim()
            shape[axis] = self.num_channels
            error = input - wanted if error is None else error
            loss = energy(error / d.view(shape), kappa.view(shape))
            if norm is not None:
                loss = loss + norm.view(shape)
            loss = loss if pull is None else loss + (pull - pull.detach())
            return loss if weight is None else weight * loss
        if error is None:
            total = energy_sums(input.to(kappa.dtype), kappa, d, None, axis, target=wanted.to(kappa.dtype)).sum()
        else:
            total = energy_sums(error.to(kappa.dtype), kappa, d, weight, axis).sum()
        total = total if pull is None else total + (pull - pull.detach())
        elements = input.numel() if weight is None else weight.sum()
        if norm is not None:
            if weight is None:
                total = total + norm.sum() * (elements / self.num_channels)
            else:
                others = [i for i in range(input.dim()) if i != axis]
                total = total + (norm * (weight.sum(others) if others else weight)).sum()
        if self.reduction == "sum":
            return total
        if isinstance(elements, Tensor):
            return total / torch.where(elements > 0, elements, 1.0)
        return total / elements

    def _look(self, input: Tensor, wanted: Tensor, error: Tensor | None, axis: int) -> None:
        if not self.training or not torch.is_grad_enabled() or not self._watch.is_due():
            return
        try:
            self._watch.optimiser((self.raw_kappa, self.raw_d))
            if self.raw_d is not None:
                self._watch.floor(self.d.detach(), self.d_min)
            if self.following is None or self._own_bound:
                self._watch.bound(input - wanted if error is None else error, self.bound, axis)
            if self.following is not None:
                self._turned = bool((self.following.turned >= 1.0).all())
        except RuntimeError:  # under vmap there is no one value
            return

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
        if self.following is not None:
            d, bound = f"auto: {d}", bound if self._own_bound else f"auto: {bound}"
        return (
            f"MKCLoss({self.num_channels}, sigma={sigma}, d={d}, bound={bound}, learns={learned}, "
            f"normalize={self.normalize}, channel_dim={self.channel_dim}, reduction={self.reduction!r})"
        )


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

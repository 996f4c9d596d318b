"""The MKC likelihood as a loss module."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from mkc_torch._support.arguments import as_numbers, refuse_bad_batch, refuse_bad_weight, told
from mkc_torch.density.energy import KAPPA_MAX, as_computed, energy, inverse_square
from mkc_torch.density.normalizer import log_partition
from mkc_torch.losses._checks import (
    Reduction,
    at_least_float32,
    checked_axis,
    refuse_no_dimension,
    refuse_other_reduction,
    refuse_other_shapes,
)
from mkc_torch.losses._energy_sums import energy_sums

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["DEFAULT_BOUND_IN_D", "DEFAULT_D_MIN_IN_D", "NEAR_FLOOR", "WATCH_EVERY", "MKCLoss", "checked_loss"]

DEFAULT_BOUND_IN_D = 100.0
"""Half-width of the domain, in units of the initial d, where no bound is given."""

DEFAULT_D_MIN_IN_D = 1e-3
"""Floor under d, in units of the initial d, where none is given."""


WATCH_EVERY = 64
"""Forward passes in training after which a scale near its floor is looked for; a look waits for an accelerator."""

NEAR_FLOOR = 2.0
"""Times the floor below which a scale counts as collapsed."""


class MKCLoss(nn.Module):
    """Multi-kernel correntropy loss with a bandwidth σ and a scale d for each channel.

    With anything learned it is the negative log-likelihood of (17) of Li et al. (2023), ``energy + log_normalizer``;
    with σ and d fixed it is the paper's loss, ``energy = σ² (1 - exp(-e² / (2 d² σ²)))``, e being input less target.
    Learning un-normalised σ and d is refused: the energy alone is smallest at σ → 0 or d → ∞, whatever the data.

    Args:
        num_channels: m, the size of the channel dimension.
        sigma: initial or fixed bandwidths in [0.05, inf], a number or (m,). ``inf`` is the Gaussian; a σ that is to be
            learned must start finite, since its gradient is 0 at ``inf``.
        d: initial or fixed scales > 0 in the unit of the target, a number or (m,).
        bound: half-width a of the domain of the errors, in the unit of the target, a number or (m,). None means 100
            times the initial d and stays there while d is learned. The likelihood of σ depends on it: a physical bound
            is better, and likelihoods compare only at equal bounds. Errors beyond it keep a finite loss and gradient.
        learn_sigma: whether σ is a parameter.
        learn_d: whether d is a parameter; it stays in [d_min, bound].
        normalize: whether to add the log-normaliser; None does so if anything is learned.
        channel_dim: the dimension of the input that holds the channels.
        reduction: "none", "mean" (over elements, weighted where weights are given) or "sum".
        d_min: floor under d, a number or (m,); None means a thousandth of the initial d. The likelihood of a network
            that interpolates its targets grows without limit as d → 0.

    Attributes:
        sigma, d: current values (m,), differentiable; assign to set them.
        bound, d_min: buffers (m,), saved in the state_dict.

    Raises:
        TypeError: an argument that is no number.
        ValueError: an argument out of range, or learning asked for with ``normalize=False``.

    Warns:
        UserWarning: once, when a learned d has come near its floor in training: the network may fit every point.

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
        d: float | Float[Tensor, " m"] = 1.0,
        bound: float | Float[Tensor, " m"] | None = None,
        learn_sigma: bool = True,
        learn_d: bool = True,
        normalize: bool | None = None,
        channel_dim: int = -1,
        reduction: Reduction = "mean",
        d_min: float | Float[Tensor, " m"] | None = None,
    ) -> None:
        super().__init__()
        if isinstance(num_channels, bool) or not isinstance(num_channels, int) or num_channels < 1:
            raise ValueError(f"Expected argument `num_channels` to be a positive integer but got {num_channels!r}.")
        refuse_other_reduction(reduction)
        refuse_no_dimension(channel_dim)
        learned = learn_sigma or learn_d
        if normalize is None:
            normalize = learned
        if learned and not normalize:
            raise ValueError(
                "Expected `learn_sigma=False, learn_d=False` with `normalize=False`: without the normaliser the loss "
                "is smallest at sigma -> 0 or d -> inf, whatever the data. Drop `normalize=False` to learn them."
            )
        self._forwards, self._told_of_floor = 0, False
        self.num_channels = num_channels
        self.normalize = normalize
        self.channel_dim = channel_dim
        self.reduction = reduction
        d = self._per_channel("d", d, low=0.0)
        kappa = inverse_square(self._sigma_in_range(sigma))
        half_width = DEFAULT_BOUND_IN_D * d if bound is None else self._per_channel("bound", bound, low=0.0)
        floor = DEFAULT_D_MIN_IN_D * d if d_min is None else self._per_channel("d_min", d_min, low=0.0)
        if not bool((half_width > d).all()):
            raise ValueError(f"Expected argument `bound` to exceed `d` but got {half_width.tolist()} and {d.tolist()}.")
        if learn_d and not bool((floor < d).all()):
            raise ValueError(f"Expected argument `d_min` below `d` but got {floor.tolist()} and {d.tolist()}.")
        self.register_buffer("bound", half_width)
        self.register_buffer("d_min", floor)
        self.register_buffer("fixed_kappa", None if learn_sigma else kappa)
        self.register_buffer("fixed_d", None if learn_d else d)
        self.raw_kappa = nn.Parameter(torch.empty_like(kappa)) if learn_sigma else None
        self.raw_d = nn.Parameter(torch.empty_like(d)) if learn_d else None
        self._set_kappa(kappa)
        self._set_d(d)

    def _per_channel(self, name: str, value: float | Tensor, *, low: float) -> Tensor:
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
        return KAPPA_MAX * torch.sigmoid(self.raw_kappa)

    @torch.no_grad()
    def _set_kappa(self, kappa: Tensor) -> None:
        if self.raw_kappa is not None:
            if bool((kappa == 0).any()):
                raise ValueError(
                    "Expected a finite `sigma` with `learn_sigma=True` but got inf, where its gradient is 0; "
                    "start large, at 10 say, or pass `learn_sigma=False`."
                )
            # a hair inside the range, where the gradient is not 0
            self.raw_kappa.copy_(torch.logit((kappa.double() / KAPPA_MAX).clamp(max=1.0 - 1e-6)))
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
        """Scales in the unit of the target; assign a number or (m,) in (d_min, bound) to set them."""
        if self.raw_d is None:
            assert self.fixed_d is not None
            return self.fixed_d
        return self.d_min + (self.bound - self.d_min) * torch.sigmoid(self.raw_d)

    @d.setter
    def d(self, value: float | Tensor) -> None:
        d = self._per_channel("d", as_numbers("d", value, self.bound.dtype), low=0.0).to(self.bound)
        if self.raw_d is not None and not bool(((d > self.d_min) & (d < self.bound)).all()):
            raise ValueError(
                f"Expected `d` between `d_min` {self.d_min.tolist()} and `bound` {self.bound.tolist()} but got {value}."
            )
        self._set_d(d)

    @torch.no_grad()
    def _set_d(self, d: Tensor) -> None:
        if self.raw_d is not None:
            low, high = self.d_min.double(), self.bound.double()
            self.raw_d.copy_(torch.logit((d.double() - low) / (high - low)))
        elif self.fixed_d is not None:
            self.fixed_d.copy_(d)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> MKCLoss:
        """Parameters and bounds stay in float32 at least: half would round them, or overflow."""

        def keep(t: Tensor) -> Tensor:
            out = fn(t)
            return t.to(out.device) if out.dtype in (torch.float16, torch.bfloat16) else out

        super()._apply(keep, recurse)  # type: ignore[no-untyped-call]
        return self

    def log_normalizer(self) -> Float[Tensor, " m"]:
        """``log(d Z)`` of each channel: what the negative log-likelihood adds to the energy."""
        return self._log_normalizer(self.kappa, self.d)

    def _log_normalizer(self, kappa: Tensor, d: Tensor) -> Float[Tensor, " m"]:
        bound = self.bound
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
                input, or that shape without the channel dimension. What an element of weight 0 or False holds, NaN
                included, reaches neither the value nor a gradient.

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
        if not torch.compiler.is_compiling():
            self._watch_scale()
        dtype = torch.promote_types(at_least_float32(input), at_least_float32(target))
        input, wanted = input.to(dtype), target.to(dtype)
        error: Tensor | None = None  # of a whole batch laid out only where it is needed
        if weight is not None:
            weight, counts = self._checked_weight(weight, input, axis)
            error = torch.where(counts, input - wanted, 0.0)
        refuse_bad_batch(input, wanted, None if weight is None else counts, error)
        kappa, d = self.kappa, self.d
        norm = self._log_normalizer(kappa, d).to(dtype) if self.normalize else None
        kappa, d = (p.to(torch.promote_types(p.dtype, dtype)) for p in (kappa, d))
        if self.reduction == "none":
            shape = [1] * input.dim()
            shape[axis] = self.num_channels
            error = input - wanted if error is None else error
            loss = energy(error / d.view(shape), kappa.view(shape))
            if norm is not None:
                loss = loss + norm.view(shape)
            return loss if weight is None else weight * loss
        if error is None:
            total = energy_sums(input.to(kappa.dtype), kappa, d, None, axis, target=wanted.to(kappa.dtype)).sum()
        else:
            total = energy_sums(error.to(kappa.dtype), kappa, d, weight, axis).sum()
        elements = float(input.numel()) if weight is None else weight.sum()
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

    def _watch_scale(self) -> None:
        if self.raw_d is None or not self.training or self._told_of_floor or not torch.is_grad_enabled():
            return
        self._forwards += 1
        if self._forwards % WATCH_EVERY:
            return
        with torch.no_grad():
            near = self.d < NEAR_FLOOR * self.d_min
        try:
            channels = near.nonzero().flatten().tolist()
        except RuntimeError:  # under vmap there is no one value
            return
        if channels:
            self._told_of_floor = True
            scales, floors = self.d.detach()[channels].tolist(), self.d_min[channels].tolist()
            warnings.warn(
                f"The scale d of channel {', '.join(map(str, channels))} fell to {scales}, next to its floor {floors}. "
                "The network may fit every point, noise included, and the likelihood grows without limit as d -> 0: "
                "watch a validation set, regularise, or raise `d_min` to the precision of the targets. If the targets "
                "are that precise, start with a smaller `d`.",
                stacklevel=3,
            )

    def _checked_axis(self, input: Tensor, target: Tensor) -> int:
        refuse_other_shapes(input, target)
        axis = checked_axis(input, self.channel_dim)
        if input.shape[axis] != self.num_channels:
            mend = "; give each sample a dimension for its channel, unsqueeze(-1)" if self.num_channels == 1 else ""
            raise ValueError(
                f"Expected {self.num_channels} channels in dimension {self.channel_dim} but got {tuple(input.shape)}"
                f"{mend}."
            )
        return axis

    @staticmethod
    def _checked_weight(weight: Tensor, input: Tensor, axis: int) -> tuple[Tensor, Tensor]:
        refuse_bad_weight(weight)
        samples = input.shape[:axis] + input.shape[axis + 1 :]
        if weight.shape == samples and weight.shape != input.shape:
            weight = weight.unsqueeze(axis)
        elif weight.shape != input.shape:
            raise ValueError(
                f"Expected argument `weight` of shape {tuple(input.shape)} or {tuple(samples)} "
                f"but got {tuple(weight.shape)}."
            )
        weight = weight.expand(input.shape)
        counts = weight if weight.dtype == torch.bool else weight != 0
        return weight.to(input.dtype), counts

    def extra_repr(self) -> str:
        learned = [n for n, p in (("sigma", self.raw_kappa), ("d", self.raw_d)) if p is not None]
        return (
            f"{self.num_channels}, learns={learned}, normalize={self.normalize}, channel_dim={self.channel_dim}, "
            f"reduction={self.reduction!r}"
        )


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

"""MKC likelihood with σ and d of each sample, and the output layers of a network that predict them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from mkc_torch._support.arguments import checked_whole, first_of, refuse_bad_batch, refuse_not_real
from mkc_torch._support.initial_values import InitialValues, has_values, initial_numbers, set_values
from mkc_torch.density.energy import KAPPA_MAX, energy, inverse_square
from mkc_torch.density.normalizer import log_partition
from mkc_torch.losses._checks import (
    Reduction,
    at_least_float32,
    checked_axis,
    checked_weight,
    format_tensor,
    refuse_no_dimension,
    refuse_other_reduction,
    refuse_other_shapes,
)
from mkc_torch.losses._curves import SampleCurves
from mkc_torch.losses._implementation import Implementation, checked_implementation, runs_kernels
from mkc_torch.losses._parameters import logistic

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

KAPPA_MIN = 1e-6
"""Smallest ``1 / sigma²`` of a head; below it the gradients of σ leave the range of float32."""

_CHUNK = 1 << 14
"""Elements per chunk of the normaliser, each a quadrature of 32 nodes."""

_ROUNDING = 1e-5
"""Relative tolerance on the limits of σ and d, for rounding."""


class HeteroscedasticMKCLoss(SampleCurves, InitialValues):
    """Negative log-likelihood of the MKC density with a bandwidth σ and a scale d for every element.

    The network predicts σ and d together with the location, by :class:`MKCHead` for example. This distinguishes samples
    of large noise from outliers. With constant σ and d the loss equals :class:`mkc_torch.MKCLoss`. A network that
    interpolates single samples drives their d to its floor: give the head a physical ``d_min`` and watch a validation
    set.

    The normaliser of each element is a quadrature of 32 nodes, computed in chunks of bounded memory. It costs a
    microsecond or more per element on one core, thirty times the rest of the loss. In float32, on the CPU and in GPU
    kernels, a table replaces it if the domain extends beyond the head of the density; the loss is then ten times as
    fast. If σ and d have size 1 along a dimension of the input, for example one value per sample for many channels,
    torch computes the normaliser once and broadcasts it.

    Args:
        bound: half-width a of the domain of the errors, in the unit of the target, a number or (m,).
        channel_dim: the dimension of the input that holds the channels.
        reduction: "none", "mean" (over elements, weighted if weights are given) or "sum".
        impl: "auto" runs Triton kernels on a GPU that has them and torch elsewhere; "eager", "compile" or "triton"
            select an implementation. All compute the same.

    Attributes:
        bound: buffer () or (m,), saved in the state_dict.

    Raises:
        TypeError, ValueError: an argument of another type, or out of range.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17).

    Example:
        >>> head = MKCHead(5, 2, bound=50.0, d_min=1e-3)
        >>> loss = HeteroscedasticMKCLoss(bound=50.0)
        >>> features, target = torch.randn(8, 5), torch.zeros(8, 2)
        >>> prediction, sigma, d = head(features)
        >>> loss(prediction, target, sigma, d).backward()
    """

    bound: Tensor

    def __init__(
        self,
        bound: float | Float[Tensor, " m"],
        *,
        channel_dim: int = -1,
        reduction: Reduction = "mean",
        impl: Implementation = "auto",
    ) -> None:
        super().__init__()
        refuse_other_reduction(reduction)
        refuse_no_dimension(channel_dim)
        self.channel_dim = channel_dim
        self.reduction = reduction
        self.impl = checked_implementation(impl)
        self._register("bound", _positive("bound", bound))

    def forward(
        self,
        input: Float[Tensor, "*shape"],
        target: Float[Tensor, "*shape"],
        sigma: Float[Tensor, "*some"],
        d: Float[Tensor, "*some"],
        weight: Float[Tensor, "*shape"] | Bool[Tensor, "*shape"] | None = None,
    ) -> Tensor:
        """The loss of predictions against targets.

        Args:
            input: predictions, any shape; with a bound of shape (m,), ``channel_dim`` has size m.
            target: targets of the same shape; nothing is broadcast.
            sigma: bandwidths in [0.05, inf], of the shape of the input, or with size 1 along any dimensions.
            d: scales in (0, bound], in the unit of the target; shaped like ``sigma``.
            weight: non-negative weights, or a boolean mask (True: used); of the shape of the input, or without the
                channel dimension. Elements of weight 0 or False, NaN included, affect neither the value nor a gradient;
                nor do a σ and a d that only masked elements use.

        Returns:
            A scalar, or with reduction "none" the shape of the input with 0 where masked; float32 at least. The mean is
            the weighted mean over elements, and 0 if all weights are 0.

        Raises:
            TypeError: integer or complex input, target, sigma or d, or an argument that is not a tensor.
            ValueError: shapes that differ, are empty, or do not fit the bound; a weight that is negative, NaN or
                infinite; an unmasked input or target that is NaN or infinite; an unmasked sigma or d out of range. The
                last three are checked on the CPU in eager code only; on an accelerator, in compiled code and under vmap
                a NaN gives NaN.
        """
        if runs_kernels(self, input):
            from mkc_torch.losses.kernels.entry import sample_loss

            return sample_loss(self, input, target, sigma, d, weight)
        if self.impl == "compile" and not torch.compiler.is_compiling():
            return _compiled()(self, input, target, sigma, d, weight)
        return self._computed(input, target, sigma, d, weight)

    def _computed(self, input: Tensor, target: Tensor, sigma: Tensor, d: Tensor, weight: Tensor | None) -> Tensor:
        axis = self._checked_axis(input, target)
        self._check_scales(input, sigma, d)
        dtype = at_least_float32(input)
        for value in (target, sigma, d):
            dtype = torch.promote_types(dtype, value.dtype)
        input, target = input.to(dtype), target.to(dtype)
        error = input - target
        sigma, d, bound = sigma.to(dtype), d.to(dtype), self.bound.to(dtype)
        if weight is not None:
            weight, counts = checked_weight(weight, error, axis)
            error = torch.where(counts, error, 0.0)
            # a σ or d that only masked elements use is replaced by a value in range
            sigma = torch.where(counts.to(dtype).sum_to_size(sigma.shape) > 0, sigma, 1.0)
            d = torch.where(counts.to(dtype).sum_to_size(d.shape) > 0, d, bound.amin())
        if bound.dim():
            bound = bound.reshape([-1 if i == axis else 1 for i in range(error.dim())])
        length = bound / d
        refuse_bad_batch(input, target, None if weight is None else counts, error)
        if not torch.compiler.is_compiling():
            _refuse_out_of_range(sigma, d, length)
        kappa = inverse_square(sigma)
        values = energy(error / d, kappa) + (torch.log(d) + _log_partition(kappa, length))
        if weight is not None:
            values = weight * values
        if self.reduction == "none":
            return values
        total = values.sum()
        if self.reduction == "sum":
            return total
        if weight is None:
            return total / error.numel()
        elements = weight.sum()
        return total / torch.where(elements > 0, elements, 1.0)

    def _checked_axis(self, input: Tensor, target: Tensor) -> int:
        refuse_other_shapes(input, target)
        axis = checked_axis(input, self.channel_dim)
        if self.bound.dim() and input.shape[axis] != self.bound.shape[0]:
            raise ValueError(
                f"Expected {self.bound.shape[0]} channels, as `bound` has, in dimension {self.channel_dim} "
                f"but got {tuple(input.shape)}; pass a number as `bound` for any number of channels."
            )
        return axis

    def _check_scales(self, input: Tensor, sigma: Tensor, d: Tensor) -> None:
        for name, value in (("sigma", sigma), ("d", d)):
            _refuse_other_shape(name, value, input)

    def extra_repr(self) -> str:
        return f"bound={format_tensor(self.bound)}, channel_dim={self.channel_dim}, reduction={self.reduction!r}"


@functools.cache
def _compiled() -> Callable[..., Tensor]:
    return torch.compile(HeteroscedasticMKCLoss._computed)


class MKCHeadOutput(NamedTuple):
    """Predictions with their bandwidths and scales, each (*, m)."""

    location: Float[Tensor, "*batch m"]
    sigma: Float[Tensor, "*batch m"]
    d: Float[Tensor, "*batch m"]


class MKCHead(InitialValues):
    """Output layer of a network: the prediction, σ and d of each of m channels.

    A sigmoid of a linear function of the features keeps ``1 / sigma²`` in [1e-6, 400], that is σ in [0.05, 1000], and d
    in [d_min, bound]. Initially this function is constant: σ and d start at the initial values for every sample.

    σ and d are computed in float32 at least, under autocast too. Exclude ``scales`` from weight decay, above all its
    bias.

    Args:
        in_features: number of features.
        num_channels: m, the number of predictions.
        bound: half-width of the loss's domain, in the unit of the target, a number or (m,).
        d_min: floor of d, a number or (m,): the precision of the targets, which limits the noise from below.
        sigma_init: initial σ in (0.05, 1000), a number or (m,).
        d_init: initial d in (d_min, bound), a number or (m,).

    Attributes:
        location: linear layer of the predictions.
        scales: linear layer of the raw σ and d.

    Raises:
        TypeError, ValueError: an argument of another type, or out of range.

    References:
        Nix and Weigend, "Estimating the mean and variance of the target probability distribution", ICNN 1994: a
        network that predicts mean and scale.

    Example:
        >>> head = MKCHead(5, 2, bound=50.0, d_min=1e-3, d_init=0.5)
        >>> prediction, sigma, d = head(torch.randn(3, 5))
        >>> sigma[0], d[0]
        (tensor([3., 3.], grad_fn=<...>), tensor([0.5000, 0.5000], grad_fn=<...>))
    """

    bound: Tensor
    d_min: Tensor

    def __init__(
        self,
        in_features: int,
        num_channels: int,
        *,
        bound: float | Float[Tensor, " m"],
        d_min: float | Float[Tensor, " m"],
        sigma_init: float | Float[Tensor, " m"] = 3.0,
        d_init: float | Float[Tensor, " m"] = 1.0,
    ) -> None:
        super().__init__()
        in_features = checked_whole("in_features", in_features, 1)
        num_channels = checked_whole("num_channels", num_channels, 1)
        given = {"bound": bound, "d_min": d_min, "sigma_init": sigma_init, "d_init": d_init}
        values = {name: _positive(name, value, num_channels) for name, value in given.items()}
        self._register("bound", values["bound"])
        self._register("d_min", values["d_min"])
        known = has_values(*values.values())
        if known and not bool(((values["d_min"] < values["d_init"]) & (values["d_init"] < values["bound"])).all()):
            raise ValueError(
                f"Expected argument `d_init` between `d_min` {format_tensor(values['d_min'])} and `bound` "
                f"{format_tensor(values['bound'])} but got {d_init}; a robust scale of the targets is a good start."
            )
        kappa = inverse_square(values["sigma_init"].double())
        if known and not bool(((kappa > KAPPA_MIN) & (kappa < KAPPA_MAX)).all()):
            raise ValueError(
                f"Expected argument `sigma_init` in ({KAPPA_MAX**-0.5:g}, {KAPPA_MIN**-0.5:g}) but got {sigma_init}; "
                "start at 10 for noise that is nearly Gaussian."
            )
        self.in_features = in_features
        self.num_channels = num_channels
        self.location = nn.Linear(in_features, num_channels)
        low, high = values["d_min"].double(), values["bound"].double()
        d = (values["d_init"].double() - low) / (high - low)
        self.scales = _ConstantStart(
            in_features, torch.logit(torch.cat([(kappa - KAPPA_MIN) / (KAPPA_MAX - KAPPA_MIN), d]))
        )

    def reset_parameters(self) -> None:
        """Set both layers, ``bound`` and ``d_min`` to their initial values; the predictions' weights are random."""
        super().reset_parameters()
        self.location.reset_parameters()
        self.scales.reset_parameters()

    def forward(self, features: Float[Tensor, "*batch n"]) -> MKCHeadOutput:
        """Predictions, σ and d of each sample.

        Args:
            features: features (*, n) with n = ``in_features``.

        Returns:
            ``(location, sigma, d)``, each (*, m); σ is dimensionless, the others are in the unit of the target.

        Raises:
            TypeError: integer or complex features, or an argument that is not a tensor.
            ValueError: another number of features.
        """
        refuse_not_real("features", features)
        if features.dim() == 0 or features.shape[-1] != self.in_features:
            raise ValueError(
                f"Expected argument `features` of shape (*, {self.in_features}) but got {tuple(features.shape)}."
            )
        location = self.location(features)
        # half precision would resolve d to a few per cent only
        with torch.autocast(features.device.type, enabled=False):
            dtype = at_least_float32(self.scales.weight)
            raw = nn.functional.linear(features.to(dtype), self.scales.weight.to(dtype), self.scales.bias.to(dtype))
            raw_kappa, raw_d = logistic(raw).split(self.num_channels, -1)
            sigma = (KAPPA_MIN + (KAPPA_MAX - KAPPA_MIN) * raw_kappa).rsqrt()
            d = self.d_min + (self.bound - self.d_min) * raw_d
        return MKCHeadOutput(location, sigma, d)

    def extra_repr(self) -> str:
        bound, d_min = format_tensor(self.bound), format_tensor(self.d_min)
        return f"{self.in_features}, {self.num_channels}, bound={bound}, d_min={d_min}"


class _ConstantStart(nn.Linear):
    """A linear layer that starts as the same outputs for every sample."""

    def __init__(self, in_features: int, start: Float[Tensor, " k"]) -> None:
        super().__init__(in_features, len(start))
        self._start = start
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        start = self.__dict__.get("_start")
        if start is None:  # nn.Linear calls this before there is a start
            super().reset_parameters()
            return
        self.weight.zero_()
        set_values("bias", self.bias, start)


class MKCConvHead(MKCHead):
    """An :class:`MKCHead` at each position of an image or a series, channels second: a convolution of kernel size 1.

    Args:
        in_features: number of feature maps; the other arguments are those of :class:`MKCHead`.

    Example:
        >>> head = MKCConvHead(5, 2, bound=50.0, d_min=1e-3)
        >>> prediction, sigma, d = head(torch.randn(3, 5, 8, 8))
        >>> value = HeteroscedasticMKCLoss(50.0, channel_dim=1)(prediction, torch.zeros(3, 2, 8, 8), sigma, d)
        >>> prediction.shape, value.shape
        (torch.Size([3, 2, 8, 8]), torch.Size([]))
    """

    def forward(self, features: Float[Tensor, "N n *places"]) -> MKCHeadOutput:
        """Predictions, σ and d at each position, each (N, m, *positions).

        Args:
            features: feature maps, (N, n, *positions).

        Raises:
            TypeError: integer or complex features, or an argument that is not a tensor.
            ValueError: another number of feature maps.
        """
        refuse_not_real("features", features)
        if features.dim() < 2 or features.shape[1] != self.in_features:
            raise ValueError(
                f"Expected argument `features` of shape (N, {self.in_features}, ...) but got {tuple(features.shape)}."
            )
        return MKCHeadOutput(*(values.movedim(-1, 1) for values in super().forward(features.movedim(1, -1))))


def _positive(name: str, value: float | Tensor, num_channels: int | None = None) -> Tensor:
    """A positive number or a value per channel as a tensor, expanded to (m,) if m is given."""
    t = initial_numbers(name, value).detach()
    t = t.to(at_least_float32(t))
    if t.dim() > 1 or (num_channels is not None and t.dim() == 1 and t.shape[0] not in (1, num_channels)):
        wanted = "(m,)" if num_channels is None else f"({num_channels},)"
        raise ValueError(f"Expected argument `{name}` to be a number or of shape {wanted} but got {tuple(t.shape)}.")
    if has_values(t) and not bool(((t > 0) & torch.isfinite(t)).all()):
        raise ValueError(f"Expected argument `{name}` to be positive and finite but got {value}.")
    return t.clone() if num_channels is None else t.expand(num_channels).clone()


def _log_partition(kappa: Tensor, length: Tensor) -> Tensor:
    """``log Z`` of each element, in chunks: the quadrature needs several times 32 numbers per element."""
    kappa, length = torch.broadcast_tensors(kappa, length)
    # compiled code sums over the nodes without storing them, and a loop would fix the batch size
    if torch.compiler.is_compiling() or kappa.numel() <= _CHUNK:
        return log_partition(kappa, length)
    chunks = zip(kappa.reshape(-1).split(_CHUNK), length.reshape(-1).split(_CHUNK), strict=True)
    return torch.cat([log_partition(*chunk) for chunk in chunks]).reshape(kappa.shape)


def _refuse_other_shape(name: str, value: Tensor, input: Tensor) -> None:
    refuse_not_real(name, value)
    if value.dim() != input.dim() or any(a not in (1, b) for a, b in zip(value.shape, input.shape, strict=True)):
        raise ValueError(
            f"Expected argument `{name}` of the shape of `input`, {tuple(input.shape)}, or of size 1 in any dimension "
            f"but got {tuple(value.shape)}; add the missing dimensions, as {name}.unsqueeze(-1) for a value per sample."
        )


@torch.no_grad()
def _refuse_out_of_range(sigma: Tensor, d: Tensor, length: Tensor) -> None:
    """Raise ValueError for a σ or d out of range; checked on the CPU only, where no read waits for a device."""
    if sigma.device.type != "cpu":
        return
    least = KAPPA_MAX**-0.5
    try:
        least_sigma, (shortest, longest) = sigma.amin().item(), (t.item() for t in torch.aminmax(length))
    except RuntimeError:  # under vmap values cannot be read
        return
    # amin returns a NaN, and a NaN fails every comparison
    if not least_sigma >= least * (1.0 - _ROUNDING):
        wrong = ~(sigma >= least * (1.0 - _ROUNDING))
        raise ValueError(
            f"Expected argument `sigma` in [{least:g}, inf] but got {first_of(sigma, wrong)}. Map the network's output "
            "into it, as MKCHead does: rsqrt(400 * sigmoid(raw))."
        )
    if not (shortest >= 1.0 - _ROUNDING and longest < float("inf")):
        wrong = ~((length >= 1.0 - _ROUNDING) & (length < float("inf")))
        raise ValueError(
            f"Expected argument `d` in (0, bound] but got {first_of(d.expand_as(length), wrong)}. Map the network's "
            "output into it, as MKCHead does: d_min + (bound - d_min) * sigmoid(raw)."
        )

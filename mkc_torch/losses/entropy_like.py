"""The entropy of relative squared residuals: small if most residuals are small and a few are large.

H is (40)-(42) of G. Indiveri, "An Entropy-Like Estimator for Robust Parameter Identification", Entropy 11 (2009)
560-585::

    q_i = r_i² / Σ_j r_j²,    H = -Σ_i q_i log q_i / log N

:func:`entropy_like` computes it, :class:`LELoss` is the loss of networks, :func:`least_entropy_like` minimises it over
the parameters of any differentiable residual, :class:`mkc_torch.linear.LeastEntropyLike` over those of a linear model.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor, nn

from mkc_torch._support.arguments import (
    checked_number,
    checked_whole,
    format_value,
    refuse_bad_batch,
    refuse_bad_weight,
    refuse_complex,
    refuse_no_tensor,
    refuse_not_finite,
    refuse_not_real,
    seems_finite,
)
from mkc_torch._support.small_factors import orthonormal_columns
from mkc_torch._support.trust_region import Quadratic, minimise
from mkc_torch.density.energy import as_computed
from mkc_torch.losses._checks import refuse_other_reduction, refuse_other_shapes
from mkc_torch.losses._entropy_curves import EntropyCurves

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

LEAST_TOTAL = 1.001
"""Smallest total weight of several residuals: log N is a divisor, so weights that sum to 1 are rejected."""


def entropy_like(
    residual: Float[Tensor, "*shape"],
    dim: int | tuple[int, ...] | None = None,
    weight: Float[Tensor, "*#shape"] | Bool[Tensor, "*#shape"] | None = None,
) -> Tensor:
    """H of residuals, (42): 0 if a single residual differs from 0, 1 if all have the same magnitude.

    H does not depend on the scale of the residuals. H and its gradient are 0 for a single residual, and if all
    residuals are 0 or smaller than the smallest normal number. Elsewhere value and gradient are continuous, zero
    residuals included. The second derivative grows like ``-log r²`` as a residual r goes to 0; at 0 it is computed with
    the smallest normal number for ``q``. Half and bfloat16 are computed in float32.

    Args:
        residual: any shape.
        dim: dimensions of one population of residuals; None means all dimensions.
        weight: number of repetitions of each residual, or a mask; broadcast against the residuals. A residual of weight
            0 is ignored, NaN included. N is the total weight.

    Returns:
        H with the dimensions ``dim`` removed; in [0, 1] if the weights are counts.

    Raises:
        TypeError: complex residuals, or an argument that is not a tensor.
        ValueError: no residuals; unmasked residuals that are not finite; a dimension that does not exist; weights that
            are negative, not finite, or do not broadcast; weights of several residuals that total at most 1, so that
            log N is not positive. Values are not checked on an accelerator, under vmap and in compiled code: there H is
            0 for such weights, and NaN for a NaN.

    References:
        G. Indiveri, Entropy 11 (2009), (40)-(45).

    Example:
        >>> entropy_like(torch.tensor([1.0, -1.0, 1.0, 1.0])), entropy_like(torch.tensor([0.0, 0.0, 5.0, 0.0]))
        (tensor(1.), tensor(0.))
    """
    refuse_no_tensor("residual", residual, "a real tensor")
    refuse_complex("residual", residual)
    (residual,) = as_computed(residual)
    if weight is not None:
        _refuse_other_weight(weight, residual.shape)
        residual = torch.where(_counts(weight), residual, 0.0)
    if not seems_finite(residual):
        refuse_not_finite("residual", residual, "Leave them out by a weight of 0")
    return _entropy(residual, dim, weight)


def _entropy(
    residual: Float[Tensor, "*shape"],
    dim: int | tuple[int, ...] | None,
    weight: Float[Tensor, "*#shape"] | Bool[Tensor, "*#shape"] | None,
) -> Tensor:
    """H of residuals that are 0 where they are masked."""
    if residual.numel() == 0:
        raise ValueError(f"Expected at least one residual but got shape {tuple(residual.shape)}.")
    dims = _dimensions(residual, dim)
    count: Tensor | float
    if weight is None and torch.compiler.is_compiling():
        # a Python number would fix the batch size of the compiled code
        count = torch.ones_like(residual).sum(dims)
    elif weight is None:
        count = float(math.prod([residual.shape[d] for d in dims]))
    else:
        if not torch.compiler.is_compiling():
            _refuse_shares(weight, residual.shape, dims)
        weight = weight.to(residual.dtype)
        count = weight.expand(residual.shape).sum(dims)
    tiny = torch.finfo(residual.dtype).tiny
    # H does not depend on the unit, so the unit needs no gradient
    unit = residual.detach().abs().amax(dims, keepdim=True)
    # the gradient grows as residuals shrink, and would overflow below this limit
    unit = torch.where(unit >= tiny, unit, torch.inf)
    square = (residual / unit).square()
    total = (square if weight is None else weight * square).sum(dims, keepdim=True)
    q = square / torch.where(total > 0, total, 1.0)
    information = -q * torch.log(q.clamp(min=tiny))
    entropy = (information if weight is None else weight * information).sum(dims)
    if isinstance(count, Tensor):
        log_count = torch.log(count.clamp(min=1.0))
        return torch.where(log_count > 0, entropy / torch.where(log_count > 0, log_count, 1.0), 0.0)
    return entropy / math.log(count) if count > 1 else 0.0 * entropy


def _refuse_no_dimension(dim: object) -> None:
    dims = dim if isinstance(dim, (tuple, list)) else () if dim is None else (dim,)
    if not all(isinstance(d, int) for d in dims):
        raise TypeError(
            f"Expected argument `dim` to be a dimension, several, or None but got {format_value(dim)}; "
            "0 is the dimension of the samples."
        )


def _dimensions(residual: Tensor, dim: int | tuple[int, ...] | None) -> tuple[int, ...]:
    """The dimensions of one population."""
    _refuse_no_dimension(dim)
    count = residual.dim()
    if dim is None:
        return tuple(range(count))
    dims = (dim,) if isinstance(dim, int) else tuple(dim)
    if not all(-count <= d < count for d in dims) or len({d % count for d in dims}) < len(dims):
        raise ValueError(
            f"Expected argument `dim` to be dimensions of the residuals {tuple(residual.shape)}, each once, "
            f"but got {dim}."
        )
    return dims


def _counts(weight: Tensor) -> Tensor:
    return weight if weight.dtype == torch.bool else weight != 0


def _refuse_other_weight(weight: Tensor, shape: torch.Size) -> None:
    refuse_bad_weight(weight)
    pairs = zip(reversed(weight.shape), reversed(shape), strict=False)
    if weight.dim() > len(shape) or any(a not in (1, b) for a, b in pairs):
        fix = "; add the missing dimensions, weight.unsqueeze(-1)" if weight.dim() < len(shape) else ""
        raise ValueError(
            f"Expected argument `weight` to broadcast to the residuals {tuple(shape)} but got {tuple(weight.shape)}"
            f"{fix}."
        )


def _refuse_shares(weight: Tensor, shape: torch.Size, dims: tuple[int, ...]) -> None:
    """Raise ValueError for weights that total at most 1; checked on the CPU only, where no read waits."""
    if weight.dtype == torch.bool or weight.device.type != "cpu":
        return
    with torch.no_grad():
        w = weight.expand(shape)
        total, used = w.sum(dims), (w != 0).sum(dims)
        try:
            bad = bool(((used > 1) & ~(total > LEAST_TOTAL)).any())
        except RuntimeError:  # under vmap values cannot be read
            return
    if bad:
        raise ValueError(
            "Expected argument `weight` to count repetitions and to total more than 1 "
            f"but got a total of {float(total.min()):.3g}; multiply the weights by the number of residuals."
        )


class LELoss(EntropyCurves, nn.Module):
    """H of the errors of a batch, (40)-(42) of Indiveri (2009): smallest if few errors are large and most are small.

    H does not depend on the scale of the errors: it cannot distinguish networks with the same relative errors. It has
    local minima: start from a network trained with another loss. Use large batches, because H describes all errors of
    a batch together.

    Args:
        dim: dimensions of one population of errors; None means all elements. If channels have different units, pass
            the other dimensions: ``dim=0`` for (N, m).
        reduction: reduction over the populations: "mean", "sum" or "none".

    Raises:
        TypeError, ValueError: an argument of another type, or out of range.

    References:
        G. Indiveri, Entropy 11 (2009), (40)-(45).

    Example:
        >>> loss = LELoss()
        >>> output = torch.zeros(50, requires_grad=True)
        >>> target = torch.cat([torch.full((45,), 0.1), torch.full((5,), 10.0)])
        >>> value = loss(output, target)
        >>> value.backward()
        >>> round(value.item(), 3), bool(output.grad[0] < 0 < output.grad[-1])  # descent moves outliers further away
        (0.414, True)
    """

    def __init__(
        self, dim: int | tuple[int, ...] | None = None, reduction: Literal["mean", "sum", "none"] = "mean"
    ) -> None:
        super().__init__()
        refuse_other_reduction(reduction)
        _refuse_no_dimension(dim)
        self.dim = dim
        self.reduction = reduction

    def forward(
        self,
        input: Float[Tensor, "*shape"],
        target: Float[Tensor, "*shape"],
        weight: Float[Tensor, "*#shape"] | Bool[Tensor, "*#shape"] | None = None,
    ) -> Tensor:
        """H of ``input - target``.

        Args:
            input: predictions.
            target: targets of the same shape; nothing is broadcast.
            weight: counts or a mask, broadcast against the input, as in :func:`entropy_like`.

        Returns:
            A scalar, or with reduction "none" H of each population; float32 at least.

        Raises:
            TypeError: integer or complex input or target, or an argument that is not a tensor.
            ValueError: shapes that differ or are empty; weights that are negative, not finite, or total at most 1; an
                unmasked input or target that is not finite. See :func:`entropy_like` for where values are checked.
        """
        refuse_other_shapes(input, target)
        input, target = as_computed(input, target)
        error, counts = input - target, None
        if weight is not None:
            _refuse_other_weight(weight, error.shape)
            counts = _counts(weight).expand(error.shape)
            error = torch.where(counts, error, 0.0)
        refuse_bad_batch(input, target, counts, error)
        entropy = _entropy(error, self.dim, weight)
        if self.reduction == "none":
            return entropy
        return entropy.mean() if self.reduction == "mean" else entropy.sum()

    def extra_repr(self) -> str:
        return f"dim={self.dim}, reduction={self.reduction!r}"


def orthogonal_starts(theta: Float[Tensor, "*batch p"]) -> Float[Tensor, "*batch p p"]:
    """``theta`` and p - 1 vectors of the same length, orthogonal to each other, as rows: (50)-(51) of Indiveri (2009).

    Computed by the Gram-Schmidt process on ``theta`` and the axes in order, without the axis nearest to ``theta``.

    Example:
        >>> orthogonal_starts(torch.tensor([3.0, 4.0]))
        tensor([[ 3.,  4.],
                [ 4., -3.]])
    """
    p = theta.shape[-1]
    length = torch.linalg.vector_norm(theta, dim=-1, keepdim=True)
    unit = theta / torch.where(length > 0, length, 1.0)
    axes = torch.arange(p, device=theta.device)
    nearest = unit.abs().argmax(-1, keepdim=True)
    order = torch.where(axes == nearest, p, axes.expand(theta.shape)).argsort(-1)[..., : p - 1]
    others = torch.eye(p, dtype=theta.dtype, device=theta.device)[order]
    # theta is the first column, unless it is 0
    first = torch.where(length > 0, unit, (axes == nearest).to(theta))
    basis = orthonormal_columns(torch.cat([first.unsqueeze(-2), others], dim=-2).mT)
    rest = basis.mT[..., 1:, :] * length.unsqueeze(-1)
    return torch.cat([theta.unsqueeze(-2), rest], dim=-2)


@dataclass(frozen=True)
class EntropyLikeMinima:
    """Local minima of H, a minimum per start.

    Attributes:
        starts: (S, p).
        theta: end of the descent from each start, (S, p).
        entropy: H there, (S,).
        converged: whether ``theta`` is a local minimum, (S,).
        n_iter: number of steps tried, (S,).
    """

    starts: Float[Tensor, "S p"]
    theta: Float[Tensor, "S p"]
    entropy: Float[Tensor, " S"]
    converged: Bool[Tensor, " S"]
    n_iter: Tensor

    @property
    def best(self) -> Float[Tensor, " p"]:
        """The parameters with the smallest H."""
        return self.theta[self.entropy.argmin()]


def least_entropy_like(
    residual: Callable[[Tensor], Tensor],
    starts: Float[Tensor, " p"] | Float[Tensor, "S p"],
    *,
    weight: Tensor | None = None,
    tol: float | None = None,
    max_iter: int = 200,
) -> EntropyLikeMinima:
    """Minimise H of any differentiable residual from several starts at once, by Newton's method.

    Each step computes the exact Hessian at the cost of p gradients, which suits up to a few hundred parameters. Train
    larger networks with :class:`LELoss`.

    Args:
        residual: function of the parameters (p,) that returns residuals of any shape, all of one population; twice
            differentiable and compatible with ``torch.func.vmap``.
        starts: (S, p), one descent each; or (p,), an initial guess that :func:`orthogonal_starts` completes to p
            starts.
        weight: counts or a mask, of the shape of the residuals.
        tol: predicted gain in H at which a descent ends; default 64 times the rounding error of the dtype.
        max_iter: maximum number of steps tried.

    Raises:
        TypeError: ``starts`` is not a floating tensor of at least float32, or ``residual`` cannot be called.
        ValueError: ``starts`` has another shape or is not finite, H is not finite at a start, or an argument is out of
            range.

    References:
        G. Indiveri, Entropy 11 (2009), section 4.2.

    Example:
        >>> x = torch.linspace(0, 3, 40, dtype=torch.float64)
        >>> y = torch.exp(-0.7 * x)
        >>> y[::8] += 5.0
        >>> found = least_entropy_like(lambda t: y - torch.exp(-t * x), torch.tensor([[0.5]], dtype=torch.float64))
        >>> found.best
        tensor([0.7000], dtype=torch.float64)
    """
    if not callable(residual):
        raise TypeError(
            f"Expected argument `residual` to be a function of the parameters but got {type(residual).__name__}; "
            "write lambda theta: y - model(theta)."
        )
    refuse_not_real("starts", starts, "a float32 or float64 tensor")
    if starts.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            f"Expected argument `starts` to be a float32 or float64 tensor but got {starts.dtype}; use .float()."
        )
    if tol is not None:
        checked_number("tol", tol, ends="[)")
    checked_whole("max_iter", max_iter, 1)
    if starts.dim() not in (1, 2) or starts.numel() == 0:
        raise ValueError(f"Expected argument `starts` of shape (S, p) or (p,) but got {tuple(starts.shape)}.")
    if not bool(torch.isfinite(starts).all()):
        raise ValueError("Expected argument `starts` to be finite but got NaN or infinity.")
    points = orthogonal_starts(starts.detach()) if starts.dim() == 1 else starts.detach()

    def entropy(theta: Tensor) -> tuple[Tensor, Tensor]:
        h = entropy_like(residual(theta), weight=weight)
        return h, h

    def slope(theta: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        gradient, value = torch.func.grad(entropy, has_aux=True)(theta)
        return gradient, (gradient, value)

    # reverse mode twice: every trainable model supports it
    derivatives = torch.func.vmap(torch.func.jacrev(slope, has_aux=True))

    def function(theta: Tensor, index: Tensor) -> Quadratic:  # noqa: ARG001 - signature of an objective of the trust region
        hessian, (gradient, value) = derivatives(theta)
        hessian = torch.where(torch.isfinite(hessian), 0.5 * (hessian + hessian.mT), 0.0)
        return Quadratic(value.to(theta.dtype), gradient, hessian)

    if weight is not None:
        refuse_bad_weight(weight)
        _refuse_shares(weight, weight.shape, tuple(range(weight.dim())))
    first = torch.func.vmap(lambda theta: entropy(theta)[0])(points)
    if not bool(torch.isfinite(first).all()):
        bad = int((~torch.isfinite(first)).nonzero()[0])
        raise ValueError(
            f"Expected finite residuals at every start but got H = {float(first[bad])} at start {bad}; "
            "choose another start."
        )
    length = torch.linalg.vector_norm(points, dim=-1)
    radius = torch.where(length > 0, length, 1.0)
    minima = minimise(function, points, radius, tol=tol, max_iter=max_iter)
    return EntropyLikeMinima(points, minima.point, minima.value, minima.converged, minima.n_iter)

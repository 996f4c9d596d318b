"""A linear regression problem: checked, and transformed to an orthonormal basis in which every estimator works."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_complex, refuse_no_tensor, refuse_not_real
from mkc_torch._support.side_by_side import at_once, side_by_side
from mkc_torch._support.small_factors import solve
from mkc_torch._support.small_factors import solve_gram as solve_gram
from mkc_torch._support.torch_internals import forward_mode_is_active, is_wrapped
from mkc_torch.linear._basis import RankDeficientError as RankDeficientError
from mkc_torch.linear._basis import orthonormalise
from mkc_torch.linear._basis import refuse_dependent as refuse_dependent
from mkc_torch.linear._concentration import runs_kernel, weighted_fits

if TYPE_CHECKING:
    from jaxtyping import Float

MAX_IMPLIED_CHANNELS = 16

_CHUNK = 1 << 22
"""Largest number of values held at once when outer products of rows are formed."""

_BLOCK = 1 << 12
"""Values of rows that are weighted and multiplied at a time, so that they stay in the processor's cache."""

_FEW_COLUMNS = 4
"""Most columns whose outer products are kept off the CPU for a single set of weights."""

_MAX_SETS_IN_BLOCKS = 10
"""Most sets of weights for which blocks are faster than outer products of rows that are not kept."""


@dataclass(frozen=True)
class LinearProblem:
    """``Y ~ X coef`` over N samples of m channels, with X = basis · to_coef⁻¹ and an orthonormal basis.

    Work in the basis is invariant to the scale and the correlation of the columns of X. The batch dimensions are
    flattened to one of size B; an X that all problems share is kept once. ``batch`` holds the user's dimensions.
    A stack of S candidates per problem has its dimension after B.
    """

    basis: Float[Tensor, "#B N m n"]
    to_coef: Float[Tensor, "#B n n"]
    Y: Float[Tensor, "B N m"]
    sample_weight: Float[Tensor, "B N m"] | None
    batch: torch.Size
    single_channel: bool

    @property
    def num_samples(self) -> int:
        return self.Y.shape[-2]

    @property
    def num_channels(self) -> int:
        return self.Y.shape[-1]

    @property
    def num_coefficients(self) -> int:
        return self.basis.shape[-1]

    @property
    def coefficients_per_channel(self) -> int:
        """Coefficients per channel, rounded up: the degrees of freedom that a channel loses."""
        return -(-self.num_coefficients // self.num_channels)

    def residual(self, beta: Float[Tensor, "B *S n"]) -> Float[Tensor, "B *S N m"]:
        """``Y - X coef`` for coefficients in the basis, one set or a stack of S for each problem."""
        stack = beta if beta.dim() == 3 else beta.unsqueeze(-2)
        rows = self.basis.flatten(-3, -2)
        fitted = torch.matmul(stack, rows[0].mT if rows.shape[0] == 1 else rows.mT)
        residual = self.Y.unsqueeze(1) - fitted.unflatten(-1, self.Y.shape[-2:])
        return residual if beta.dim() == 3 else residual.squeeze(1)

    def weighted_fit(self, weight: Float[Tensor, "B *S N m"]) -> Float[Tensor, "B *S n"]:
        """Weighted least-squares coefficients in the basis; sample weights are multiplied in."""
        if runs_kernel(self) and not self._derived(weight):
            fitted = weighted_fits(self, weight if weight.dim() == 4 else weight.unsqueeze(1))
            return fitted if weight.dim() == 4 else fitted.squeeze(1)
        gram, moment = self.normal_equations(weight)
        return solve_gram(gram, moment)

    def _derived(self, weight: Tensor) -> bool:
        """Whether a fit with these weights is differentiated or transformed by ``torch.func``."""
        recorded = torch.is_grad_enabled() and any(v.requires_grad for v in (self.basis, self.Y, weight))
        return recorded or is_wrapped(weight) or forward_mode_is_active()

    def normal_equations(
        self, weight: Float[Tensor, "B *S N m"]
    ) -> tuple[Float[Tensor, "B *S n n"], Float[Tensor, "B *S n"]]:
        """Gram matrix and moment of the basis under ``weight`` times the sample weights."""
        stack = weight if weight.dim() == 4 else weight.unsqueeze(1)
        if self.sample_weight is not None:
            stack = stack * self.sample_weight.unsqueeze(1)
        n = self.num_coefficients
        sums: Tensor | None = None
        step = at_once(self.Y, n * n * self.num_channels * self.basis.shape[0], _CHUNK)
        # off the CPU the products of many columns cost more memory traffic than weighted rows
        wide = n > _FEW_COLUMNS and stack.shape[1] == 1 and side_by_side(stack)
        if (step < self.num_samples and stack.shape[1] <= _MAX_SETS_IN_BLOCKS) or wide:
            gram, moment = self._sums_of_blocks(stack)
            return (gram, moment) if weight.dim() == 4 else (gram.squeeze(1), moment.squeeze(1))
        for first in range(0, self.num_samples, step):
            part = slice(first, first + step)
            w = stack[:, :, part].flatten(-2)
            products, own_targets = self._products if step >= self.num_samples else self._products_of(part)
            more = torch.matmul(w, products if own_targets else products[0])
            if not own_targets:
                rows, y = self.basis[0, part].flatten(-3, -2), self.Y[:, part].flatten(-2)
                more = torch.cat([more, torch.matmul(w * y.unsqueeze(1), rows)], dim=-1)
            sums = more if sums is None else sums + more
        assert sums is not None
        gram, moment = sums[..., _symmetric(n, sums.device)[2]], sums[..., -n:]
        return (gram, moment) if weight.dim() == 4 else (gram.squeeze(1), moment.squeeze(1))

    def _sums_of_blocks(self, stack: Tensor) -> tuple[Float[Tensor, "B S n n"], Float[Tensor, "B S n"]]:
        """Normal equations for a few sets of weights, block by block, without keeping outer products of rows."""
        gram: Tensor | None = None
        moment: Tensor | None = None
        each = self.num_channels
        if side_by_side(stack):
            each *= self.num_coefficients * stack.shape[0] * stack.shape[1]
        step = at_once(stack, each, _BLOCK)
        for first in range(0, self.num_samples, step):
            part = slice(first, first + step)
            w, rows = stack[:, :, part].flatten(-2), self.basis[:, part].flatten(-3, -2).unsqueeze(1)
            more = torch.matmul((rows * w.unsqueeze(-1)).mT, rows)
            plus = torch.matmul((w * self.Y[:, part].flatten(-2).unsqueeze(1)).unsqueeze(-2), rows).squeeze(-2)
            gram, moment = (more, plus) if gram is None or moment is None else (gram + more, moment + plus)
        assert gram is not None
        assert moment is not None
        return gram, moment

    @property
    def _products(self) -> tuple[Tensor, bool]:
        """Outer products of all samples, kept for the next steps unless derivatives are recorded."""
        kept: tuple[Tensor, bool] | None = self.__dict__.get("_kept_products")
        if kept is None:
            kept = self._products_of(slice(None))
            # products made without gradients cannot be used with gradients
            derived = self.basis.requires_grad or self.Y.requires_grad
            if not (derived or is_wrapped(kept[0])):
                self.__dict__["_kept_products"] = kept
        return kept

    def _products_of(self, part: slice) -> tuple[Float[Tensor, "#B Nm k"], bool]:
        """Upper halves of the outer products of rows, with the products of row and target if X is not shared.

        The second value is whether the targets are included: a shared X has a target for every problem.
        """
        rows = self.basis[:, part].flatten(-3, -2)
        i, j, _ = _symmetric(self.num_coefficients, rows.device)
        outer = rows[..., i] * rows[..., j]
        if self.basis.shape[0] != self.Y.shape[0]:
            return outer, False
        return torch.cat([outer, rows * self.Y[:, part].flatten(-2).unsqueeze(-1)], dim=-1), True

    def total_weight(self) -> Float[Tensor, "B m"]:
        """Sum of the sample weights of each channel; the number of samples without weights."""
        if self.sample_weight is None:
            return self.Y.new_full((self.Y.shape[0], self.num_channels), float(self.num_samples))
        return self.sample_weight.sum(-2)

    def coefficients(self, beta: Float[Tensor, "B n"]) -> Float[Tensor, "*batch n"]:
        """Coefficients of the user's columns, in the user's batch dimensions, from those in the basis."""
        return self.restore(torch.matmul(self.to_coef, beta.unsqueeze(-1)).squeeze(-1))

    def in_basis(self, coef: Float[Tensor, "*batch n"]) -> Float[Tensor, "B n"]:
        """Coefficients in the basis from those of the user's columns."""
        flat = coef.expand(*self.batch, self.num_coefficients).reshape(-1, self.num_coefficients, 1)
        return solve(self.to_coef, flat).squeeze(-1)

    def restore(self, values: Float[Tensor, B * rest]) -> Float[Tensor, "*batch *rest"]:
        """Reshape values of the flattened problems to the user's batch dimensions."""
        return values.reshape((*self.batch, *values.shape[1:]))

    def double(self) -> LinearProblem:
        """The same problems in float64, for what float32 cannot resolve."""
        weight = None if self.sample_weight is None else self.sample_weight.double()
        basis, to_coef = self.basis.double(), self.to_coef.double()
        return replace(self, basis=basis, to_coef=to_coef, Y=self.Y.double(), sample_weight=weight)

    def select(self, index: Tensor) -> LinearProblem:
        """Return the problems at ``index`` as a batch."""
        shared = self.basis.shape[0] == 1
        return replace(
            self,
            basis=self.basis if shared else self.basis[index],
            to_coef=self.to_coef if shared else self.to_coef[index],
            Y=self.Y[index],
            sample_weight=None if self.sample_weight is None else self.sample_weight[index],
            batch=torch.Size([index.shape[0]]),
        )

    def select_samples(self, index: Tensor) -> LinearProblem:
        """Return the same problems on the samples at ``index``; the basis is then only nearly orthonormal."""
        return replace(
            self,
            basis=self.basis[:, index],
            Y=self.Y[:, index],
            sample_weight=None if self.sample_weight is None else self.sample_weight[:, index],
        )


@lru_cache(maxsize=64)
def _symmetric(n: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Row and column indices of the upper half of an n × n matrix, and the position of each entry in that half."""
    # the cached tensors outlive an inference mode in which they were created
    with torch.inference_mode(False):
        i, j = torch.triu_indices(n, n, device=device)
        place = torch.zeros(n, n, dtype=torch.int64, device=device)
        place[i, j] = place[j, i] = torch.arange(i.shape[0], device=device)
        return i, j, place


def _check_finite(name: str, value: Tensor) -> None:
    bad = ~torch.isfinite(value)
    if bad.any():
        first = tuple(int(i) for i in bad.nonzero()[0])
        raise ValueError(
            f"Expected argument `{name}` to be finite but got {value[first].item()} at index {first} "
            f"({int(bad.sum())} such values); drop those samples, or give them `sample_weight` 0 and a finite value."
        )


@dataclass(frozen=True)
class CanonicalShapes:
    """Checked input: X (*#batch, N, m, n), Y (*batch, N, m) and, where given, weights (*batch, N, m)."""

    X: Float[Tensor, "*#batch N m n"]
    Y: Float[Tensor, "*batch N m"]
    sample_weight: Float[Tensor, "*batch N m"] | None
    batch: torch.Size
    single_channel: bool


def refuse_magnitude(largest: Tensor) -> None:
    """Refuse Y whose residuals, squared twice, would overflow or underflow.

    Raises:
        ValueError: the largest absolute values are out of range.
    """
    most = float(largest.detach().max())
    limit = float(torch.finfo(largest.dtype).max) ** 0.25
    if most > limit or 0.0 < most < 1.0 / limit:
        raise ValueError(
            f"Expected argument `Y` of a magnitude between {1.0 / limit:.0e} and {limit:.0e} in {largest.dtype} "
            f"but got {most:.3g}; choose another unit."
        )


def checked_shapes(
    X: Float[Tensor, "*batch N m n"],
    Y: Float[Tensor, "*batch N m"],
    sample_weight: Float[Tensor, "*batch N"] | None = None,
) -> CanonicalShapes:
    """Check types and shapes, and add the channel dimension to one-channel input; values are not checked.

    Raises:
        TypeError: X or Y is not a floating tensor, or their dtypes or devices differ.
        ValueError: shapes do not fit.
    """
    refuse_not_real("X", X)
    refuse_not_real("Y", Y)
    if X.dtype != Y.dtype or X.device != Y.device:
        raise TypeError(
            f"Expected `X` and `Y` to share dtype and device but got {X.dtype} on {X.device} "
            f"and {Y.dtype} on {Y.device}; use Y.to(X)."
        )
    if X.dtype in (torch.float16, torch.bfloat16):
        raise TypeError(f"Expected `X` of dtype float32 or float64 but got {X.dtype}; use .float().")
    if X.dim() < 2 or Y.dim() < 1 or X.shape[-2] != Y.shape[-1]:
        raise ValueError(
            f"Expected `X` of shape (*, N, m, n) with `Y` (*, N, m), or (*, N, n) with (*, N), "
            f"but got {tuple(X.shape)} and {tuple(Y.shape)}{_remedy(X, Y)}."
        )
    single = _last_is_samples(X, Y)
    if single:
        X, Y = X.unsqueeze(-2), Y.unsqueeze(-1)
    if X.shape[-1] == 0 or Y.numel() == 0:
        raise ValueError(f"Expected at least one sample and one column but got `X` {tuple(X.shape)}.")
    batch = common_batch("X", X.shape[:-3], "Y", Y.shape[:-2])
    N, m = Y.shape[-2:]
    weight = None
    if sample_weight is not None:
        weight = _as_weight(sample_weight, N, m, single, Y)
        batch = common_batch("sample_weight", weight.shape[:-2], "Y", batch)
        weight = weight.expand(*batch, N, m)
    return CanonicalShapes(X, Y.expand(*batch, N, m), weight, batch, single)


def _remedy(X: Tensor, Y: Tensor) -> str:
    """Remedy for shapes that do not fit, where it is clear."""
    if X.dim() == 1 and X.shape == Y.shape:
        return "; one column is X[:, None]"
    if X.dim() == Y.dim() > 1 and X.shape[:-1] == Y.shape[:-1] and Y.shape[-1] == 1:
        return "; one channel is Y.squeeze(-1)"
    if X.dim() > 1 and Y.dim() > 0 and X.shape[-1] == Y.shape[-1]:
        return "; a sample is a row of X, so try X.mT"
    return ""


def canonical_shapes(
    X: Float[Tensor, "*batch N m n"],
    Y: Float[Tensor, "*batch N m"],
    sample_weight: Float[Tensor, "*batch N"] | None = None,
) -> CanonicalShapes:
    """Check types, shapes and values, and add the channel dimension to one-channel input.

    Raises:
        TypeError: X or Y is not a floating tensor, or their dtypes or devices differ.
        ValueError: shapes do not fit, or values are not finite.
    """
    values = checked_shapes(X, Y, sample_weight)
    _check_finite("X", X)
    _check_finite("Y", Y)
    refuse_magnitude(Y.detach().abs().max())
    if sample_weight is not None:
        N, m = values.Y.shape[-2:]
        _check_weight(_as_weight(sample_weight, N, m, values.single_channel, values.Y))
    return values


def linear_problem(
    X: Float[Tensor, "*batch N m n"],
    Y: Float[Tensor, "*batch N m"],
    sample_weight: Float[Tensor, "*batch N"] | None = None,
) -> LinearProblem:
    """Check X, Y and weights as :meth:`LeastSquares.fit` takes them, and orthonormalise the columns of X.

    Raises:
        TypeError: X or Y is not a floating tensor, or their dtypes or devices differ.
        ValueError: shapes do not fit, values are not finite, there are fewer values than coefficients.
        RankDeficientError: columns of X are linearly dependent.
    """
    v = canonical_shapes(X, Y, sample_weight)
    N, m, n = v.X.shape[-3:]
    if N * m < n:
        raise ValueError(f"Expected at least {n} values for {n} coefficients but got {N} samples x {m}; add samples.")
    flat = v.batch.numel()
    # weights of 0 that differ between problems give each problem its own basis; otherwise a shared X is kept once
    shared = v.X.shape[:-3].numel() == 1 and (v.sample_weight is None or bool((v.sample_weight > 0).all()))
    x_batch = v.X.shape[:-3] if shared else v.batch
    basis, to_coef = orthonormalise(v.X.expand(*x_batch, N, m, n).reshape(-1, N, m, n), v.sample_weight)
    weight = None if v.sample_weight is None else v.sample_weight.reshape(flat, N, m)
    return LinearProblem(basis, to_coef, v.Y.reshape(flat, N, m), weight, v.batch, v.single_channel)


def common_batch(name: str, shape: torch.Size, other: str, other_shape: torch.Size) -> torch.Size:
    try:
        # torch.broadcast_shapes would import sympy
        return torch.Size(np.broadcast_shapes(shape, other_shape))
    except ValueError:
        raise ValueError(
            f"Expected batch dimensions of `{name}` and `{other}` that broadcast "
            f"but got {tuple(shape)} and {tuple(other_shape)}."
        ) from None


def _last_is_samples(X: Tensor, Y: Tensor) -> bool:
    """Whether Y is (*, N) rather than (*, N, m), by the rule in the docstring of ``mkc_torch.linear``."""
    if X.dim() == 2 or Y.dim() == 1 or X.shape[-3] != Y.shape[-2]:
        return True
    before, last = Y.shape[-2:]
    return last > X.shape[-1] and last > min(before, MAX_IMPLIED_CHANNELS)


def _as_weight(sample_weight: Tensor, N: int, m: int, single_channel: bool, Y: Tensor) -> Tensor:
    refuse_no_tensor("sample_weight", sample_weight, "a tensor")
    refuse_complex("sample_weight", sample_weight)
    weight = sample_weight.to(Y)
    if weight.dim() >= 1 and weight.shape[-1] == N and (single_channel or weight.shape[-2:] != (N, m)):
        weight = weight.unsqueeze(-1)
    if weight.dim() < 2 or weight.shape[-2] != N or weight.shape[-1] not in (1, m):
        raise ValueError(
            f"Expected argument `sample_weight` of shape (*, {N}) or (*, {N}, {m}) but got {tuple(weight.shape)}; "
            "pass one weight for each sample."
        )
    return weight


def _check_weight(weight: Float[Tensor, "*batch N m"]) -> None:
    _check_finite("sample_weight", weight)
    if (weight < 0).any():
        raise ValueError(f"Expected argument `sample_weight` to be >= 0 but got {weight.min().item()}.")
    if (weight > torch.finfo(weight.dtype).max ** 0.5).any():
        raise ValueError(f"Expected argument `sample_weight` to have finite squares but got {weight.max():.3g}.")
    if (weight.sum(-2) <= 0).any():
        raise ValueError(
            "Expected argument `sample_weight` to be positive somewhere in every channel but got all zeros."
        )

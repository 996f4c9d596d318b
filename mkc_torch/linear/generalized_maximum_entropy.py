"""Generalised maximum entropy: coefficients and errors are means of maximum-entropy distributions on given supports."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole, refuse_complex
from mkc_torch._support.arrays import Data
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._problem import CanonicalShapes, canonical_shapes

if TYPE_CHECKING:
    from jaxtyping import Float


class GeneralizedMaximumEntropy(LinearEstimator):
    """Coefficients ``θ = Z p`` and errors ``ε = V w`` with the largest entropy that satisfy ``Y = X θ + ε``, (30)-(39).

    Each coefficient and each error is the mean of a distribution on its own support points. The distributions are as
    uniform as the data allow, so dependent columns of X, and fewer samples than coefficients, are allowed. The supports
    are prior knowledge: coefficients shrink towards the middle of their supports. The estimator is not robust to
    outliers.

    The concave problem is solved through its dual, one multiplier for each value of Y, by Newton's method.

    Args:
        coef_support: support points of the coefficients, a tensor that broadcasts to (n, l); or a half-width c for
            ``(-c, -c/2, 0, c/2, c)``.
        error_support: support points of the errors in the unit of Y, a tensor that broadcasts to (*, N, m, l); or a
            half-width. None takes three standard deviations of each channel of Y, or 1.1 times its largest magnitude if
            that is more, so that a solution always exists.
        tol: largest violation of ``Y = X θ + ε``, in units of the errors' half-width.
        max_iter: largest number of Newton steps.

    Attributes, after ``fit``:
        coef_: (*, n).
        error_: ε, (*, N, m).
        probabilities_: p, (*, n, l).
        error_probabilities_: w, (*, N, m, l).
        entropy_: -Σ p log p - Σ w log w, (35), in nats, (*,).
        n_iter_: number of steps of each problem, (*,).
        weights_: all 1, (*, N, m).

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    References:
        A. Golan, G. Judge, D. Miller, Maximum Entropy Econometrics (1996); G. Indiveri, Entropy 11 (2009), (30)-(39).

    Example:
        >>> X = torch.tensor([[1.0, 1.0], [1.0, 1.0], [1.0, 1.0]])  # two equal columns share their effect
        >>> fit = GeneralizedMaximumEntropy(100.0, 1.0).fit(X, torch.tensor([4.0, 4.0, 4.0]))
        >>> fit.coef_
        tensor([2.0000, 2.0000])
    """

    error_: Float[Tensor, "*batch N m"]
    probabilities_: Float[Tensor, "*batch n l"]
    error_probabilities_: Float[Tensor, "*batch N m l"]
    entropy_: Float[Tensor, "*batch"]
    n_iter_: Tensor

    def __init__(
        self,
        coef_support: float | Float[Tensor, "#n l"],
        error_support: float | Float[Tensor, "*#batch #N #m l"] | None = None,
        *,
        tol: float = 1e-10,
        max_iter: int = 200,
    ) -> None:
        super().__init__()
        self.coef_support = _checked_support("coef_support", coef_support)
        self.error_support = None if error_support is None else _checked_support("error_support", error_support)
        self.tol = checked_number("tol", tol, 0.0, 1.0, advice="1e-10 suits float64")
        self.max_iter = checked_whole("max_iter", max_iter, 1, "200 is ample")

    @torch.no_grad()
    def fit(self, X: Data, Y: Data, sample_weight: Data | None = None) -> GeneralizedMaximumEntropy:
        """Fit ``Y ~ X coef`` in float64; X is of any rank, and otherwise as in :meth:`LeastSquares.fit`.

        A weight of 2 is a sample that occurs twice.

        Raises:
            ValueError: bad input as in :meth:`LeastSquares.fit`, or no coefficients within their supports explain Y
                with errors within theirs.
        """
        X, Y, sample_weight = self._tensors(X, Y, sample_weight)
        given = canonical_shapes(X, Y, sample_weight)
        N, m, n = given.X.shape[-3:]
        B = given.batch.numel()
        rows = given.X.expand(*given.batch, N, m, n).reshape(B, N * m, n).double()
        target = given.Y.reshape(B, N * m).double()
        weight = torch.ones_like(target)
        if given.sample_weight is not None:
            weight = given.sample_weight.reshape(B, N * m).double()
        z = self._broadcast("coef_support", self.coef_support, (n,), target)
        v = self._error_points(given).reshape(B, N * m, -1)

        dual = _Dual(rows, target, weight, z, v)
        multiplier, tilt, n_iter = dual.solve(self.tol, self.max_iter, (N, m))
        p, q = dual.probabilities(multiplier, tilt)
        coef, error = (p * z).sum(-1), (q * v).sum(-1)
        entropy = _entropy(p).sum(-1) + (weight * _entropy(q)).sum(-1)
        self._single_channel = given.single_channel

        def restore(value: Tensor, *shape: int) -> Tensor:
            return value.to(Y.dtype).reshape((*given.batch, *shape))

        self.coef_ = restore(coef, n)
        self.weights_ = torch.ones_like(given.Y)
        self.error_ = restore(error, N, m)
        self.probabilities_ = restore(p, n, p.shape[-1])
        self.error_probabilities_ = restore(q, N, m, q.shape[-1])
        self.entropy_ = restore(entropy)
        self.n_iter_ = n_iter.reshape(given.batch)
        return self

    @staticmethod
    def _broadcast(name: str, support: Tensor, shape: tuple[int, ...], like: Tensor) -> Tensor:
        points = support.shape[-1]
        try:
            return support.to(like).expand(*shape, points)
        except RuntimeError:
            raise ValueError(
                f"Expected argument `{name}` to broadcast to {(*shape, points)} but got {tuple(support.shape)}."
            ) from None

    def _error_points(self, given: CanonicalShapes) -> Float[Tensor, "*batch N m l"]:
        Y = given.Y.double()
        if self.error_support is not None:
            return self._broadcast("error_support", self.error_support, tuple(Y.shape), Y)
        used = torch.ones_like(Y) if given.sample_weight is None else given.sample_weight.double()
        share = used / used.sum(-2, keepdim=True)
        centred = Y - (share * Y).sum(-2, keepdim=True)
        spread = 3.0 * (share * centred.square()).sum(-2, keepdim=True).sqrt()
        largest = 1.1 * Y.abs().amax(-2, keepdim=True)
        half = torch.maximum(spread, largest)
        half = torch.where(half > 0, half, 1.0)
        return (half.unsqueeze(-1) * _POINTS.to(Y)).expand(*Y.shape, _POINTS.shape[0])


_POINTS = torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0], dtype=torch.float64)
"""Default support points in half-widths, (30)-(31)."""

_END = 1e-9
"""Distance from the end of the support, in half-widths, below which an error is at the end."""

_LARGEST = 1e8
"""Largest multiplier, in units of the errors' half-width; only errors at the end of their support exceed it."""


def _checked_support(name: str, support: float | Tensor) -> Tensor:
    """Support points along the last dimension; raises if they are invalid."""
    if not isinstance(support, Tensor):
        half = checked_number(name, support, advice=f"points are a tensor, torch.as_tensor({name})")
        return half * _POINTS
    refuse_complex(name, support)
    if support.dim() == 0 or support.shape[-1] < 2 or not bool(torch.isfinite(support).all()):
        raise ValueError(
            f"Expected argument `{name}` of finite values with at least 2 points in the last dimension "
            f"but got shape {tuple(support.shape)}."
        )
    if bool((support.amax(-1) <= support.amin(-1)).any()):
        raise ValueError(f"Expected argument `{name}` of points that differ but got {support.tolist()}.")
    return support


def _entropy(p: Tensor) -> Tensor:
    return -(p * torch.log(p.clamp(min=torch.finfo(p.dtype).tiny))).sum(-1)


class _Dual:
    """``M(λ) = Σ_i w_i (λ_i y_i + log Σ_k exp(-λ_i v_ik)) + Σ_j log Σ_k exp(-a_j z_jk)`` with ``a = Xᵀ (w λ)``.

    It is convex; its gradient is ``w (y - X θ - ε)``. Errors are in units of their half-width. The exponents ``a`` are
    updated along with λ, since for wide supports of the coefficients they are small differences of large terms.
    """

    def __init__(self, rows: Tensor, target: Tensor, weight: Tensor, z: Tensor, v: Tensor) -> None:
        self.unit = v.abs().amax(-1)
        self.rows = rows / self.unit.unsqueeze(-1)
        self.target = target / self.unit
        self.weight = weight
        self.z = z
        self.v = v / self.unit.unsqueeze(-1)

    def value(self, multiplier: Float[Tensor, "B R"], tilt: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
        errors = torch.logsumexp(-multiplier.unsqueeze(-1) * self.v, -1)
        coef = torch.logsumexp(-tilt.unsqueeze(-1) * self.z, -1)
        return (self.weight * (multiplier * self.target + errors)).sum(-1) + coef.sum(-1)

    def probabilities(self, multiplier: Tensor, tilt: Tensor) -> tuple[Float[Tensor, "B n l"], Float[Tensor, "B R k"]]:
        return torch.softmax(-tilt.unsqueeze(-1) * self.z, -1), torch.softmax(-multiplier.unsqueeze(-1) * self.v, -1)

    def step(self, multiplier: Tensor, tilt: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the residual of ``y = X θ + ε``, and the Newton step of λ and a."""
        p, q = self.probabilities(multiplier, tilt)
        coef, error = (p * self.z).sum(-1), (q * self.v).sum(-1)
        gap = self.target - torch.matmul(self.rows, coef.unsqueeze(-1)).squeeze(-1) - error
        root = (p * (self.z - coef.unsqueeze(-1)).square()).sum(-1).sqrt()
        spread = (q * (self.v - error.unsqueeze(-1)).square()).sum(-1)
        spread = spread.clamp(min=torch.finfo(gap.dtype).eps ** 2)
        # the Hessian is diagonal except for the n coefficients, so Woodbury's identity leaves an (n, n) system
        scaled = self.rows * root.unsqueeze(-2)
        inner = torch.matmul(scaled.mT, scaled * (self.weight / spread).unsqueeze(-1))
        inner.diagonal(dim1=-2, dim2=-1).add_(1.0)
        moment = torch.matmul(scaled.mT, (self.weight / spread * gap).unsqueeze(-1))
        shared = torch.cholesky_solve(moment, torch.linalg.cholesky_ex(inner).L)
        change = (torch.matmul(scaled, shared).squeeze(-1) - gap) / spread
        summed = torch.matmul(self.rows.mT, (self.weight * change).unsqueeze(-1)).squeeze(-1)
        wide = root > 1e-3 * (self.z.amax(-1) - self.z.amin(-1))
        return gap, change, torch.where(wide, -shared.squeeze(-1) / torch.where(wide, root, 1.0), summed)

    def solve(self, tol: float, max_iter: int, shape: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
        """Return multipliers (B, R), exponents a (B, n) and numbers of steps (B,)."""
        multiplier, tilt = torch.zeros_like(self.target), torch.zeros_like(self.rows[:, 0])
        used = self.weight > 0
        n_iter = torch.zeros(self.target.shape[0], dtype=torch.long, device=multiplier.device)
        best = self.value(multiplier, tilt)
        for iteration in range(max_iter + 1):
            gap, change, change_tilt = self.step(multiplier, tilt)
            size = torch.where(used, gap.abs(), 0.0)
            left = ~(size.amax(-1) <= tol)
            if not bool(left.any()):
                self._refuse_ends(multiplier, shape)
                return multiplier, tilt, n_iter
            # errors at the end of their support have ever larger multipliers, and steps that are not finite
            steps = torch.cat([change, change_tilt], -1).isfinite().all(-1)
            stuck = left & ~(steps & (multiplier.abs().amax(-1) <= _LARGEST))
            if iteration == max_iter or bool(stuck.any()):
                left = stuck if bool(stuck.any()) else left
                break
            slope = (self.weight * gap * change).sum(-1)
            length = left.to(gap).unsqueeze(-1)
            for _ in range(60):
                trial, trial_tilt = multiplier + length * change, tilt + length * change_tilt
                value = self.value(trial, trial_tilt)
                low = value <= best + 1e-4 * length.squeeze(-1) * slope + 1e-14 * best.abs()
                if bool(low.all()):
                    break
                length = torch.where(low.unsqueeze(-1), length, 0.5 * length)
            multiplier, tilt, best = trial, trial_tilt, value
            n_iter = n_iter + left
        problem = int(torch.where(left, size.amax(-1), -1.0).argmax())
        place = int(size[problem].argmax())
        raise _infeasible(place, shape, f"{float((size * self.unit)[problem].max()):.3g} remains unexplained")

    def _refuse_ends(self, multiplier: Tensor, shape: tuple[int, int]) -> None:
        """Refuse errors at the end of their support: rounding decides whether steps towards them converge."""
        error = (torch.softmax(-multiplier.unsqueeze(-1) * self.v, -1) * self.v).sum(-1)
        left = torch.minimum(self.v.amax(-1) - error, error - self.v.amin(-1))
        ends = (self.weight > 0) & (left < _END)
        if bool(ends.any()):
            problem, place = (int(index) for index in ends.nonzero()[0])
            size = float((error * self.unit)[problem, place])
            raise _infeasible(place, shape, f"the error has to be {size:.3g}, the end of its support")


def _infeasible(place: int, shape: tuple[int, int], why: str) -> ValueError:
    """The error for supports that are too narrow at the sample and channel of a flat index."""
    sample, channel = divmod(place, shape[1])
    at = f"sample {sample}" + (f", channel {channel}" if shape[1] > 1 else "")
    return ValueError(
        f"Expected supports within which `Y = X coef + error` can hold but at {at} {why}; widen `coef_support` or "
        "`error_support`."
    )

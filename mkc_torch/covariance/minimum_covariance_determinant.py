"""The minimum covariance determinant."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole, format_value
from mkc_torch.covariance._chi_square import chi_square_quantile
from mkc_torch.covariance._concentration import Support, concentrate
from mkc_torch.covariance._corrections import consistency_factor, small_sample_factor
from mkc_torch.covariance._moments import correlation, mahalanobis_distance, moments_of
from mkc_torch.covariance._one_column import smallest_variance
from mkc_torch.covariance._sample import checked_sample, real_tensor, working_dtype
from mkc_torch.covariance.exact_fit import refuse_exact_fit
from mkc_torch.linear._estimator import Fitted
from mkc_torch.linear._problem import common_batch

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from mkc_torch._support.arrays import Data
    from mkc_torch.covariance._sample import Sample


class MinimumCovarianceDeterminant(Fitted):
    """Location and scatter of the h samples whose covariance has the smallest determinant, then reweighted.

    Up to N - h samples may be arbitrarily far out. A tight cluster at a moderate distance can have the smallest
    determinant, more easily with more columns. The search is FastMCD: two concentration steps from ``starts`` random
    sets of p + 1 samples, then the best candidates to convergence; beyond 1500 samples the first steps use 1500 of
    them. Up to 200 samples, the support is then improved by exchanging single samples. A single column is solved
    exactly. The estimate is affine equivariant.

    The covariance of the h samples is corrected to be consistent for Gaussian data, and for the bias of small samples.
    The reweighting step takes mean and covariance of all samples within the ``cutoff`` quantile of the distances, and
    corrects them by one of two factors:

    - "share": the factor of the share of samples kept. It is right for clean samples, small samples included, and is
      used by R's robustbase. Outliers inflate it: with 20 % of them variances are 2.4 (p = 1), 1.6 (p = 2) and 1.3
      (p = 5) times those of the inliers, with 40 % 4.9, 2.6 and 1.7 times, which hides near outliers; the correlations
      are right.
    - "cutoff": the factor of the cutoff itself. Variances are then within 1.0 to 1.2 times, but the scatter of small
      clean samples is too small: 0.7 to 0.95 times at N = 20 to 100.

    Both factors agree as N grows.

    Args:
        support_fraction: alternative to ``h``, in [0.5, 1]: 0.5, the default, is h = (N + p + 1) // 2, the highest
            breakdown point; 1 is h = N; h is linear in between, rounded down.
        h: number of samples in the support, (N + p + 1) // 2 <= h <= N.
        reweight: whether to reweight, which keeps the breakdown point and gains efficiency.
        cutoff: quantile of the chi-square distribution of p degrees of freedom, in (0, 1); samples whose squared
            distance exceeds it have weight 0.
        consistency: "share" or "cutoff", the correction of the reweighted covariance.
        starts: number of random starts. A single start without outliers is enough. With a share ε of outliers, all
            starts contain outliers with probability ``(1 - (1 - ε)^(p + 1))^starts``; take more for more columns.
        seed: seed of the starts.

    Attributes, after ``fit`` (``*`` are batch dimensions; lengths in the unit of the data):
        location_, covariance_: reweighted, (*, p) and (*, p, p). Differentiable in the samples of weight 1; the choice
            of these samples is constant.
        correlation_: correlations of ``covariance_``, (*, p, p).
        raw_location_, raw_covariance_: location and covariance before the reweighting, with both corrections.
        support_: mask of the h samples with the smallest determinant, bool (*, N).
        weights_: 1 for samples used by ``location_``, else 0, (*, N).
        distances_: robust Mahalanobis distances by ``location_`` and ``covariance_``, dimensionless, (*, N).
        distance_cutoff_: square root of the chi-square quantile, a number; distances of outliers exceed it.
        objective_: log determinant of the covariance (divisor h - 1) of the support, uncorrected, (*,).
        h_: number of samples in the support.
        n_iter_, converged_: number of steps, and whether they converged, (*,); a single column needs no steps.

    Raises:
        TypeError, ValueError: an argument of another type, or out of range.

    References:
        Rousseeuw & Van Driessen, "A fast algorithm for the minimum covariance determinant estimator", Technometrics 41
        (1999) 212-223.
        Croux & Haesbroeck (1999) and Pison, Van Aelst & Willems (2002), Metrika 55, 111-123: the corrections.

    Example:
        >>> X = torch.randn(100, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        >>> X[:40] += 100.0
        >>> fit = MinimumCovarianceDeterminant().fit(X)
        >>> bool((fit.location_.abs() < 0.3).all()), int((fit.distances_ > fit.distance_cutoff_).sum())
        (True, 40)
    """

    _fit_takes = "X"

    location_: Float[Tensor, "*batch p"]
    covariance_: Float[Tensor, "*batch p p"]
    correlation_: Float[Tensor, "*batch p p"]
    raw_location_: Float[Tensor, "*batch p"]
    raw_covariance_: Float[Tensor, "*batch p p"]
    support_: Bool[Tensor, "*batch N"]
    weights_: Float[Tensor, "*batch N"]
    distances_: Float[Tensor, "*batch N"]
    distance_cutoff_: float
    objective_: Float[Tensor, "*batch"]
    h_: int
    n_iter_: int
    converged_: Bool[Tensor, "*batch"]

    def __init__(
        self,
        support_fraction: float | None = None,
        h: int | None = None,
        *,
        reweight: bool = True,
        cutoff: float = 0.975,
        consistency: Literal["share", "cutoff"] = "share",
        starts: int = 500,
        seed: int = 0,
    ) -> None:
        if support_fraction is not None and h is not None:
            raise ValueError("Expected `support_fraction` or `h` but got both; pass one of them.")
        if support_fraction is not None:
            support_fraction = checked_number("support_fraction", support_fraction, 0.5, 1.0, "[]", "0.75 is usual")
        if not isinstance(reweight, bool):
            raise TypeError(f"Expected argument `reweight` to be True or False but got {reweight!r}.")
        if consistency not in ("share", "cutoff"):
            raise ValueError(
                f"Expected argument `consistency` to be 'share' or 'cutoff' but got {format_value(consistency)}."
            )
        self.support_fraction = support_fraction
        self.h = None if h is None else checked_whole("h", h, 1, "it counts samples; None takes the default")
        self.reweight = reweight
        self.cutoff = checked_number("cutoff", cutoff, 0.0, 1.0, "()", "it is a probability, and 0.975 is usual")
        self.consistency = consistency
        self.starts = checked_whole("starts", starts, 1, "500 is usual")
        self.seed = checked_whole("seed", seed)

    def fit(self, X: Data) -> MinimumCovarianceDeterminant:
        """Fit location and scatter.

        Args:
            X: samples (*, N, p), N > p + 1: a tensor of float32 or float64, an array or a data frame. Computed in
                float64; results have the dtype of X and carry its gradient.

        Raises:
            TypeError: X is neither a real floating tensor nor an array of numbers.
            ValueError: a value is not finite, samples are too few, or ``h`` is out of range.
            ExactFitError: h samples, or all samples that the reweighting keeps, lie on a hyperplane.
        """
        sample = checked_sample("X", X)
        N, p = sample.shape
        h, fraction = self._coverage(N, p)
        with torch.no_grad():
            found = self._search(sample, h)
            refuse_exact_fit(sample, found.counts)
        mean, covariance = moments_of(sample.points, found.counts, sample.centre)
        factor = consistency_factor(h / N, p)
        factor *= small_sample_factor(N, p, fraction, reweighted=False) if h < N else 1.0
        location, scatter, counts = mean, covariance * factor, found.counts
        squared_cutoff = chi_square_quantile(self.cutoff, p)
        self.raw_location_, self.raw_covariance_ = sample.restore(location), _restored(sample, scatter)
        if self.reweight:
            with torch.no_grad():
                counts = mahalanobis_distance(sample.points, location, scatter).square() <= squared_cutoff
            share = self.cutoff if self.consistency == "cutoff" else None
            location, scatter = _reweighted(sample, counts, fraction if h < N else 1.0, share)
        self._location, self._scatter = location.reshape(*sample.batch, p), scatter.reshape(*sample.batch, p, p)
        self.location_, self.covariance_ = sample.restore(location), _restored(sample, scatter)
        self.correlation_ = sample.restore(correlation(scatter))
        self.support_ = sample.restore(found.counts)
        self.weights_ = sample.restore(counts.to(sample.dtype))
        self.distances_ = sample.restore(mahalanobis_distance(sample.points, location, scatter))
        self.distance_cutoff_ = math.sqrt(squared_cutoff)
        self.objective_ = sample.restore(torch.logdet(covariance))
        self.h_, self.n_iter_ = h, found.n_iter
        self.converged_ = sample.restore(found.converged)
        return self

    def mahalanobis(self, X: Data) -> Float[Tensor, "*batch M"]:
        """Robust distances (*, M) of other samples by ``location_`` and ``covariance_``, in the fit's dtype.

        Args:
            X: samples (*, M, p) in the unit of the fitted samples; batch dimensions broadcast with the fit's.

        Raises:
            NotFittedError: before ``fit``.
            TypeError, ValueError: as in :meth:`fit`, or X has another number of columns or other batch dimensions.
        """
        p = self.location_.shape[-1]
        points = real_tensor("X", X)
        if points.dim() < 2 or points.shape[-1] != p:
            raise ValueError(
                f"Expected argument `X` of shape (*, M, {p}) but got {tuple(points.shape)}; pass the columns of the "
                "fit, and a single sample as X.unsqueeze(0)."
            )
        common_batch("X", points.shape[:-2], "location_", self.location_.shape[:-1])
        points = points.to(working_dtype(points))
        return mahalanobis_distance(points, self._location, self._scatter).to(self.location_.dtype)

    def _coverage(self, N: int, p: int) -> tuple[int, float]:
        """h, and the corresponding support fraction of the small-sample correction."""
        half = (N + p + 1) // 2
        if self.h is None:
            fraction = 0.5 if self.support_fraction is None else self.support_fraction
            # rounding must not remove a sample
            return math.floor(2 * half - N + 2 * (N - half) * fraction + 1e-9), fraction
        if not half <= self.h <= N:
            raise ValueError(
                f"Expected argument `h` between {half}, (N + p + 1) // 2, and the {N} samples but got {self.h}."
            )
        return self.h, 0.5 + 0.5 * (self.h - half) / (N - half) if half < N else 1.0

    def _search(self, sample: Sample, h: int) -> Support:
        N, p = sample.shape
        points = sample.standardised
        if p > 1 and h < N:
            return concentrate(points, h, starts=self.starts, seed=self.seed)
        if h < N:
            counts = smallest_variance(points[..., 0], h)
        else:
            counts = torch.ones(points.shape[:2], dtype=torch.bool, device=points.device)
        return Support(counts, 0, torch.ones_like(counts[:, 0]))


def _reweighted(
    sample: Sample, counts: Bool[Tensor, "B N"], fraction: float, share: float | None
) -> tuple[Float[Tensor, "B p"], Float[Tensor, "B p p"]]:
    """Mean and corrected covariance of the samples within the cutoff; uncorrected if these are all samples.

    Args:
        sample: all samples.
        counts: mask of the samples within the cutoff.
        fraction: support fraction.
        share: share of Gaussian samples within the cutoff; None takes the share of these samples.
    """
    N, p = sample.shape
    number = counts.sum(-1).tolist()
    if min(number) <= p:
        raise ValueError(
            f"Expected argument `cutoff` to leave more than {p} samples but only {min(number)} are within it; raise it."
        )
    # support samples off a plane can be far by the distances of the others
    refuse_exact_fit(sample, counts)
    mean, covariance = moments_of(sample.points, counts, sample.centre)
    small = small_sample_factor(N, p, fraction, reweighted=True)
    factor = [consistency_factor(share or k / N, p) * small if k < N else 1.0 for k in number]
    return mean, covariance * covariance.new_tensor(factor).view(-1, 1, 1)


def _restored(sample: Sample, covariance: Float[Tensor, "B p p"]) -> Float[Tensor, "*batch p p"]:
    """A covariance in the user's dtype; ValueError if its variances overflow or underflow."""
    variance = covariance.detach().diagonal(dim1=-2, dim2=-1)
    kind = torch.finfo(sample.dtype)
    if not ((variance >= kind.tiny) & (variance <= kind.max)).all():
        raise ValueError(
            f"Expected argument `X` with variances in the range of {sample.dtype} but got {float(variance.min()):.3g} "
            f"to {float(variance.max()):.3g}; choose another unit."
        )
    return sample.restore(covariance)

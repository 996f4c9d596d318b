"""Factors that correct the covariance of the most central samples to that of all Gaussian samples.

Croux & Haesbroeck, "Influence function and efficiency of the minimum covariance determinant scatter matrix estimator",
Journal of Multivariate Analysis 71 (1999) 161-190: large samples. Pison, Van Aelst & Willems, "Small sample corrections
for LTS and MCD", Metrika 55 (2002) 111-123: small samples, by formulas fitted to simulations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from mkc_torch.covariance._chi_square import chi_square_cdf, chi_square_quantile


def consistency_factor(share: float, p: int) -> float:
    """``share / P(χ²_{p+2} <= χ²_{p,share})``: covariance of all samples over that of the most central ``share``."""
    return 1.0 if share >= 1.0 else share / chi_square_cdf(chi_square_quantile(share, p), p + 2)


class _Shrinkage(NamedTuple):
    """Mean of an estimate from N samples of identity covariance, ``1 - exp(c) / N^b``.

    For p > 2 the mean at N = 2p² and 3p² is ``1 + γ / p^β``, which determines c and b.
    """

    at_p1: tuple[float, float]  # c and b for p = 1
    at_p2: tuple[float, float]  # c and b for p = 2
    at_twice: tuple[float, float]  # γ and β at N = 2p²
    at_thrice: tuple[float, float]  # γ and β at N = 3p²

    def at(self, N: int, p: int) -> float:
        if p <= 2:
            c, b = self.at_p1 if p == 1 else self.at_p2
        else:
            twice, thrice = (math.log(-gamma / p**beta) for gamma, beta in (self.at_twice, self.at_thrice))
            b = (twice - thrice) / math.log(1.5)
            c = twice + b * math.log(2.0 * p * p)
        return 1.0 - math.exp(c) / N**b


# coverages 1/2 and 7/8; the authors' numbers, as in their program and in R's robustbase
_RAW = (
    _Shrinkage(
        at_p1=(0.262024211897096, 0.604756680630497),
        at_p2=(0.673292623522027, 0.691365864961895),
        at_twice=(-1.42764571687802, 1.26263336932151),
        at_thrice=(-1.06141115981725, 1.28907991440387),
    ),
    _Shrinkage(
        at_p1=(-0.351584646688712, 1.01646567502486),
        at_p2=(0.446537815635445, 1.06690782995919),
        at_twice=(-0.455179464070565, 1.11192541278794),
        at_thrice=(-0.294241208320834, 1.09649329149811),
    ),
)
_REWEIGHTED = (
    _Shrinkage(
        at_p1=(1.11098143415027, 1.5182890270453),
        at_p2=(3.11101712909049, 1.91401056721863),
        at_twice=(-1.02842572724793, 1.67659883081926),
        at_thrice=(-0.26800273450853, 1.35968562893582),
    ),
    _Shrinkage(
        at_p1=(-0.66046776772861, 0.88939595831888),
        at_p2=(0.79473550581058, 1.10081930350091),
        at_twice=(-0.544482443573914, 1.25994483222292),
        at_thrice=(-0.343791072183285, 1.25159004257133),
    ),
)


def small_sample_factor(N: int, p: int, fraction: float, *, reweighted: bool) -> float:
    """Factor that removes the bias of a consistent covariance at N Gaussian samples of p columns.

    Args:
        N, p: samples and columns; below 4p samples the factor is that of 4p samples.
        fraction: support fraction in [0.5, 1]; the shrinkage is linear between 0.5, 0.875 and 1.
        reweighted: whether the covariance is reweighted or raw.
    """
    # extrapolated to fewer samples, the formula exceeds a shrinkage and is negative below 3p
    half, most = (shrinkage.at(max(N, 4 * p), p) for shrinkage in (_REWEIGHTED if reweighted else _RAW))
    if fraction <= 0.875:
        mean = half + (most - half) * (fraction - 0.5) / 0.375
    else:
        mean = most + (1.0 - most) * (fraction - 0.875) / 0.125
    return 1.0 / mean

"""Factors that make a covariance of the most central samples estimate that of all Gaussian ones.

Croux & Haesbroeck, "Influence function and efficiency of the minimum covariance determinant scatter matrix estimator",
Journal of Multivariate Analysis 71 (1999) 161-190: large samples. Pison, Van Aelst & Willems, "Small sample corrections
for LTS and MCD", Metrika 55 (2002) 111-123: small ones, by formulas fitted to simulations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from mkc_torch.covariance._chi_square import chi_square_cdf, chi_square_quantile


def consistency_factor(share: float, p: int) -> float:
    """``share / P(χ²_{p+2} <= χ²_{p,share})``: the covariance of all over that of the most central ``share``."""
    return 1.0 if share >= 1.0 else share / chi_square_cdf(chi_square_quantile(share, p), p + 2)


class _Shrinkage(NamedTuple):
    """The mean of an estimate at N samples of identity covariance is ``1 - exp(c) / N^b``.

    For p > 2 it is known at N = 2p² and 3p² as ``1 + γ / p^β``, which gives c and b.
    """

    one: tuple[float, float]  # c and b for p = 1
    two: tuple[float, float]  # for p = 2
    at_twice: tuple[float, float]  # γ and β at N = 2p²
    at_thrice: tuple[float, float]  # at N = 3p²

    def at(self, N: int, p: int) -> float:
        if p <= 2:
            c, b = self.one if p == 1 else self.two
        else:
            twice, thrice = (math.log(-gamma / p**beta) for gamma, beta in (self.at_twice, self.at_thrice))
            b = (twice - thrice) / math.log(1.5)
            c = twice + b * math.log(2.0 * p * p)
        return 1.0 - math.exp(c) / N**b


# coverage of a half and of seven eighths; the numbers are the authors', as their program and R's robustbase have them
_RAW = (
    _Shrinkage(
        one=(0.262024211897096, 0.604756680630497),
        two=(0.673292623522027, 0.691365864961895),
        at_twice=(-1.42764571687802, 1.26263336932151),
        at_thrice=(-1.06141115981725, 1.28907991440387),
    ),
    _Shrinkage(
        one=(-0.351584646688712, 1.01646567502486),
        two=(0.446537815635445, 1.06690782995919),
        at_twice=(-0.455179464070565, 1.11192541278794),
        at_thrice=(-0.294241208320834, 1.09649329149811),
    ),
)
_REWEIGHTED = (
    _Shrinkage(
        one=(1.11098143415027, 1.5182890270453),
        two=(3.11101712909049, 1.91401056721863),
        at_twice=(-1.02842572724793, 1.67659883081926),
        at_thrice=(-0.26800273450853, 1.35968562893582),
    ),
    _Shrinkage(
        one=(-0.66046776772861, 0.88939595831888),
        two=(0.79473550581058, 1.10081930350091),
        at_twice=(-0.544482443573914, 1.25994483222292),
        at_thrice=(-0.343791072183285, 1.25159004257133),
    ),
)


def small_sample_factor(N: int, p: int, fraction: float, *, reweighted: bool) -> float:
    """The factor that takes the bias at N Gaussian samples of p columns off a covariance made consistent already.

    Args:
        N, p: samples and columns; below 4p samples the factor is that of 4p.
        fraction: of the support, in [0.5, 1]; between 0.5, 0.875 and 1 the shrinkage is linear in it.
        reweighted: after the reweighting step, else the raw covariance.
    """
    # extrapolated to fewer samples the formula leaves the range of a shrinkage, and turns negative below 3p
    half, most = (shrinkage.at(max(N, 4 * p), p) for shrinkage in (_REWEIGHTED if reweighted else _RAW))
    if fraction <= 0.875:
        mean = half + (most - half) * (fraction - 0.5) / 0.375
    else:
        mean = most + (1.0 - most) * (fraction - 0.875) / 0.125
    return 1.0 / mean

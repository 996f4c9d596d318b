"""Robust Levenberg-Marquardt and MKC-EM on any differentiable residual.

:func:`minimise` minimises the MKC energy of a residual over its parameters at given σ and d. :func:`fit` also learns σ
and d of each channel. Both take a prior, bounds, equalities and inequalities, and a batch of problems at once.
"""

from mkc_torch._support.forward_mode import load_forward_mode
from mkc_torch.nonlinear._arguments import NoFitError
from mkc_torch.nonlinear.energy import Solution, minimise
from mkc_torch.nonlinear.likelihood import NonlinearFit, fit
from mkc_torch.nonlinear.prior import GaussianPrior

__all__ = ["GaussianPrior", "NoFitError", "NonlinearFit", "Solution", "fit", "load_forward_mode", "minimise"]

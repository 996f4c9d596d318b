"""Checks of the arguments of a problem."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

from mkc_torch._support.arguments import as_numbers, format_value, refuse_not_real, refuse_other_type
from mkc_torch._support.forward_mode import Residual
from mkc_torch.nonlinear._descent import within
from mkc_torch.nonlinear._problem import TANGENTS, Constraint, Problem, ProblemPoint
from mkc_torch.nonlinear.prior import GaussianPrior


class NoFitError(ValueError):
    """The residual cannot be fitted from the start: not finite, without finite derivatives, or beyond the domain."""


def refuse_out_of_reach(bound: Tensor, scale: Tensor) -> None:
    """Refuse a start whose residuals are too large for the domain: the head of the density would not fit.

    Args:
        bound: half-width of the domain, (*, m).
        scale: robust scale of the residuals at the start, (*, m).

    Raises:
        NoFitError: a scale is more than half of its bound.
    """
    narrow = bound < 2.0 * scale
    if bool(narrow.any()):
        first = tuple(narrow.nonzero()[0])
        channel = f" of channel {int(first[-1])}" if bound.shape[-1] > 1 else ""
        raise NoFitError(
            f"The start is too far from the data: expected a `bound` of at least two robust scales of the residuals"
            f"{channel}, {scale[first].item():.4g}, but got {bound[first].item():.4g}. Start nearer, or pass a `bound` "
            f"of {2.0 * scale[first].item():.4g} or more."
        )


def prepare(
    residual: Residual,
    start: Tensor,
    *,
    data: Any,
    weight: Tensor | None,
    prior: GaussianPrior | None,
    lower: Tensor | None,
    upper: Tensor | None,
    equality: Constraint | None,
    inequality: Constraint | None,
    jacobian: str,
) -> tuple[Problem, ProblemPoint]:
    """Return the checked problem and its start."""
    for name, function in (("residual", residual), ("equality", equality), ("inequality", inequality)):
        if not callable(function) and (name == "residual" or function is not None):
            raise TypeError(
                f"Expected argument `{name}` to be a function of the parameters but got {format_value(function)}; "
                "write lambda theta: ..."
            )
    refuse_not_real("start", start)
    if start.dtype in (torch.float16, torch.bfloat16):
        raise TypeError(f"Expected argument `start` of dtype float32 or float64 but got {start.dtype}; use .float().")
    if start.dim() == 0 or start.shape[-1] == 0 or start.numel() == 0:
        raise ValueError(f"Expected argument `start` of shape (*, p >= 1) but got {tuple(start.shape)}.")
    if not bool(torch.isfinite(start).all()):
        raise ValueError(
            f"Expected argument `start` to be finite but got {int((~torch.isfinite(start)).sum())} values that are "
            "not; start elsewhere."
        )
    if jacobian not in TANGENTS:
        raise ValueError(
            f"Expected argument `jacobian` to be 'forward', 'reverse' or 'reverse twice' but got {jacobian!r}; "
            "'forward' suits few parameters."
        )
    batch, p = start.shape[:-1], start.shape[-1]
    theta = start.detach().reshape(-1, p)
    box = _checked_box(lower, upper, theta)
    theta = within(box, theta)
    for leaf in tree_leaves(data):
        if data is not None:
            refuse_other_type("data", leaf, Tensor, "tensors", "let `residual` close over other values")
        if isinstance(leaf, Tensor) and leaf.shape[: len(batch)] != batch:
            raise ValueError(
                f"Expected every tensor in argument `data` to begin with the batch dimensions {tuple(batch)} of "
                f"`start` but got {tuple(leaf.shape)}."
            )
    flat = None if data is None else tree_map(lambda t: t.reshape(theta.shape[0], *t.shape[len(batch) :]), data)
    mean, precision = _checked_prior(prior, theta)
    problem = Problem(
        residual,
        flat,
        batch,
        jacobian,
        prior_mean=mean,
        prior_precision=precision,
        box=box,
        equality=equality,
        inequality=inequality,
    )
    first = problem.raw_residual(theta)
    if first.dim() != 3 or first.shape[1] == 0 or first.shape[2] == 0:
        raise ValueError(
            f"Expected `residual` to return a tensor (N, m) but got shape {tuple(first.shape[1:])}; "
            "one channel is (N, 1), residual.unsqueeze(-1)."
        )
    if first.dtype != theta.dtype:
        raise TypeError(
            f"Expected `residual` to return the dtype of `start`, {theta.dtype}, but got {first.dtype}; "
            "convert it, residual.to(start)."
        )
    full_weight, used = _checked_weight(weight, first, batch)
    count = torch.full_like(theta[:, 0], float(first[0].numel())) if used is None else used.sum((-2, -1)).to(theta)
    strength = 0 if precision is None else int(torch.linalg.matrix_rank(precision, hermitian=True))
    if float(count.min()) + strength < p:
        raise ValueError(
            f"Expected at least as many residuals as parameters, {p}, but got {int(count.min())}; "
            "add samples or a prior."
        )
    wrong = ~torch.isfinite(first) if used is None else ~torch.isfinite(first) & used
    if bool(wrong.any()):
        raise NoFitError(
            f"Expected `residual` to be finite at `start` but got {int(wrong.sum())} of {first.numel()} values that "
            "are not; start elsewhere, or leave those samples out by a weight of 0."
        )
    kinds = [
        torch.full((_constraint_count(name, c, theta[0]),), name == "inequality", device=theta.device)
        for name, c in (("equality", equality), ("inequality", inequality))
        if c is not None
    ]
    problem = replace(problem, weight=full_weight, used=used, is_inequality=torch.cat(kinds) if kinds else None)
    point = problem.at(theta)
    broken = int((~torch.isfinite(point.tangents)).sum())
    if broken:
        raise NoFitError(
            f"Expected `residual` to have finite derivatives at `start` but got {broken} values that are not; "
            "start elsewhere."
        )
    return problem, point


def per_channel(
    name: str, value: float | Tensor, like: Tensor, batch: torch.Size, *, infinite: bool, least: float = 0.0
) -> Tensor:
    """Return a positive parameter of every channel, (B, m), from a number, (m,) or (*, m)."""
    t = as_numbers(name, value, like.dtype, like.device).to(like)
    if not bool(((t > 0) & (t >= least) & (torch.isfinite(t) | infinite)).all()):
        kind = "positive" if infinite else "positive and finite"
        if least > 0.0:
            kind = f"in [{least:.4g}, inf]"
        raise ValueError(f"Expected argument `{name}` to be {kind} but got {value}.")
    m = like.shape[-1]
    try:
        return t.expand(*batch, m).reshape(-1, m)
    except RuntimeError:
        raise ValueError(
            f"Expected argument `{name}` to be a number, ({m},) or {(*batch, m)} but got {tuple(t.shape)}."
        ) from None


def _checked_box(lower: Tensor | None, upper: Tensor | None, theta: Tensor) -> tuple[Tensor, Tensor] | None:
    if lower is None and upper is None:
        return None
    p = theta.shape[-1]
    sides = []
    for name, side, default in (("lower", lower, -math.inf), ("upper", upper, math.inf)):
        t = as_numbers(name, default if side is None else side, theta.dtype, theta.device).to(theta)
        if t.dim() > 1 or (t.dim() == 1 and t.shape[0] != p) or bool(torch.isnan(t).any()):
            raise ValueError(
                f"Expected argument `{name}` to be {p} numbers, infinite for no bound, but got "
                f"{'NaN' if bool(torch.isnan(t).any()) else tuple(t.shape)}."
            )
        sides.append(t.expand(p))
    low, high = sides
    crossed = (low > high).nonzero().squeeze(-1).tolist()
    if crossed:
        raise ValueError(
            f"Expected argument `lower` to be at most `upper` but got more for the parameters {crossed}; swap them."
        )
    return low, high


def _checked_prior(prior: GaussianPrior | None, theta: Tensor) -> tuple[Tensor | None, Tensor | None]:
    if prior is None:
        return None, None
    refuse_other_type("prior", prior, GaussianPrior, "a GaussianPrior", "write GaussianPrior(mean, precision)")
    p = theta.shape[-1]
    mean, precision = (
        as_numbers(f"prior.{name}", getattr(prior, name), theta.dtype, theta.device).to(theta)
        for name in ("mean", "precision")
    )
    if mean.shape != (p,) or precision.shape not in ((p,), (p, p)):
        raise ValueError(
            f"Expected argument `prior` with a mean ({p},) and a precision ({p},) or ({p}, {p}) but got "
            f"{tuple(mean.shape)} and {tuple(precision.shape)}."
        )
    matrix = torch.diag(precision) if precision.dim() == 1 else precision
    finite = bool(torch.isfinite(mean).all()) and bool(torch.isfinite(matrix).all())
    if finite:
        size = matrix.diagonal().abs().clamp(min=torch.finfo(matrix.dtype).tiny).rsqrt()
        scaled = matrix * size.unsqueeze(-1) * size
        slack = 1e3 * torch.finfo(matrix.dtype).eps
        definite = float(torch.linalg.eigvalsh(scaled)[0]) >= -slack
        symmetric = bool(((scaled - scaled.mT).abs() <= slack).all())
    if not finite or not definite or not symmetric:
        raise ValueError(
            "Expected argument `prior` with finite values and a symmetric positive semi-definite precision but got "
            f"{precision.tolist()}."
        )
    return mean, matrix


def _checked_weight(weight: Tensor | None, first: Tensor, batch: torch.Size) -> tuple[Tensor | None, Tensor | None]:
    """Weights (B, N, m), and a mask of the positive weights, or None if all are positive."""
    if weight is None:
        return None, None
    N, m = first.shape[1:]
    w = as_numbers("weight", weight, first.dtype, first.device).to(first)
    if w.shape == (N,):
        w = w.unsqueeze(-1)
    try:
        w = w.expand(*batch, N, m).reshape(-1, N, m)
    except RuntimeError:
        raise ValueError(
            f"Expected argument `weight` of shape ({N},), ({N}, {m}) or {(*batch, N, m)} but got {tuple(w.shape)}."
        ) from None
    if not bool(torch.isfinite(w).all()) or bool((w < 0).any()) or bool((w.sum(-2) <= 0).any()):
        raise ValueError("Expected argument `weight` to be finite, >= 0 and positive somewhere in every channel.")
    used = w > 0
    return w, None if bool(used.all()) else used


def _constraint_count(name: str, constraint: Constraint, theta: Tensor) -> int:
    value = constraint(theta)
    refuse_other_type(name, value, Tensor, "a function that returns a tensor (k,)", "return a tensor")
    if value.dim() != 1 or not bool(torch.isfinite(value).all()):
        raise ValueError(
            f"Expected argument `{name}` to return finite values (k,) at `start` but got {value.tolist()}; "
            "a single constraint is (1,)."
        )
    return value.shape[0]

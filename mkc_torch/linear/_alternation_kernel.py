"""Triton kernel of the alternation of MKC-EM on many small problems; ``_alternation`` launches it."""

from __future__ import annotations

import triton
import triton.language as tl

from mkc_torch.density._newton_kernel import newton_step
from mkc_torch.linear._concentration_kernel import weighted_fit

_NUMBERS = ("problems", "samples", "x_batch", "w_batch", "steps", "patience", "free_kappa", "free_d")
"""Numbers of which the compiled form does not depend."""


@triton.jit(do_not_specialize=_NUMBERS)
def alternation_kernel(
    x, y, w, rule, settings, beta_io, state_io, history,
    problems, samples, x_batch, w_batch, steps, patience, free_kappa, free_d,
    N: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr, HAS_WEIGHT: tl.constexpr, NODES: tl.constexpr,
    TOLERANCE: tl.constexpr, KAPPA_MAX: tl.constexpr, OFFSET: tl.constexpr, LONGEST: tl.constexpr,
    LEAST_SHARE: tl.constexpr,
):  # fmt: skip
    """Up to ``steps`` alternations of one problem, each a Newton step of the density and two of the coefficients.

    ``x`` holds the columns (B, N, samples). ``rule`` holds nodes and weights of the head, ``settings`` the least gain
    and the rounding of a value. Rows of ``state_io`` (9, B): κ, log d, log bound, least log d, damping, value,
    alternations without a gain, whether the problem has ended, and alternations made. ``history`` (steps, B): values.
    """
    program = tl.program_id(0).to(tl.int64)
    lane = tl.arange(0, BLOCK)
    valid = lane < samples
    column = tl.arange(0, COLUMNS)
    node = tl.arange(0, NODES)
    nodes, weights = tl.load(rule + node), tl.load(rule + NODES + node)
    target_y = tl.load(y + program * samples + lane, mask=valid, other=0.0).to(tl.float64)
    if HAS_WEIGHT:
        own = tl.load(w + program * w_batch + lane, mask=valid, other=0.0).to(tl.float64)
        share = own / tl.sum(own, 0)
    else:
        own = tl.where(valid, 1.0, 0.0).to(tl.float64)
        share = own / samples
    x += program * x_batch + lane
    at = state_io + program
    kappa, log_d, log_bound = tl.load(at), tl.load(at + problems), tl.load(at + 2 * problems)
    log_d_min, damping, value = tl.load(at + 3 * problems), tl.load(at + 4 * problems), tl.load(at + 5 * problems)
    stalled, ended, made = tl.load(at + 6 * problems), tl.load(at + 7 * problems), tl.load(at + 8 * problems)
    least, rounding = tl.load(settings), tl.load(settings + 1)
    beta = tl.load(beta_io + program * N + column, mask=column < N, other=0.0)
    residual = target_y
    for j in tl.static_range(N):
        coef = tl.sum(tl.where(column == j, beta, 0.0), 0)
        residual -= tl.load(x + j * samples, mask=valid, other=0.0).to(tl.float64) * coef
    step = 0
    while (step < steps) & (ended == 0):
        before = damping
        kappa, log_d, damping, now = newton_step(
            residual, share, kappa, log_d, log_bound, log_d_min, damping, nodes, weights, free_kappa, free_d,
            TOLERANCE, KAPPA_MAX, OFFSET, LONGEST, LEAST_SHARE,
        )  # fmt: skip
        scaled = kappa * 0.5 * tl.exp(-2.0 * log_d)
        for _ in range(2):
            beta = weighted_fit(x, target_y, own * tl.exp(-scaled * residual * residual), valid, samples, N, COLUMNS)
            residual = target_y
            for j in tl.static_range(N):
                coef = tl.sum(tl.where(column == j, beta, 0.0), 0)
                residual -= tl.load(x + j * samples, mask=valid, other=0.0).to(tl.float64) * coef
        gains = value - now > least + rounding * tl.abs(now)
        conclusive = (damping <= before) | (damping >= 1e3)
        stalled = tl.where(gains, 0.0, stalled + conclusive.to(tl.float64))
        ended = (stalled >= patience).to(tl.float64)
        value = now
        tl.store(history + step * problems + program, value)
        step += 1
        made += 1.0
    while step < steps:
        tl.store(history + step * problems + program, value)
        step += 1
    tl.store(beta_io + program * N + column, beta, mask=column < N)
    tl.store(at, kappa)
    tl.store(at + problems, log_d)
    tl.store(at + 4 * problems, damping)
    tl.store(at + 5 * problems, value)
    tl.store(at + 6 * problems, stalled)
    tl.store(at + 7 * problems, ended)
    tl.store(at + 8 * problems, made)

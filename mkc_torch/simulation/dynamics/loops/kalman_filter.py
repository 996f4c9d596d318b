"""The Kalman filter of :func:`mkc_torch.simulation.dynamics.kalman.run_filter`, sample by sample."""

from __future__ import annotations

from typing import Any

import numpy as np


def filter_samples(
    transition: Any,
    noise_input: Any,
    shift: Any,
    phi: Any,
    renewed: Any,
    seen: Any,
    new: Any,
    counts: Any,
    white: Any,
    place: Any,
    variance: Any,
    clip: float,
    hard_clip: bool,
    state: Any,
    P: Any,
    left: Any,
    standard: Any,
    spread: Any,
    priors: Any,
    states: Any,
    afters: Any,
    posteriors: Any,
) -> None:
    """Filter G stretches of L samples under B models; writes into ``state``, ``P`` and all arguments after them.

    Args:
        transition, noise_input, shift: (L-1, G, n, n), (L-1, G, n, p) and (L-1, G, n), of the flow.
        phi: (L-1, G, B, D), share of a lasting disturbance that remains at the next sample.
        renewed: (L-1, G, B, D), variance added to a lasting disturbance.
        seen, new, counts: (L, G, m, n), (L, G, m) and (L, G, m), of the flow.
        white: (B, p), standard deviations of white process noise.
        place: (B, D), index of the rate, or p plus index of the output, that a lasting disturbance acts on.
        variance: (B, m), of each output's white noise.
        clip: standard deviations at which innovations are clipped.
        hard_clip: whether innovations below the limit pass unchanged, instead of clipping by a hyperbolic tangent.
        state, P: (G, B, k) and (G, B, k, k), at the first sample; on return, after the last sample.
        left: (G, B, k, k), derivative of the error by an error of the first state; empty if not wanted.
        standard, spread: (L, G, B, m), the standardised innovations and their standard deviations.
        priors, states, afters, posteriors: covariances and states at each sample; empty if not wanted.
    """
    L, G, m, n = seen.shape
    p = noise_input.shape[3]
    B, D = place.shape
    k = n + D
    keep, through = len(priors) > 0, len(left) > 0
    A, half, c, Pc, moved, along = (
        np.zeros((k, k)),
        np.empty((k, k)),
        np.zeros(k),
        np.empty(k),
        np.empty(k),
        np.empty(k),
    )
    for g in range(G):
        for b in range(B):
            x, V = state[g, b], P[g, b]
            for row in range(L):
                if row > 0:
                    A[:] = 0.0
                    for i in range(n):
                        for j in range(n):
                            A[i, j] = transition[row - 1, g, i, j]
                        for d in range(D):
                            if place[b, d] < p:
                                A[i, n + d] = noise_input[row - 1, g, i, place[b, d]]
                    for d in range(D):
                        A[n + d, n + d] = phi[row - 1, g, b, d]
                    for i in range(k):
                        total = 0.0
                        for j in range(k):
                            total += A[i, j] * x[j]
                        moved[i] = total
                    for i in range(k):
                        x[i] = moved[i]
                    for i in range(n):
                        x[i] -= shift[row - 1, g, i]
                    for i in range(k):
                        for j in range(k):
                            total = 0.0
                            for q in range(k):
                                total += A[i, q] * V[q, j]
                            half[i, j] = total
                    for i in range(k):
                        for j in range(k):
                            total = 0.0
                            for q in range(k):
                                total += half[i, q] * A[j, q]
                            V[i, j] = total
                    if through:
                        for i in range(k):
                            for j in range(k):
                                total = 0.0
                                for q in range(k):
                                    total += A[i, q] * left[g, b, q, j]
                                half[i, j] = total
                        for i in range(k):
                            for j in range(k):
                                left[g, b, i, j] = half[i, j]
                    for d in range(D):
                        V[n + d, n + d] += renewed[row - 1, g, b, d]
                    for q in range(p):
                        if white[b, q] > 0.0:
                            size = white[b, q] * white[b, q]
                            for i in range(n):
                                for j in range(n):
                                    V[i, j] += size * noise_input[row - 1, g, i, q] * noise_input[row - 1, g, j, q]
                if keep:
                    priors[row, g, b] = V
                    states[row, g, b] = x
                for output in range(m):
                    for i in range(n):
                        c[i] = seen[row, g, output, i]
                    for d in range(D):
                        c[n + d] = 1.0 if place[b, d] == p + output else 0.0
                    S, expected = variance[b, output], 0.0
                    for i in range(k):
                        total = 0.0
                        for j in range(k):
                            total += V[i, j] * c[j]
                        Pc[i] = total
                        S += c[i] * total
                        expected += c[i] * x[i]
                    root = np.sqrt(max(S, 1e-300))
                    z = (new[row, g, output] - expected) / root
                    standard[row, g, b, output] = z
                    spread[row, g, b, output] = root
                    used = counts[row, g, output]
                    if used == 0.0:
                        continue
                    if hard_clip:
                        pulled = used * min(max(z, -clip), clip) / root
                    else:
                        pulled = used * clip * np.tanh(z / clip) / root
                    if through:
                        for j in range(k):
                            total = 0.0
                            for i in range(k):
                                total += c[i] * left[g, b, i, j]
                            along[j] = total
                    for i in range(k):
                        gain = used / S * Pc[i]
                        x[i] += Pc[i] * pulled
                        for j in range(k):
                            V[i, j] -= gain * Pc[j]
                            if through:
                                left[g, b, i, j] -= gain * along[j]
                if keep:
                    afters[row, g, b] = x
                    posteriors[row, g, b] = V

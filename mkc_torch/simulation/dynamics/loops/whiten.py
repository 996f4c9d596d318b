"""The whitening of :func:`mkc_torch.simulation.dynamics.whitening.whitened`, sample by sample, and its transpose."""

from __future__ import annotations

from typing import Any

import numpy as np


def whiten_samples(
    transition: Any,
    noise_input: Any,
    phi: Any,
    place: Any,
    seen: Any,
    gain: Any,
    white: Any,
    new: Any,
    shift: Any,
    start: Any,
    out: Any,
) -> None:
    """Whiten K series of N samples under B noise models; writes into ``start`` and ``out``.

    Args:
        transition, noise_input: (M, n, n) and (M, n, p), of the flow; M is N where more samples follow, else N-1.
        phi: (M, B, D), share of a lasting disturbance that remains at the next sample.
        place: (B, D), index of the rate, or p plus index of the output, that a lasting disturbance acts on.
        seen: (N, m, n), derivative of the outputs by the states.
        gain, white: (N, B, k, m) and (N, B, m, m), of the filters.
        new, shift: (N, m, K) and (M, n, K), of the series.
        start: (B, k, K), states and lasting disturbances before the first sample; on return, before the next sample.
        out: (B, N, m, K), the innovations.
    """
    N, m, K = new.shape
    n, p = noise_input.shape[1], noise_input.shape[2]
    B, D = place.shape
    k = n + D
    state, moved, left = np.empty((k, K)), np.empty((k, K)), np.empty((m, K))
    for b in range(B):
        state[:] = start[b]
        for row in range(N):
            for output in range(m):
                for s in range(K):
                    left[output, s] = new[row, output, s]
                for i in range(n):
                    c = seen[row, output, i]
                    if c != 0.0:
                        for s in range(K):
                            left[output, s] -= c * state[i, s]
                for d in range(D):
                    if place[b, d] == p + output:
                        for s in range(K):
                            left[output, s] -= state[n + d, s]
            for output in range(m):
                for s in range(K):
                    out[b, row, output, s] = white[row, b, output, 0] * left[0, s]
                for other in range(1, output + 1):
                    w = white[row, b, output, other]
                    for s in range(K):
                        out[b, row, output, s] += w * left[other, s]
            if row == len(transition):
                break
            for i in range(k):
                for output in range(m):
                    w = gain[row, b, i, output]
                    if w != 0.0:
                        for s in range(K):
                            state[i, s] += w * left[output, s]
            for i in range(n):
                for s in range(K):
                    moved[i, s] = -shift[row, i, s]
                for j in range(n):
                    w = transition[row, i, j]
                    if w != 0.0:
                        for s in range(K):
                            moved[i, s] += w * state[j, s]
                for d in range(D):
                    if place[b, d] < p:
                        w = noise_input[row, i, place[b, d]]
                        for s in range(K):
                            moved[i, s] += w * state[n + d, s]
            for d in range(D):
                w = phi[row, b, d]
                for s in range(K):
                    moved[n + d, s] = w * state[n + d, s]
            state, moved = moved, state
        start[b] = state


def whiten_transposed(carry: Any, seen: Any, gain: Any, white: Any, innovations: Any, new: Any, shift: Any) -> None:
    """Apply the transpose of the whitening of one noise model to K innovations; writes into ``new`` and ``shift``.

    Args:
        carry: (N-1, k, k), transition of states and lasting disturbances to the next sample.
        seen: (N, m, k), derivative of the outputs by them.
        gain, white: (N, k, m) and (N, m, m), of the filter.
        innovations: (N, m, K).
        new, shift: (N, m, K) and (N-1, n, K).
    """
    N, m, K = innovations.shape
    k, n = seen.shape[2], shift.shape[1]
    state, moved = np.zeros((k, K)), np.zeros((k, K))
    for row in range(N - 1, -1, -1):
        if row < N - 1:
            for i in range(n):
                for s in range(K):
                    shift[row, i, s] = -state[i, s]
            for j in range(k):
                for s in range(K):
                    moved[j, s] = 0.0
                for i in range(k):
                    w = carry[row, i, j]
                    if w != 0.0:
                        for s in range(K):
                            moved[j, s] += w * state[i, s]
        for output in range(m):
            for s in range(K):
                new[row, output, s] = 0.0
            for other in range(output, m):
                w = white[row, other, output]
                for s in range(K):
                    new[row, output, s] += w * innovations[row, other, s]
            for i in range(k):
                w = gain[row, i, output]
                if w != 0.0:
                    for s in range(K):
                        new[row, output, s] += w * moved[i, s]
        for i in range(k):
            for s in range(K):
                state[i, s] = moved[i, s]
            for output in range(m):
                w = seen[row, output, i]
                if w != 0.0:
                    for s in range(K):
                        state[i, s] -= w * new[row, output, s]

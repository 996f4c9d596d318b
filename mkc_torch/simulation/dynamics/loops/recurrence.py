"""The recurrence of :class:`mkc_torch.simulation.dynamics.compiled.affine.Affine`, sequentially."""

from __future__ import annotations

from typing import Any


def pass_on(carries: Any, values: Any) -> None:
    """Solve ``δ[k+1] = A[k] δ[k] + v[k+1]`` in place.

    Args:
        carries: A into each grid time, (w, w, G); 0 where a trajectory starts.
        values: v, (w, K, G); δ on return.
    """
    w, K, G = values.shape
    for k in range(1, G):
        for i in range(w):
            for j in range(w):
                a = carries[i, j, k]
                if a != 0.0:
                    for s in range(K):
                        values[i, s, k] += a * values[j, s, k - 1]


def pass_on_many(carries: Any, values: Any) -> None:
    """Solve the recurrence of many states in place; the values of a grid time are neighbours in memory.

    Args:
        carries: A into each grid time, (G, w, w); 0 where a trajectory starts.
        values: v, (G, w, K); δ on return.
    """
    G, w, K = values.shape
    for k in range(1, G):
        for i in range(w):
            if K == 1:
                total = 0.0
                for j in range(w):
                    total += carries[k, i, j] * values[k - 1, j, 0]
                values[k, i, 0] += total
            else:
                for j in range(w):
                    a = carries[k, i, j]
                    if a != 0.0:
                        for s in range(K):
                            values[k, i, s] += a * values[k - 1, j, s]

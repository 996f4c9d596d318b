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

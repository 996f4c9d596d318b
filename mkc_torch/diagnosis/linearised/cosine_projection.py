"""Residual and tangents in the slowest coefficients of the cosine basis, where whitening is a division."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearised.candidates import AT_ONCE, in_blocks
from mkc_torch.diagnosis.linearised.tangents import ModelTangents, SlowBasis
from mkc_torch.diagnosis.noise.cosine_basis import dct
from mkc_torch.diagnosis.noise.imputation import Imputation, MissingSamples

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["FILLED_AT_ONCE", "CosineProjection", "each"]

_MOST = 0.9
"""Share of the tangents' power that sets their bandwidth."""

_MARGIN = 3.0
"""Number of cosine coefficients that are kept, in multiples of that bandwidth."""

_FEWEST = 1000
"""Smallest number of cosine coefficients that are kept."""

FILLED_AT_ONCE = 64
"""Candidates whose coefficients are imputed together: each block reads a large matrix once and fits into the cache."""


@dataclass(frozen=True)
class CosineProjection:
    """Residual and tangents at the samples that count, in their K slowest coefficients.

    Attributes:
        pseudo: the pseudo-residual.
        nuisance, candidates, slow: tangents of the simulation's own parameters, of each candidate, and of the slow
            cosines of a drift.
        gaps: the rejected samples.
    """

    pseudo: Float[Tensor, "K m"]
    nuisance: Float[Tensor, "K m p"]
    candidates: tuple[Float[Tensor, "K m q"], ...]
    slow: Float[Tensor, "K m k"]
    gaps: MissingSamples

    @classmethod
    def of(
        cls, pseudo: Float[Tensor, "N m"], counts: Float[Tensor, "N m"], tangents: ModelTangents, slow: SlowBasis | None
    ) -> CosineProjection:
        """Project all samples; candidates are processed a few at a time, and only their coefficients are kept.

        Args:
            pseudo, counts, tangents: of all samples.
            slow: the drift's cosines; None without a drift.
        """
        kept = _bandwidth(tangents.nuisance)

        def moved(joined: Tensor) -> Tensor:
            return dct(counts.unsqueeze(-1) * joined, kept)

        nuisance = moved(tangents.nuisance)
        candidates = each(moved, tangents.candidates)
        courses = nuisance[..., :0] if slow is None else slow.transformed(counts, kept)
        return cls(dct(pseudo, kept), nuisance, tuple(candidates), courses, MissingSamples(counts, kept))

    @property
    def kept(self) -> int:
        """K."""
        return len(self.pseudo)

    @property
    def parts(self) -> tuple[object, ...]:
        """All large parts, itself included."""
        return (self, self.pseudo, self.nuisance, *self.candidates, self.slow, self.gaps)

    def filled(self, filling: Imputation) -> CosineProjection:
        """Impute the expected noise at rejected samples, in residual and tangents alike."""
        pseudo, nuisance, *candidates = each(
            filling, [self.pseudo.unsqueeze(-1), self.nuisance, *self.candidates], FILLED_AT_ONCE
        )
        return replace(
            self,
            pseudo=pseudo.squeeze(-1),
            nuisance=nuisance,
            candidates=tuple(candidates),
            slow=filling(self.slow),
        )


def each(function: Callable[[Tensor], Tensor], columns: Sequence[Tensor], at_once: int = AT_ONCE) -> list[Tensor]:
    """Apply a function of columns to each of these matrices, a few of them at a time.

    Example:
        >>> columns = [torch.ones(2, 1), torch.ones(2, 3)]
        >>> [doubled.shape[-1] for doubled in each(lambda joined: 2.0 * joined, columns)]
        [1, 3]
    """
    return [
        done
        for block in in_blocks(columns, at_once)
        for done in function(torch.cat([*block], -1)).split([c.shape[-1] for c in block], -1)
    ]


def _bandwidth(nuisance: Float[Tensor, "N m p"]) -> int:
    """Return how many slow cosine coefficients to keep: three times as many as hold 90 % of the tangents' power."""
    N = len(nuisance)
    power = dct(nuisance).square().sum(1)
    share = (power / power.sum(0).clamp(min=1e-300)).cumsum(0)
    typical = (share < _MOST).sum(0).double().median()
    return int(min(N, max(_FEWEST, _MARGIN * float(typical))))

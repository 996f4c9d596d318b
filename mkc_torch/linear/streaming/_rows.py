"""Batches of all ranks as a source of passes, each checked to be over the same rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.ranks import Ranks
from mkc_torch.linear._block_sums import Memory
from mkc_torch.linear._blocks import Density, PassResult, ResidualRange, flat_length
from mkc_torch.linear._descent import Descent
from mkc_torch.linear._implicit.stationary import FitState
from mkc_torch.linear.streaming._batches import Shape, rows_of
from mkc_torch.linear.streaming._state import StreamState

if TYPE_CHECKING:
    from jaxtyping import Float64

_SAME = 1e-9
"""Share of a column's absolute sum by which its sum may differ between passes.

Rounding in another order is a hundredth of it, and a millionth of the rows with other values exceeds it."""

_SAME_ROUGH = 1e-5
"""The same for a pass that forms products in float32."""

_LEAST_KAPPA = 0.05
"""Least κ of such a pass: differences of its sums then have four digits."""

_LARGEST = 1e3
"""Largest mean of ``|y| + |x| |coef|`` in such a pass, in units of d: residuals then have four digits."""

_ROUGH = 1e-5
"""Rounding error of the mean likelihood of such a pass, at most."""

_REPEATED = 1e-6
"""Relative difference of a point from that of a recorded pass up to which the pass is not made again.

The steps of a resumed fit may differ from those of the saved fit by rounding on another processor."""


class StreamChangedError(ValueError):
    """A pass had other rows than the first pass."""


class Wanted(NamedTuple):
    """Results that a pass over batches computes, and whether products of float32 rows are formed in float32."""

    with_curvature: bool = False
    with_range: bool = False
    rough: bool = False


class StreamedRows:
    """Batches of all ranks as a source of passes; passes recorded in a state are not made again.

    Args:
        ranks: the ranks, which all make the same passes.
        batches: batches of this rank.
        state: survey and pilot of the fit, and the passes to resume from.
        keep: called with the state before every pass.
    """

    def __init__(
        self, ranks: Ranks, batches: Iterable[Any], state: StreamState, keep: Callable[[StreamState], None]
    ) -> None:
        self.ranks, self.survey, self.pilot = ranks, state.survey, state.pilot
        self._batches, self._keep = batches, keep
        self._recorded, self._state = list(state.passes), replace(state, passes=())
        self._frame = state.survey.frame()

    @property
    def passes(self) -> int:
        """Number of passes, with that of the survey."""
        return 1 + len(self._state.passes)

    def begin(self, fit_state: FitState, **options: float) -> Descent:
        """State of a descent before its first pass."""
        return self._rounded(Descent.begin(fit_state, self.pilot.slopes, **options))

    def evaluate(self, descent: Descent, *, with_range: bool = False) -> PassResult:
        """Make one pass over the rows of all ranks.

        Raises:
            StreamChangedError: the pass had other rows than the survey.
        """
        beta, density, shape = descent.point.beta[0], descent.density(), self.survey.shape
        wanted = Wanted(descent.with_curvature, with_range, self._is_rough(descent))
        point = torch.cat([beta, density.kappa, density.d, beta.new_tensor(wanted)])
        flat = self.ranks.from_first(lambda: self._recorded_pass(point))
        if flat is None:
            self._keep(self._state)
            flat = self._sums(beta, density, wanted)
        self._state = replace(self._state, passes=(*self._state.passes, (point, flat)))
        rows, sums, *ends = flat.split([1, len(flat) - 1 - 2 * shape.m * with_range, *[shape.m] * (2 * with_range)])
        result = PassResult.of_flat(sums, shape.m, shape.n, ResidualRange(*ends) if ends else None)
        self.ranks.from_first(lambda: self._refuse_other_rows(int(rows), result.total.residual, beta, wanted.rough))
        return result

    def after(self, descent: Descent, result: PassResult) -> Descent:
        """State of the descent after a pass, the same on all ranks."""
        slack = _ROUGH if self.survey.single else 0.0
        return self.ranks.from_first(lambda: self._rounded(descent.after(result, slack)))

    def _recorded_pass(self, point: Float64[Tensor, " p"]) -> Float64[Tensor, " k"] | None:
        if not self._recorded:
            return None
        before, flat = self._recorded.pop(0)
        if before.shape == point.shape and torch.allclose(before, point, rtol=_REPEATED, atol=0.0):
            return flat
        self._recorded.clear()
        return None

    def _sums(self, beta: Float64[Tensor, " n"], density: Density, wanted: Wanted) -> Float64[Tensor, " k"]:
        shape = self.survey.shape

        def work() -> Tensor:
            return sums_pass(self._batches, shape, self._frame, beta, density, wanted)

        if not wanted.with_range:
            return self.ranks.sum_of(work, 1 + flat_length(shape.m, shape.n, with_curvature=wanted.with_curvature))
        parts = torch.stack(self.ranks.gathered(work))
        low, high = parts[:, -2 * shape.m : -shape.m], parts[:, -shape.m :]
        return torch.cat([parts[:, : -2 * shape.m].sum(0), low.amin(0), high.amax(0)])

    def _is_rough(self, descent: Descent) -> bool:
        """Whether a pass in float32 is accurate enough for a step, and saves time."""
        survey, density = self.survey, descent.density()
        if descent.with_curvature or not survey.single or self._frame is not None or self.pilot.rows == survey.rows:
            return False
        size = survey.sizes(descent.point.beta[0]) / survey.weight
        return bool(((density.kappa >= _LEAST_KAPPA) & (size <= _LARGEST * density.d)).all())

    def _rounded(self, descent: Descent) -> Descent:
        """Round the coefficients before a rough pass, whose rounding errors are then independent from row to row."""
        if descent.done or not self._is_rough(descent):
            return descent
        return replace(descent, point=replace(descent.point, beta=descent.point.beta.float().double()))

    def _refuse_other_rows(
        self, rows: int, residual: Float64[Tensor, " m"], beta: Float64[Tensor, " n"], rough: bool
    ) -> None:
        """Refuse a pass whose number of rows, or sums of weighted residuals, differ from those of the survey."""
        survey, n = self.survey, self.survey.shape.n
        if rows != survey.rows:
            raise StreamChangedError(
                f"Expected `batches` to yield the same rows in every pass but got {rows}, after {survey.rows} in the "
                "first; shuffle if you like, but do not drop a last batch or redraw rows."
            )
        coef = beta if self._frame is None else self._frame @ beta
        expected = survey.total[:, n] - survey.total[:, :n] @ coef
        wrong = ~((residual - expected).abs() <= (_SAME_ROUGH if rough else _SAME) * survey.sizes(coef))
        if bool(wrong.any()):
            raise StreamChangedError(
                "Expected `batches` to yield the same values in every pass but got residuals that sum to "
                f"{float(residual[wrong][0]):.6g} where those of the first pass sum to "
                f"{float(expected[wrong][0]):.6g}; remove random transforms, and resume only with the data of the "
                "saved state."
            )


def sums_pass(
    batches: Iterable[Any],
    shape: Shape,
    frame: Float64[Tensor, "n n"] | None,
    beta: Float64[Tensor, " n"],
    density: Density,
    wanted: Wanted,
) -> Float64[Tensor, " k"]:
    """Number of this rank's rows, their sums, and the least and largest residual of each channel if wanted.

    A pass with curvature takes three times as long.
    """
    memory, m = Memory(), shape.m
    flat = torch.zeros(1 + flat_length(m, shape.n, with_curvature=wanted.with_curvature), dtype=torch.float64)
    low, high = (flat.new_full((m,), end) for end in (torch.inf, -torch.inf))
    for _, rows in rows_of(batches, shape, frame):
        if len(rows.Y):
            result = rows.evaluate(beta, density, memory=memory, **wanted._asdict())
            flat[0] += len(rows.Y)
            flat[1:] += result.flat()
            if result.extent is not None:
                low, high = torch.minimum(low, result.extent.low), torch.maximum(high, result.extent.high)
    return torch.cat([flat, low, high]) if wanted.with_range else flat

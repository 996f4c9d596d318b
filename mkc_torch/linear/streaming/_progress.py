"""State of a streamed fit between two passes; its size does not depend on the number of rows."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from mkc_torch._support.files import write_atomically
from mkc_torch.density.likelihood import Derivatives, normaliser_derivatives
from mkc_torch.linear._blocks import CurvatureSums, Density, PassResult, ResidualRange, Sums
from mkc_torch.linear._descent import Descent, EvaluatedPoint, PassDerivatives, sandwich_of
from mkc_torch.linear._implicit.stationary import FitState, Unknowns
from mkc_torch.linear._problem import solve_gram
from mkc_torch.linear._scale_search import relative_precision
from mkc_torch.linear.streaming._batches import Shape
from mkc_torch.linear.streaming._pilot import PilotFit
from mkc_torch.linear.streaming._sums import sums_of
from mkc_torch.linear.streaming._survey import Survey

if TYPE_CHECKING:
    from jaxtyping import Float64

Phase = Literal["range", "climb", "done"]

FORMAT = 3
"""Version of a saved state; another version is refused."""

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

_NEAR = 2e-5
"""Distance from the maximum, in standard errors of one row, below which a pass computes the curvature.

The covariance is then as accurate as this, and a step with the curvature leaves the square of the distance."""

_FURTHEST = 0.03
"""The same in standard errors, for many rows."""

_LONGER = 0.5
"""Log of the ratio of the domain to the sample's up to which the sums at the sample's density are a step's.

On a longer domain the share of its tail is adapted first."""

_SLOW = 0.1
"""Share of the length of a step that the next may have; beyond it, the curvature is computed again."""

_EXACT_PASSES = 8
"""Passes after which a fit through most values to rounding, whose precision is limited, ends."""

_CLASSES: dict[str, Any] = {
    "survey": Survey,
    "shape": Shape,
    "begun": PilotFit,
    "climb": Descent,
    "fit_state": FitState,
    "slopes": PassDerivatives,
    "point": Unknowns,
    "best": EvaluatedPoint,
    "by_channel": Derivatives,
    "result": PassResult,
    "total": Sums,
    "curvature": CurvatureSums,
    "curvature_sums": CurvatureSums,
}
"""Types of the nested parts of a state, by the name of the field."""


class StreamChangedError(ValueError):
    """A pass had other rows than the first pass."""


@dataclass(frozen=True)
class StreamProgress:
    """A fit between two passes.

    Attributes:
        settings: parameters of the fit, by name.
        survey: the survey of all rows.
        begun: the pilot fit.
        phase: purpose of the next pass: the range of the residuals, or the maximum; or "done".
        passes: number of passes made.
        climb: state of the maximisation, once it has begun.
        gaussian: whether a Gaussian density at least squares has been tried.
        ending: whether the next pass is the last in any case.
        converged: whether the maximum was reached.
    """

    settings: dict[str, Any]
    survey: Survey
    begun: PilotFit
    phase: Phase
    passes: int
    climb: Descent | None = None
    gaussian: bool = False
    ending: bool = False
    converged: bool = False

    @staticmethod
    def begin(settings: dict[str, Any], survey: Survey, begun: PilotFit) -> StreamProgress:
        progress = StreamProgress(settings, survey, begun, "range", 1)
        if progress._is_rough(begun.fit_state.beta[0], progress.next_pass()[1]):
            fit_state = replace(begun.fit_state, beta=begun.fit_state.beta.float().double())
            progress = replace(progress, begun=replace(begun, fit_state=fit_state))
        # with a sample of all rows the range is known
        known = settings["bound"] is not None or begun.rows == survey.rows
        return progress._climbing(progress.begun.fit_state) if known else progress

    @property
    def rough(self) -> bool:
        """Whether the next pass forms products in float32; its coefficients are then float32 numbers."""
        beta, density, with_curvature = self.next_pass()
        return not with_curvature and self._is_rough(beta, density)

    def _is_rough(self, beta: Float64[Tensor, " n"], density: Density) -> bool:
        """Whether a pass in float32 at this point is accurate enough for a step, and saves time."""
        survey = self.survey
        if not survey.single or survey.frame() is not None or self.begun.rows == survey.rows:
            return False
        size = survey.sizes(beta) / survey.weight
        return bool(((density.kappa >= _LEAST_KAPPA) & (size <= _LARGEST * density.d)).all())

    def next_pass(self) -> tuple[Float64[Tensor, " n"], Density, bool]:
        """Coefficients and density of the next pass, and whether it computes the curvature."""
        if self.climb is None:
            start = self.begun.fit_state
            return start.beta[0], Density(start.kappa[0], torch.exp(start.log_d[0])), False
        return self.climb.point.beta[0], self.climb.density(), self.climb.with_curvature

    def after_range(self, parts: list[tuple[Float64[Tensor, " k"], ResidualRange | None]]) -> StreamProgress:
        """Set the domain: half the range of all residuals, and at least the sample's, which includes ten of its d.

        Args:
            parts: sums and ranges of the ranks, in their order.

        Raises:
            StreamChangedError: the pass had other rows.
        """
        start = self.begun.fit_state
        rows, result = sums_of(torch.stack([flat for flat, _ in parts]).sum(0), self.survey.shape)
        self._refuse_other_rows(rows, result.total.residual, start.beta[0])
        extent = reduce(ResidualRange.with_others, [part for _, part in parts if part is not None])
        assert start.log_bound is not None
        log_bound = torch.maximum(start.log_bound, torch.log(extent.half()))
        now, longer = replace(self, passes=self.passes + 1), log_bound - start.log_bound
        if bool((longer <= _LONGER).all()):
            climbing = now._climbing(replace(start, log_bound=log_bound))
            assert climbing.climb is not None
            return climbing._after(result)
        # keep the tail density exp(-1/κ) / bound unchanged on the longer domain
        inverse = torch.where(start.kappa > 0, start.kappa, 1.0).reciprocal() + longer
        kappa = torch.where(start.kappa > 0, inverse.reciprocal(), 0.0) if start.free_kappa else start.kappa
        return now._climbing(replace(start, kappa=kappa, log_bound=log_bound))

    def after_sums(self, flat: Float64[Tensor, " k"], max_passes: int) -> StreamProgress:
        """Make a step towards the maximum.

        Raises:
            StreamChangedError: the pass had other rows.
        """
        assert self.climb is not None
        rows, result = sums_of(flat, self.survey.shape)
        self._refuse_other_rows(rows, result.total.residual, self.climb.point.beta[0])
        passes = self.passes + 1
        now = replace(self, passes=passes)._after(result)
        climb = now.climb
        assert climb is not None
        if climb.done and not self.gaussian and not self.ending and passes < max_passes - 1:
            start = self._gaussian(climb)
            if start is not None:
                begun = replace(now._climbing(start, alike=False), gaussian=True)
                assert begun.climb is not None
                return replace(begun, climb=replace(begun.climb, history=climb.history))
        if climb.done or self.ending:
            return replace(now, phase="done", converged=climb.done or self.begun.exact)
        if passes >= max_passes - 1 or (self.begun.exact and len(climb.history) >= _EXACT_PASSES):
            assert climb.best is not None
            return replace(now, climb=replace(climb, point=climb.best.point, left=0.0), ending=True)
        return now

    def _after(self, result: PassResult) -> StreamProgress:
        """Make the step after a pass."""
        assert self.climb is not None
        return replace(self, climb=self.climb.after(result, _ROUGH if self.survey.single else 0.0))._rounded()

    def _rounded(self) -> StreamProgress:
        """Round the coefficients before a rough pass, whose rounding errors are then independent from row to row."""
        if self.climb is None or not self.rough:
            return self
        point = self.climb.point
        return replace(self, climb=replace(self.climb, point=replace(point, beta=point.beta.float().double())))

    def _refuse_other_rows(self, rows: int, residual: Float64[Tensor, " m"], beta: Float64[Tensor, " n"]) -> None:
        """Refuse a pass whose rows differ from those of the first.

        Args:
            rows: number of rows of the pass.
            residual: sums of its weighted residuals.
            beta: coefficients of these residuals.

        Raises:
            StreamChangedError: the rows differ.
        """
        survey, n, frame = self.survey, self.survey.shape.n, self.survey.frame()
        if rows != survey.rows:
            raise StreamChangedError(
                f"Expected `batches` to yield the same rows in every pass but got {rows}, after {survey.rows} in the "
                "first; shuffle if you like, but do not drop a last batch or redraw rows."
            )
        coef = beta if frame is None else frame @ beta
        expected = survey.total[:, n] - survey.total[:, :n] @ coef
        same = _SAME_ROUGH if self.rough else _SAME
        wrong = ~((residual - expected).abs() <= same * survey.sizes(coef))
        if bool(wrong.any()):
            raise StreamChangedError(
                "Expected `batches` to yield the same values in every pass but got residuals that sum to "
                f"{float(residual[wrong][0]):.6g} where those of the first pass sum to "
                f"{float(expected[wrong][0]):.6g}; remove random transforms, and resume only with the data of the "
                "saved state."
            )

    def _climbing(self, fit_state: FitState, *, alike: bool = True) -> StreamProgress:
        near = min(_NEAR * float(self.survey.weight.sum()) ** 0.5, _FURTHEST)
        climb = Descent.begin(
            fit_state, self.begun.slopes, near=near, stop=2.0 * near, fresh=True, slow=_SLOW, alike=alike
        )
        return replace(self, phase="climb", climb=climb)._rounded()

    def _gaussian(self, climb: Descent) -> FitState | None:
        """Gaussian density at weighted least squares, as in memory, if its likelihood is higher."""
        state, survey, n = climb.fit_state, self.survey, self.survey.shape.n
        assert state.log_bound is not None
        assert state.log_d_min is not None
        if not (state.free_kappa and state.free_d):
            return None
        frame = survey.frame()
        basis = survey.to_coef()
        rows, targets, least = survey.triangle[..., :n] @ basis, survey.triangle[..., n], torch.exp(state.log_d_min[0])

        def solved(precision: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            gram = torch.einsum("c,cki,ckj->ij", precision, rows, rows)
            beta = solve_gram(gram, torch.einsum("c,cki,ck->i", precision, rows, targets))
            mean_square = (targets - rows @ beta).square().sum(-1) / survey.weight
            return beta, torch.maximum(mean_square.sqrt(), least), mean_square

        beta, d, mean_square = solved(torch.ones_like(survey.weight))
        for _ in range(2 if survey.shape.m > 1 else 0):
            beta, d, mean_square = solved(relative_precision(d))
        norm = normaliser_derivatives(torch.zeros_like(d), torch.log(d), state.log_bound[0]).value
        if float((0.5 * mean_square / d.square() + norm).sum()) >= climb.history[-1]:
            return None
        beta = beta if frame is not None else basis @ beta
        return replace(
            state, beta=beta.unsqueeze(0), kappa=torch.zeros_like(state.kappa), log_d=torch.log(d).unsqueeze(0)
        )

    def results(self) -> dict[str, Any]:
        """Attributes of a fitted estimator, by name, after the last pass and the step after it."""
        climb, survey, frame = self.climb, self.survey, self.survey.frame()
        assert climb is not None
        assert climb.best is not None
        assert climb.result is not None
        assert climb.curvature_sums is not None
        assert climb.fit_state.log_bound is not None
        place = climb.stepped() if climb.done else climb.best.point
        left = survey.used - survey.shape.n
        coef, covariance = place.beta[0], sandwich_of(climb.curvature_sums, survey.used, left)
        if frame is not None:
            coef, covariance = frame @ coef, frame @ covariance @ frame.mT
        return {
            "coef_": coef,
            "sigma_": place.kappa[0].rsqrt(),
            "d_": torch.exp(place.log_d[0]),
            "bound_": torch.exp(climb.fit_state.log_bound[0]),
            "log_likelihood_": -(climb.result.total.weight * climb.best.by_channel.value).sum(),
            "covariance_": covariance,
            "dof_": torch.tensor(float(left), dtype=torch.float64),
            "history_": torch.tensor(climb.history, dtype=torch.float64),
            "exact_fit_": torch.tensor(self.begun.exact),
            "converged_": torch.tensor(self.converged),
            "n_iter_": self.passes,
            "n_rows_": survey.rows,
            "n_pilot_": self.begun.rows,
            "n_light_": int(climb.curvature_sums.light),
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the state as numbers, texts and tensors, readable by ``torch.load(..., weights_only=True)``."""
        return {"format": FORMAT, **_plain(self)}

    @staticmethod
    def of(state: dict[str, Any]) -> StreamProgress:
        """Restore from :meth:`state_dict`.

        Raises:
            ValueError: not such a state.
        """
        if not isinstance(state, dict) or state.get("format") != FORMAT:
            raise ValueError(
                "Expected a state of StreamedMKCRegression, of this version, but got something else; start over "
                "without it."
            )
        return StreamProgress(**{key: _restored(key, value) for key, value in state.items() if key != "format"})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state to a file atomically."""
        buffer = io.BytesIO()
        torch.save(self.state_dict(), buffer)
        write_atomically(path, buffer.getvalue(), overwrite=True)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> StreamProgress | None:
        """Read the state from a file; None if there is no file.

        Raises:
            ValueError: the file holds something else.
        """
        if not Path(path).exists():
            return None
        try:
            state = torch.load(path, weights_only=True)
        except OSError:  # an unreadable file is not a damaged file
            raise
        except Exception as error:  # torch raises various errors for foreign files
            raise ValueError(
                f"Expected argument `checkpoint` to be a checkpoint of StreamedMKCRegression but {path} is not, or is "
                "damaged; delete it to start over, or choose another name."
            ) from error
        return StreamProgress.of(state)

    def refuse_other_settings(self, settings: dict[str, Any]) -> None:
        """Refuse to resume a fit that was made with other parameters.

        Raises:
            ValueError: they differ.
        """
        for name, value in settings.items():
            if self.settings.get(name) != value:
                raise ValueError(
                    f"Expected argument `{name}` as in the saved state, {self.settings.get(name)!r}, but got "
                    f"{value!r}; use that value, or start over without the state."
                )


def _plain(value: Any) -> Any:
    """Nested parts of a state as dictionaries."""
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if hasattr(value, "_asdict"):
        return {name: _plain(part) for name, part in value._asdict().items()}
    return value


def _restored(name: str, value: Any) -> Any:
    if name not in _CLASSES or not isinstance(value, dict):
        return value
    return _CLASSES[name](**{key: _restored(key, part) for key, part in value.items()})

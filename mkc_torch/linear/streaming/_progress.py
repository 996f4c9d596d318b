"""State of a streamed fit between two passes; its size does not depend on the number of rows."""

from __future__ import annotations

import io
import os
from dataclasses import asdict, dataclass, replace
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from mkc_torch._support.files import write_atomically
from mkc_torch.density.likelihood import normaliser_derivatives
from mkc_torch.linear._problem import solve_gram
from mkc_torch.linear._scale_search import relative_precision
from mkc_torch.linear.streaming._blocks import Shape
from mkc_torch.linear.streaming._newton import NEAR, Likelihood, NewtonState, StreamParameters
from mkc_torch.linear.streaming._pilot import PilotFit
from mkc_torch.linear.streaming._sums import Extremes, StreamPoint, StreamSums
from mkc_torch.linear.streaming._survey import Survey

if TYPE_CHECKING:
    from jaxtyping import Float64

__all__ = ["Phase", "StreamChangedError", "StreamProgress"]

Phase = Literal["range", "climb", "report", "done"]

FORMAT = 1
"""Version of a saved state; another version is refused."""

_SAME = 1e-9
"""Share of a column's absolute sum by which its sum may differ between float64 passes.

Rounding in another order is a hundredth of it, and a millionth of the rows with other values exceeds it."""

_SAME_FLOAT32 = 1e-5
"""The same for a float32 pass."""


class StreamChangedError(ValueError):
    """A pass had other rows than the first pass."""


@dataclass(frozen=True)
class StreamProgress:
    """A fit between two passes.

    Attributes:
        settings: parameters of the fit, by name.
        survey: the survey of all rows.
        begun: the pilot fit.
        phase: purpose of the next pass: the range of the residuals, the maximum, or the covariance at it; or "done".
        passes: number of passes made.
        log_bound: log half-width of the domain, (m,).
        climb: state of the maximisation, once it has begun.
        gaussian: whether a Gaussian density at least squares has been tried.
        converged: whether the maximum was reached.
    """

    settings: dict[str, Any]
    survey: Survey
    begun: PilotFit
    phase: Phase
    passes: int
    log_bound: Float64[Tensor, " m"]
    climb: NewtonState | None = None
    gaussian: bool = False
    converged: bool = False

    @staticmethod
    def begin(settings: dict[str, Any], survey: Survey, begun: PilotFit) -> StreamProgress:
        # with a sample of all rows the range is known
        known = settings["bound"] is not None or begun.rows == survey.rows
        progress = StreamProgress(settings, survey, begun, "range", 1, begun.log_bound)
        return progress._climbing(begun.log_bound) if known else progress

    def likelihood(self) -> Likelihood:
        transformed = (
            torch.eye(self.survey.shape.n, dtype=torch.float64)
            if self.survey.is_ill_conditioned()
            else self.survey.to_coef()
        )
        return Likelihood(
            weight=self.survey.weight,
            log_bound=self.log_bound,
            log_d_min=self.begun.log_d_min,
            free_kappa=self.begun.free_kappa,
            free_d=self.begun.free_d,
            to_basis=transformed,
            largest=float(self.survey.largest.max()),
            single=self.survey.single and not self.survey.is_ill_conditioned(),
        )

    def point(self) -> StreamPoint:
        """The point at which the next pass is made."""
        if self.climb is None:
            beta, kappa, log_d = self._in_basis(self.begun.coef), self.begun.kappa, self.begun.log_d
        else:
            beta, kappa, log_d = self.climb.trial.beta, self.climb.trial.kappa, self.climb.trial.log_d
        to_coef, transformed = self.survey.to_coef(), self.survey.is_ill_conditioned()
        return StreamPoint(
            coef=(beta if transformed else to_coef @ beta).numpy(),
            kappa=kappa.numpy(),
            d=torch.exp(log_d).numpy(),
            to_basis=to_coef.numpy() if transformed else None,
        )

    def after_range(self, parts: list[Extremes]) -> StreamProgress:
        """Set the domain: half the range of all residuals, and at least the sample's, which includes ten of its d.

        Args:
            parts: results of the ranks, in their order.

        Raises:
            StreamChangedError: the pass had other rows.
        """
        whole = reduce(Extremes.with_others, parts)
        self.refuse_other_rows(whole.rows, torch.from_numpy(whole.residual), self.begun.coef, _SAME)
        half = 0.5 * torch.from_numpy(whole.high - whole.low)
        bound = torch.maximum(torch.exp(self.begun.log_bound), half)
        return replace(self, passes=self.passes + 1)._climbing(torch.log(bound))

    def after_slopes(self, sums: StreamSums, max_passes: int) -> StreamProgress:
        """Make one Newton step towards the maximum.

        Raises:
            StreamChangedError: the pass had other rows.
        """
        assert self.climb is not None
        self._refuse_other_sums(sums, self.climb)
        likelihood = self.likelihood()
        climb = self.climb.after(likelihood, sums)
        now = replace(self, passes=self.passes + 1, climb=climb)
        # the precision of a fit through most values to rounding is limited
        near = climb.near or (self.begun.exact and len(climb.history) >= 8)
        if not near and now.passes < max_passes - 1:
            return now
        if near and not self.gaussian and self.begun.free_kappa and self.begun.free_d:
            place, value = self._gaussian(likelihood)
            if value < climb.history[-1]:
                return replace(now, climb=NewtonState(place, history=climb.history), gaussian=True)
        if not near and climb.place is not None:
            climb = replace(climb, trial=climb.place)
        return replace(now, climb=replace(climb, curvature=True, rough=False), phase="report", gaussian=True)

    def after_report(self, sums: StreamSums, max_passes: int) -> StreamProgress:
        """Make a last step with the Hessian of the report pass; continue the maximisation if the step is too long.

        Raises:
            StreamChangedError: the pass had other rows.
        """
        assert self.climb is not None
        self._refuse_other_sums(sums, self.climb)
        climb = self.climb.after(self.likelihood(), sums)
        head = float(2.0 * sums.qw.sum() / self.survey.weight.sum())
        converged = self.begun.exact or climb.near or climb.gain <= 10.0 * NEAR * head
        now = replace(self, passes=self.passes + 1, climb=climb)
        if converged or now.passes >= max_passes:
            return replace(now, phase="done", converged=converged)
        return replace(now, phase="climb")

    def _refuse_other_sums(self, sums: StreamSums, climb: NewtonState) -> None:
        coef = self.survey.to_coef() @ climb.trial.beta
        self.refuse_other_rows(int(sums.rows), sums.residual, coef, _SAME_FLOAT32 if climb.rough else _SAME)

    def refuse_other_rows(
        self, rows: int, residual: Float64[Tensor, " m"], coef: Float64[Tensor, " n"], same: float
    ) -> None:
        """Refuse a pass whose rows differ from those of the first.

        Args:
            rows: number of rows of the pass.
            residual: sums of its weighted residuals.
            coef: coefficients of these residuals.
            same: tolerance as a share of the sums of absolute values.

        Raises:
            StreamChangedError: the rows differ.
        """
        survey, n = self.survey, self.survey.shape.n
        if rows != survey.rows:
            raise StreamChangedError(
                f"Expected `batches` to yield the same rows in every pass but got {rows}, after {survey.rows} in the "
                "first; shuffle if you like, but do not drop a last batch or redraw rows."
            )
        expected = survey.total[:, n] - survey.total[:, :n] @ coef
        # upper bound of a column's sum of absolute values, by Cauchy-Schwarz
        size = (survey.weight.unsqueeze(-1) * survey.triangle.square().sum(-2)).sqrt()
        size = size[:, n] + size[:, :n] @ coef.abs()
        wrong = ~((residual - expected).abs() <= same * size)
        if bool(wrong.any()):
            raise StreamChangedError(
                "Expected `batches` to yield the same values in every pass but got residuals that sum to "
                f"{float(residual[wrong][0]):.6g} where those of the first pass sum to "
                f"{float(expected[wrong][0]):.6g}; remove random transforms, and resume only with the data of the "
                "saved state."
            )

    def _climbing(self, log_bound: Float64[Tensor, " m"]) -> StreamProgress:
        begun = self.begun
        # keep the tail density exp(-1/κ) / bound unchanged on the longer domain
        longer = torch.where(begun.kappa > 0, begun.kappa, 1.0).reciprocal() + log_bound - begun.log_bound
        kappa = torch.where(begun.kappa > 0, longer.reciprocal(), 0.0) if begun.free_kappa else begun.kappa
        place = StreamParameters(self._in_basis(begun.coef), kappa, begun.log_d)
        now = replace(self, phase="climb", log_bound=log_bound)
        likelihood = now.likelihood()
        of_sample = replace(likelihood, weight=begun.weight)
        hessian = of_sample.hessian(place, StreamSums.of(begun.sums, self.survey.shape))
        rough = likelihood.allows_float32(place) and begun.rows < self.survey.rows
        return replace(now, climb=NewtonState(place, curvature=False, rough=rough, hessian=hessian, stale=True))

    def _gaussian(self, likelihood: Likelihood) -> tuple[StreamParameters, float]:
        """Gaussian density at weighted least squares, as in memory, and its mean negative log-likelihood."""
        n = self.survey.shape.n
        triangle = self.survey.triangle.clone()
        triangle[..., :n] = triangle[..., :n] @ self.survey.to_coef()
        rows, targets = triangle[..., :n], triangle[..., n]

        def solved(precision: Tensor) -> tuple[Tensor, Tensor]:
            gram = torch.einsum("c,cki,ckj->ij", precision, rows, rows)
            beta = solve_gram(gram, torch.einsum("c,cki,ck->i", precision, rows, targets))
            mean_square = (targets - rows @ beta).square().sum(-1) / self.survey.weight
            return beta, torch.maximum(mean_square.sqrt(), torch.exp(likelihood.log_d_min))

        beta, d = solved(torch.ones_like(self.survey.weight))
        for _ in range(2 if self.survey.shape.m > 1 else 0):
            beta, d = solved(relative_precision(d))
        mean_square = (targets - rows @ beta).square().sum(-1) / self.survey.weight
        place = StreamParameters(beta, torch.zeros_like(d), torch.log(d))
        norm = normaliser_derivatives(place.kappa, place.log_d, likelihood.log_bound).value
        return place, float((0.5 * mean_square / d.square() + norm).sum())

    def _in_basis(self, coef: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
        return torch.linalg.solve(self.survey.to_coef(), coef.unsqueeze(-1)).squeeze(-1)

    def state_dict(self) -> dict[str, Any]:
        """Return the state as numbers, texts and tensors, readable by ``torch.load(..., weights_only=True)``."""
        return {"format": FORMAT, **asdict(self)}

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
        fields = {key: value for key, value in state.items() if key != "format"}
        survey, climb = dict(fields["survey"]), fields["climb"]
        fields["survey"] = Survey(**{**survey, "shape": Shape(**survey["shape"])})
        fields["begun"] = PilotFit(**fields["begun"])
        if climb is not None:
            places = {
                name: None if climb[name] is None else StreamParameters(**climb[name]) for name in ("trial", "place")
            }
            fields["climb"] = NewtonState(**{**climb, **places, "history": tuple(climb["history"])})
        return StreamProgress(**fields)

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

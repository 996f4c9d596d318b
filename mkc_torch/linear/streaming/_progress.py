"""How far a streamed fit has come between two passes: all that it needs to go on, whatever the number of rows."""

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
"""Of a saved state; another one is refused."""

_SAME, _SAME_OF_ROUGH = 1e-9, 1e-5
"""Share of a sum's absolute values by which it may differ from pass to pass, in float64 and float32: rounding in
another order is a hundredth of it, and a millionth of the rows in other values is seen."""


class StreamChangedError(ValueError):
    """The rows of a pass are not those that the fit began with."""


@dataclass(frozen=True)
class StreamProgress:
    """A fit between two passes.

    Attributes:
        settings: what the fit was asked for, by name.
        survey: of all rows.
        begun: of the sample.
        phase: what the next pass is for: the range of the residuals, the maximum, or the covariance at it; or "done".
        passes: made so far.
        log_bound: of the domain, (m,).
        climb: to the maximum, once that has begun.
        gaussian: a Gaussian density at least squares has been looked at.
        converged: the maximum is one.
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
        # a sample of all rows has had their range
        known = settings["bound"] is not None or begun.rows == survey.rows
        progress = StreamProgress(settings, survey, begun, "range", 1, begun.log_bound)
        return progress._climbing(begun.log_bound) if known else progress

    def likelihood(self) -> Likelihood:
        turned = (
            torch.eye(self.survey.shape.n, dtype=torch.float64) if self.survey.is_turned() else self.survey.to_coef()
        )
        return Likelihood(
            weight=self.survey.weight,
            log_bound=self.log_bound,
            log_d_min=self.begun.log_d_min,
            free_kappa=self.begun.free_kappa,
            free_d=self.begun.free_d,
            to_basis=turned,
            largest=float(self.survey.largest.max()),
            single=self.survey.single and not self.survey.is_turned(),
        )

    def point(self) -> StreamPoint:
        """Where the next pass is made."""
        if self.climb is None:
            beta, kappa, log_d = self._in_basis(self.begun.coef), self.begun.kappa, self.begun.log_d
        else:
            beta, kappa, log_d = self.climb.trial.beta, self.climb.trial.kappa, self.climb.trial.log_d
        to_coef, turned = self.survey.to_coef(), self.survey.is_turned()
        return StreamPoint(
            coef=(beta if turned else to_coef @ beta).numpy(),
            kappa=kappa.numpy(),
            d=torch.exp(log_d).numpy(),
            to_basis=to_coef.numpy() if turned else None,
        )

    def after_range(self, parts: list[Extremes]) -> StreamProgress:
        """The domain is half the range of all rows' residuals, and no less than the sample's: its ten d are in that.

        Args:
            parts: of the ranks, in their order.

        Raises:
            StreamChangedError: the pass had other rows.
        """
        whole = reduce(Extremes.with_others, parts)
        self.refuse_other_rows(whole.rows, torch.from_numpy(whole.residual), self.begun.coef, _SAME)
        half = 0.5 * torch.from_numpy(whole.high - whole.low)
        bound = torch.maximum(torch.exp(self.begun.log_bound), half)
        return replace(self, passes=self.passes + 1)._climbing(torch.log(bound))

    def after_slopes(self, sums: StreamSums, max_passes: int) -> StreamProgress:
        """One step nearer to the maximum.

        Raises:
            StreamChangedError: the pass had other rows.
        """
        assert self.climb is not None
        self._refuse_other_sums(sums, self.climb)
        likelihood = self.likelihood()
        climb = self.climb.after(likelihood, sums)
        now = replace(self, passes=self.passes + 1, climb=climb)
        # a fit through most values to rounding is at the limit of what can be said
        # a fit through most values to rounding is at the limit of what can be said
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
        """A last step, by the Hessian that the report has with it; on with the climb where that is too long a one.

        Raises:
            StreamChangedError: the pass had other rows.
        """
        assert self.climb is not None
        self._refuse_other_sums(sums, self.climb)
        climb = self.climb.after(self.likelihood(), sums)
        head = float(2.0 * sums.qw.sum() / self.survey.weight.sum())
        rested = self.begun.exact or climb.near or climb.gain <= 10.0 * NEAR * head
        now = replace(self, passes=self.passes + 1, climb=climb)
        if rested or now.passes >= max_passes:
            return replace(now, phase="done", converged=rested)
        return replace(now, phase="climb")

    def _refuse_other_sums(self, sums: StreamSums, climb: NewtonState) -> None:
        coef = self.survey.to_coef() @ climb.trial.beta
        self.refuse_other_rows(int(sums.rows), sums.residual, coef, _SAME_OF_ROUGH if climb.rough else _SAME)

    def refuse_other_rows(
        self, rows: int, residual: Float64[Tensor, " m"], coef: Float64[Tensor, " n"], same: float
    ) -> None:
        """Refuse a pass whose rows are not those of the first.

        Args:
            rows: of the pass.
            residual: sums of its weighted residuals.
            coef: coefficients that these are of.
            same: share of the sums of absolute values by which those of the same rows may differ.

        Raises:
            StreamChangedError: they are others.
        """
        survey, n = self.survey, self.survey.shape.n
        if rows != survey.rows:
            raise StreamChangedError(
                f"Expected `batches` to give the same rows in every pass but got {rows}, after {survey.rows} in the "
                "first; shuffling is fine, dropping a last batch or drawing rows anew is not."
            )
        expected = survey.total[:, n] - survey.total[:, :n] @ coef
        # of a column's absolute values, by Cauchy and Schwarz at most
        size = (survey.weight.unsqueeze(-1) * survey.triangle.square().sum(-2)).sqrt()
        size = size[:, n] + size[:, :n] @ coef.abs()
        wrong = ~((residual - expected).abs() <= same * size)
        if bool(wrong.any()):
            raise StreamChangedError(
                "Expected `batches` to give the same values in every pass but got residuals that sum to "
                f"{float(residual[wrong][0]):.6g} where those of the first pass sum to "
                f"{float(expected[wrong][0]):.6g}; leave out random transforms, and go on only with the data of the "
                "state."
            )

    def _climbing(self, log_bound: Float64[Tensor, " m"]) -> StreamProgress:
        begun = self.begun
        # the density of the tail stays as it is on a longer domain: exp(-1/κ) / bound
        longer = torch.where(begun.kappa > 0, begun.kappa, 1.0).reciprocal() + log_bound - begun.log_bound
        kappa = torch.where(begun.kappa > 0, longer.reciprocal(), 0.0) if begun.free_kappa else begun.kappa
        place = StreamParameters(self._in_basis(begun.coef), kappa, begun.log_d)
        now = replace(self, phase="climb", log_bound=log_bound)
        likelihood = now.likelihood()
        of_sample = replace(likelihood, weight=begun.weight)
        hessian = of_sample.hessian(place, StreamSums.of(begun.sums, self.survey.shape))
        rough = likelihood.allows_rough(place) and begun.rows < self.survey.rows
        return replace(now, climb=NewtonState(place, curvature=False, rough=rough, hessian=hessian, stale=True))

    def _gaussian(self, likelihood: Likelihood) -> tuple[StreamParameters, float]:
        """The Gaussian density at weighted least squares, as in memory, and its mean negative log-likelihood."""
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
        """Numbers, texts and tensors, as ``torch.load(..., weights_only=True)`` reads them."""
        return {"format": FORMAT, **asdict(self)}

    @staticmethod
    def of(state: dict[str, Any]) -> StreamProgress:
        """From :meth:`state_dict`.

        Raises:
            ValueError: it is no such state.
        """
        if not isinstance(state, dict) or state.get("format") != FORMAT:
            raise ValueError(
                "Expected the state of a streamed fit of this version but got another thing; begin anew without it."
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
        """Write the state to a file, whole or not at all."""
        buffer = io.BytesIO()
        torch.save(self.state_dict(), buffer)
        write_atomically(path, buffer.getvalue(), overwrite=True)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> StreamProgress | None:
        """The state in a file; None where there is no file.

        Raises:
            ValueError: the file holds something else.
        """
        if not Path(path).exists():
            return None
        try:
            state = torch.load(path, weights_only=True)
        except OSError:  # a file that may not be read is not a damaged one
            raise
        except Exception as error:  # torch has no one error for what it did not write
            raise ValueError(
                f"Expected argument `checkpoint` to be a file of a streamed fit but {path} is none, or a damaged one; "
                "choose another name."
            ) from error
        return StreamProgress.of(state)

    def refuse_other_settings(self, settings: dict[str, Any]) -> None:
        """Refuse to go on with a fit that was asked for with other parameters.

        Raises:
            ValueError: they differ.
        """
        for name, value in settings.items():
            if self.settings.get(name) != value:
                raise ValueError(
                    f"Expected argument `{name}` of the fit that the state is of, {self.settings.get(name)!r}, but got "
                    f"{value!r}; take that, or begin anew without the state."
                )

"""MKC-EM on rows that come in batches, pass after pass: the maximum of MKCRegression in constant memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_whole
from mkc_torch._support.arrays import Data, as_tensor
from mkc_torch._support.ranks import Ranks
from mkc_torch.linear._estimator import NotFittedError
from mkc_torch.linear._inference import Inference
from mkc_torch.linear._robust_start import Start
from mkc_torch.linear.em import MKCRegression
from mkc_torch.linear.streaming._batches import checked_source
from mkc_torch.linear.streaming._maximum import streamed_maximum
from mkc_torch.linear.streaming._pilot import fit_pilot
from mkc_torch.linear.streaming._reservoir import Drawn, Reservoir, largest_key, merged
from mkc_torch.linear.streaming._rows import StreamChangedError, StreamedRows
from mkc_torch.linear.streaming._state import StreamState
from mkc_torch.linear.streaming._survey import Survey, survey_rows

if TYPE_CHECKING:
    from jaxtyping import Float64

__all__ = ["StreamChangedError", "StreamedMKCRegression"]


class StreamedMKCRegression(Inference):
    """:class:`mkc_torch.linear.MKCRegression` on more rows than memory holds: the same maximum, in passes over batches.

    The first pass checks and counts the rows and draws a uniform sample of them, which :class:`MKCRegression` fits in
    memory. A second pass sets the domain: half the range of all residuals of that fit, and at least that of the sample.
    It is not needed if the sample has all rows. Newton's method on the coefficients and each channel's σ and d then
    maximises the likelihood of all rows, from the sample's maximum, by the passes of :class:`MKCRegression` over many
    rows: one to three for the gradient, and a last for the covariance. Sums are float64, also for float32 data; if all
    rows are float32 on a CPU and residuals are not small compared to Y, passes far from the maximum multiply in
    float32. Memory does not grow with the rows: one batch, a block of 33 000 values of Y or 8 000 rows, and during the
    first pass twice the sample.

    If the sample has all rows, the results are those of ``MKCRegression()`` in float64, domain included, to 1e-8 or to
    the accuracy of its maximum. With more rows the domain depends on the sample: ``MKCRegression(bound=fit.bound_)``
    gives the same result to 1e-8 if it finds the same maximum, except for the covariance, which agrees to 1e-4, and
    usually to 1e-6: the last pass sums it before the last step, up to 4e-5 standard errors of a row from the maximum.
    With ``bound`` given, only the start depends on the sample.

    In a process group of ``torch.distributed``, for example of torchrun, each rank has its own part of the rows, which
    may be empty, and the sums are over all ranks. All ranks end with bitwise equal numbers. An error on one rank is an
    error on all. So is a rank that dies, which gloo reports at once, and a rank that hangs, after the group's timeout.
    Tensors on a GPU are summed there; with the backend nccl the sums of the ranks are added there too.

    Args:
        sigma: None learns σ; a number in [0.05, inf], or a list of one number for each channel, fixes it.
        d: None learns d; a value fixes it, in the unit of Y.
        bound: half-width of the domain in the unit of Y; None takes the rule above.
        start: start of the sample's fit, "lts", "s", "least_squares", or a list or tensor of coefficients.
        pilot: largest number of rows of the sample. Its fit takes some 70 MB with 8 columns and 380 MB with 60. With
            fewer than a few hundred rows it may lead to another maximum where outliers are many.
        max_passes: largest number of passes over the rows, at least 4; a fit takes 4 to 7.
        seed: seed of the sample and of its start.

    Attributes, after ``fit`` (m is 1 for one channel given as (N,)):
        coef_: (n,), float64.
        sigma_, d_, bound_: (m,): bandwidth (``inf`` for a Gaussian channel), scale and half-width of the domain.
        log_likelihood_: sum over rows and channels; compare only at equal ``bound_``.
        covariance_: sandwich covariance of the coefficients at the learned σ and d for independent rows, (n, n).
        dof_: number of values of positive weight minus number of coefficients.
        history_: mean negative log-likelihood per row, summed over channels, at every pass of the maximisation.
        exact_fit_: whether more than half of the sample lies on the fit to rounding.
        converged_: whether the fit converged.
        n_iter_: number of passes over the rows.
        n_rows_, n_pilot_: number of rows, and of rows in the sample.
        n_light_: number of values with a weight below 0.1, which the fit nearly excludes.

    There is no ``weights_``, which would be as long as the rows: :meth:`weights` returns those of a batch.

    Raises:
        TypeError, ValueError: an argument of the wrong type, or out of range.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17), Algorithm 3.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> X = torch.stack([torch.ones(100), torch.linspace(-5, 5, 100)], -1).double()
        >>> y = X.sum(-1) + 0.1 * torch.randn(100, generator=generator, dtype=torch.float64)
        >>> y[:20] += 20.0
        >>> loader = torch.utils.data.DataLoader(torch.utils.data.TensorDataset(X, y), batch_size=32)
        >>> StreamedMKCRegression().fit(loader).coef_
        tensor([0.9992, 1.0072], dtype=torch.float64)
    """

    _fit_takes = "batches"

    def __init__(
        self,
        *,
        sigma: float | list[float] | Tensor | None = None,
        d: float | list[float] | Tensor | None = None,
        bound: float | list[float] | Tensor | None = None,
        start: Start | list[float] | Tensor = "lts",
        pilot: int = 50_000,
        max_passes: int = 60,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.covariance = "sandwich"
        self.sigma, self.d, self.bound, self.start = sigma, d, bound, start
        self.pilot = checked_whole("pilot", pilot, 2, "50000 rows are ample")
        self.max_passes = checked_whole("max_passes", max_passes, 4, "60 is ample")
        self.seed = checked_whole("seed", seed, 0)
        self._of_sample()
        self._state: StreamState | None = None
        self._resume_from: StreamState | None = None

    def __getattr__(self, name: str) -> Any:
        if name == "weights_":
            raise AttributeError("A streamed fit keeps no `weights_`; call weights(X, Y) for those of a batch.")
        return super().__getattr__(name)

    def fit(  # type: ignore[override]
        self,
        batches: Iterable[Any] | Callable[[], Iterable[Any]],
        *,
        group: Any = None,
        checkpoint: str | os.PathLike[str] | None = None,
    ) -> StreamedMKCRegression:
        """Fit ``Y ~ X coef`` of all batches.

        Args:
            batches: yields (X, Y) or (X, Y, weight) in every pass: a DataLoader, a list, :func:`from_memmap`,
                :func:`from_parquet`, or a function without arguments that returns an iterator. X is (N, n) with Y (N,),
                or (N, m, n) with (N, m), as tensors or arrays. The order of rows may change from pass to pass, the rows
                may not. In a process group, this rank's batches.
            group: process group of ``torch.distributed``; None takes the default group if it is initialised.
            checkpoint: file to which the state is written after every pass. If it exists, the fit resumes from it; data
                and parameters must be the same. Only rank 0 reads and writes it.

        Raises:
            TypeError: ``batches`` can be iterated over only once, or a batch is not a pair or triple of arrays.
            ValueError: bad values, reported by batch and row, shapes that do not fit, no rows, or a checkpoint of
                something else.
            StreamChangedError: a pass had other rows than the first.
            RankDeficientError: columns of X are linearly dependent.
            RanksError: another rank failed or was lost.
        """
        ranks = Ranks(group)
        counts = ranks.gathered(lambda: getattr(checked_source(batches), "rows", None))
        source = checked_source(batches)
        resume_from, self._resume_from = self._resume_from, None
        state = ranks.from_first(lambda: self._resumed(resume_from, checkpoint))
        if state is None:
            state = self._surveyed(ranks, source, counts)

        def keep(state: StreamState) -> None:
            ranks.from_first(lambda: None if checkpoint is None else state.save(checkpoint))
            # without the last pass, which a resumed fit makes again and thereby detects other data
            self._state = state

        rows = StreamedRows(ranks, source, state, keep)
        found, converged = streamed_maximum(rows, learns_domain=self.bound is None, max_passes=self.max_passes)
        for name, value in found.attributes().items():
            setattr(self, name, value)
        self._single_channel = state.survey.shape.single_channel
        self.history_ = found.history
        self.converged_, self.exact_fit_ = torch.tensor(converged), torch.tensor(state.pilot.exact)
        self.n_iter_, self.n_light_ = rows.passes, found.light
        self.n_rows_, self.n_pilot_ = state.survey.rows, state.pilot.rows
        self._name_columns(batches)
        return self

    def weights(self, X: Data, Y: Data) -> Float64[Tensor, "N m"]:
        """``exp(-e² / (2 d² σ²))`` of each value of a batch, its weight in the fit; (N, 1) for one channel.

        Args:
            X: as ``predict`` takes it.
            Y: (N,), or (N, m).

        Raises:
            NotFittedError, TypeError, ValueError: as ``predict``; Y differs in shape from the prediction.
        """
        fitted = self.predict(X)
        y = as_tensor("Y", Y, like=self.coef_)
        if y.shape != fitted.shape:
            raise ValueError(
                f"Expected argument `Y` of shape {tuple(fitted.shape)} but got {tuple(y.shape)}; pass the targets of "
                "`X`."
            )
        error = (y - fitted).unsqueeze(-1) if self._single_channel else y - fitted
        return torch.exp(-0.5 * (error / (self.d_ * self.sigma_)).square())

    def state_dict(self) -> dict[str, Any]:
        """State of the last fit after its last complete pass, for ``load_state_dict``; a few kB, without rows.

        Raises:
            NotFittedError: no pass was made.
        """
        if self._state is None:
            raise NotFittedError("StreamedMKCRegression has no state yet; call fit(batches) first.")
        return self._state.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Let the next ``fit`` resume from a state, with the same data.

        Raises:
            ValueError: not such a state, or a state of a fit with other parameters.
        """
        resume_from = StreamState.of(state)
        resume_from.refuse_other_settings(self._settings())
        self._resume_from = resume_from

    def _of_sample(self) -> MKCRegression:
        """Estimator of the sample, which also checks the parameters."""
        given = {"sigma": self.sigma, "d": self.d, "bound": self.bound, "start": self.start}
        tensors = {name: torch.tensor(v).double() if isinstance(v, list) else v for name, v in given.items()}
        return MKCRegression(**tensors, seed=self.seed)  # type: ignore[arg-type]

    def _settings(self) -> dict[str, Any]:
        names = ("sigma", "d", "bound", "start", "pilot", "seed")
        values = {name: getattr(self, name) for name in names}
        return {name: v.tolist() if isinstance(v, Tensor) else v for name, v in values.items()}

    def _resumed(self, given: StreamState | None, checkpoint: str | os.PathLike[str] | None) -> StreamState | None:
        """State to resume from: an existing checkpoint, or a given state."""
        state = None if checkpoint is None else StreamState.load(checkpoint)
        state = given if state is None else state
        if state is not None:
            state.refuse_other_settings(self._settings())
        return state

    def _surveyed(self, ranks: Ranks, batches: Iterable[Any], counts: list[int | None]) -> StreamState:
        """State after the first pass and the fit of the sample."""
        known = [count for count in counts if count is not None]
        first = sum(known[: ranks.rank]) if ranks.alone or len(known) == len(counts) else None
        rows = sum(known) if len(known) == len(counts) else None
        reservoir = Reservoir(self.pilot, self.seed, first, ranks.rank, rows)
        found = ranks.gathered(lambda: survey_rows(batches, reservoir))
        surveys = [survey for survey in found if survey is not None]
        drawn = ranks.gathered(lambda: _likely(reservoir.drawn(), self.pilot, sum(survey.rows for survey in surveys)))

        def begin() -> StreamState:
            survey = Survey.of_all(surveys)
            sample = merged([part for part in drawn if part is not None], self.pilot)
            return StreamState(self._settings(), survey, fit_pilot(sample, survey, self._of_sample()))

        return ranks.from_first(begin)

    def _light(self, problem: tuple[int, ...]) -> tuple[int, int]:  # noqa: ARG002
        return self.n_rows_ * self.d_.shape[0], self.n_light_

    def _name_columns(self, batches: object) -> None:
        """Store the column names of X that a table on disk has."""
        self.__dict__.pop("feature_names_in_", None)
        names = getattr(batches, "column_names", None)
        if names is not None:
            self.feature_names_in_ = names


def _likely(drawn: Drawn | None, size: int, rows: int) -> Drawn | None:
    """Rows of a rank's sample that may be in the sample of all ranks; the others need not be sent."""
    if drawn is None or rows <= size:
        return drawn
    chosen = drawn.keys < largest_key(size, rows)
    return Drawn(drawn.keys[chosen], drawn.numbers[chosen], drawn.rows[chosen])

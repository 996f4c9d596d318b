"""MKC-EM on rows that come in batches, pass after pass: the maximum that MKCRegression finds, in constant memory."""

from __future__ import annotations

import math
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
from mkc_torch.linear.streaming._blocks import checked_source
from mkc_torch.linear.streaming._float32_pass import float32_pass
from mkc_torch.linear.streaming._pilot import begun_from
from mkc_torch.linear.streaming._progress import StreamChangedError, StreamProgress
from mkc_torch.linear.streaming._reservoir import Drawn, Reservoir, merged
from mkc_torch.linear.streaming._results import results
from mkc_torch.linear.streaming._sums import Report, StreamSums, range_pass, report_pass, slopes_pass
from mkc_torch.linear.streaming._survey import Survey, surveyed

if TYPE_CHECKING:
    from jaxtyping import Float64

__all__ = ["StreamChangedError", "StreamedMKCRegression"]


class StreamedMKCRegression(Inference):
    """:class:`mkc_torch.linear.MKCRegression` on more rows than memory holds: the same maximum, in passes over batches.

    The first pass checks and counts the rows and draws a uniform sample of them, which :class:`MKCRegression` fits in
    memory. A second takes the domain by the rule of memory, half the range of all residuals of that fit and no less
    than the sample's, unless it has all rows. From its maximum Newton's method on the coefficients and each channel's σ
    and d goes up the likelihood of all rows, two to four passes, and a last pass gives the covariance. The sums that
    decide are of float64, of float32 data too. Memory does not grow with the rows: it holds one batch, a block of
    80 000 numbers, and while the first pass is made twice the sample.

    Where the sample holds all rows, the results are those of ``MKCRegression()`` in float64, domain included, to 1e-8
    or as near as that comes to its maximum. Of more rows it is the maximum on a domain that the sample has a part in:
    ``MKCRegression(bound=fit.bound_)`` finds the same to 1e-8, where it finds the same maximum, and ``bound`` given
    leaves nothing to the sample but the start.

    In a process group of ``torch.distributed``, as torchrun starts one, each rank is given its own part of the rows,
    which may be none, and the sums are those of all. Every rank ends with the same numbers to the bit. An error on one
    is an error on all; so is a rank that dies, of which gloo tells the others at once, and one that hangs, once the
    group's timeout has passed. The calculation is made on the CPU, wherever the batches lie.

    Args:
        sigma: None learns σ; a number in [0.05, inf] keeps it, or a list of one for each channel.
        d: None learns d; a value keeps it, in the unit of Y.
        bound: half-width of the domain in the unit of Y; None takes the rule above.
        start: of the sample's fit, "lts", "s", "least_squares", or a list or tensor of coefficients.
        pilot: rows of the sample at most. Its fit takes some 70 MB with 8 columns and 380 MB with 60; one of
            less than a few hundred rows may lead to another maximum where outliers are many.
        max_passes: over the rows at most, 4 at least; a fit takes 5 to 8.
        seed: of the sample and of its start.

    Attributes, after ``fit`` (m is 1 for one channel given as (N,)):
        coef_: (n,), float64.
        sigma_, d_, bound_: (m,): bandwidth (``inf`` for a Gaussian channel), scale and half-width of the domain.
        log_likelihood_: sum over rows and channels; compare only at equal ``bound_``.
        covariance_: sandwich covariance of the coefficients at the learned σ and d for independent rows, (n, n).
        dof_: values of positive weight less coefficients.
        history_: mean negative log-likelihood of a row, summed over channels, at every pass for the maximum.
        exact_fit_: more than half of the sample lies on the fit to rounding.
        converged_: whether the fit came to rest.
        n_iter_: passes made over the rows.
        n_rows_, n_pilot_: rows, and those of the sample.
        n_light_: values of a weight below 0.1, which the fit all but leaves out.

    There is no ``weights_``, which would be as long as the rows: :meth:`weights` gives those of a batch.

    Raises:
        TypeError, ValueError: an argument of another kind, or out of range.

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
        self._progress: StreamProgress | None = None
        self._resume_from: StreamProgress | None = None

    def __getattr__(self, name: str) -> Any:
        if name == "weights_":
            raise AttributeError("A streamed fit keeps no `weights_`, one a row; weights(X, Y) gives those of a batch.")
        return super().__getattr__(name)

    def fit(  # type: ignore[override]
        self,
        batches: Iterable[Any],
        *,
        group: Any = None,
        checkpoint: str | os.PathLike[str] | None = None,
    ) -> StreamedMKCRegression:
        """Fit ``Y ~ X coef`` of all batches.

        Args:
            batches: gives (X, Y) or (X, Y, weight) and begins anew whenever it is iterated over: a DataLoader, a list,
                :func:`from_memmap`, :func:`from_parquet`. X is (N, n) with Y (N,), or (N, m, n) with (N, m), of tensors
                or arrays; the order of rows may change from pass to pass, the rows may not. Of a process group, this
                rank's own.
            group: of ``torch.distributed``; None takes the default group where it is initialised.
            checkpoint: a file that the state is written to after every pass. Where it is there already the fit goes on
                from it; it must be of the same data and parameters. Rank 0 alone reads and writes it.

        Raises:
            TypeError: ``batches`` can be gone through once only, or a batch is no pair or triple of arrays.
            ValueError: bad values, which are named by batch and row, shapes that do not fit, no rows, or a checkpoint
                of something else.
            StreamChangedError: a pass gave other rows than the first.
            RankDeficientError: columns of X are linearly dependent.
            RanksError: another rank failed or is gone.
        """
        ranks = Ranks(group)
        counts = ranks.gathered(lambda: getattr(checked_source(batches), "rows", None))
        resume_from, self._resume_from = self._resume_from, None
        progress = ranks.from_first(lambda: self._resumed(resume_from, checkpoint))
        if progress is None:
            progress = self._begun(ranks, batches, counts, checkpoint)
        if progress.phase == "range":
            progress = self._ranged(ranks, batches, progress, checkpoint)
        while progress.phase != "done":
            before = progress
            flat = ranks.sum_of(*_pass(batches, before))
            progress = self._kept(ranks, lambda: _after(before, flat, self.max_passes), checkpoint)  # noqa: B023
        self._single_channel = progress.survey.shape.single_channel
        found = ranks.from_first(lambda: results(before, progress, Report.of(flat, progress.survey.shape)))
        for name, value in found.items():
            setattr(self, name, value)
        self._name_columns(batches)
        return self

    def weights(self, X: Data, Y: Data) -> Float64[Tensor, "N m"]:
        """``exp(-e² / (2 d² σ²))`` of each value of a batch, with which it enters the fit; (N, 1) of one channel.

        Args:
            X: as ``predict`` takes it.
            Y: (N,), or (N, m).

        Raises:
            NotFittedError, TypeError, ValueError: as ``predict``; Y is of another shape than the prediction.
        """
        fitted = self.predict(X)
        y = as_tensor("Y", Y, like=self.coef_)
        if y.shape != fitted.shape:
            raise ValueError(f"Expected argument `Y` of shape {tuple(fitted.shape)} but got {tuple(y.shape)}.")
        error = (y - fitted).unsqueeze(-1) if self._single_channel else y - fitted
        return torch.exp(-0.5 * (error / (self.d_ * self.sigma_)).square())

    def state_dict(self) -> dict[str, Any]:
        """Where the last fit stands after its last whole pass, for ``load_state_dict``; without rows, in a few kB.

        Raises:
            NotFittedError: no pass has been made.
        """
        if self._progress is None:
            raise NotFittedError("StreamedMKCRegression has no state yet; call fit(batches) first.")
        return self._progress.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Let the next ``fit`` go on from a state, with the same data.

        Raises:
            ValueError: no such state, or one of a fit with other parameters.
        """
        progress = StreamProgress.of(state)
        progress.refuse_other_settings(self._settings())
        self._resume_from = progress

    def _of_sample(self) -> MKCRegression:
        """The estimator of the sample, which checks what both are given."""
        given = {"sigma": self.sigma, "d": self.d, "bound": self.bound, "start": self.start}
        tensors = {name: torch.tensor(v).double() if isinstance(v, list) else v for name, v in given.items()}
        return MKCRegression(**tensors, seed=self.seed)  # type: ignore[arg-type]

    def _settings(self) -> dict[str, Any]:
        names = ("sigma", "d", "bound", "start", "pilot", "seed")
        values = {name: getattr(self, name) for name in names}
        return {name: v.tolist() if isinstance(v, Tensor) else v for name, v in values.items()}

    def _resumed(
        self, given: StreamProgress | None, checkpoint: str | os.PathLike[str] | None
    ) -> StreamProgress | None:
        """Where to go on from: a checkpoint that is there, or a state that was given."""
        progress = None if checkpoint is None else StreamProgress.load(checkpoint)
        progress = given if progress is None else progress
        if progress is not None:
            progress.refuse_other_settings(self._settings())
        return progress

    def _begun(
        self,
        ranks: Ranks,
        batches: Iterable[Any],
        counts: list[int | None],
        checkpoint: str | os.PathLike[str] | None,
    ) -> StreamProgress:
        """After the first pass."""
        before = [count for count in counts[: ranks.rank] if count is not None]
        known = ranks.alone or None not in counts
        reservoir = Reservoir(self.pilot, self.seed, sum(before) if known else None, ranks.rank)
        found = ranks.gathered(lambda: surveyed(batches, reservoir))
        surveys = [survey for survey in found if survey is not None]
        drawn = ranks.gathered(lambda: _likely(reservoir.drawn(), self.pilot, sum(one.rows for one in surveys)))

        def begin() -> StreamProgress:
            survey = Survey.of_all(surveys)
            sample = merged([part for part in drawn if part is not None], self.pilot)
            to_basis = survey.to_coef() if survey.is_turned() else None
            begun = begun_from(sample, survey.shape, self._of_sample(), to_basis)
            return StreamProgress.begin(self._settings(), survey, begun)

        return self._kept(ranks, begin, checkpoint)

    def _ranged(
        self, ranks: Ranks, batches: Iterable[Any], progress: StreamProgress, checkpoint: str | os.PathLike[str] | None
    ) -> StreamProgress:
        """After the pass for the domain."""
        parts = ranks.gathered(lambda: range_pass(batches, progress.survey.shape, progress.point()))
        return self._kept(ranks, lambda: progress.after_range(parts), checkpoint)

    def _kept(
        self, ranks: Ranks, work: Callable[[], StreamProgress], checkpoint: str | os.PathLike[str] | None
    ) -> StreamProgress:
        """What rank 0 works out, once it is written where it is to be."""

        def written() -> StreamProgress:
            progress = work()
            if checkpoint is not None and progress.phase != "done":
                progress.save(checkpoint)
            return progress

        progress = ranks.from_first(written)
        # a state that goes on makes the last pass again, which tells whether the data are its own
        self._progress = self._progress if progress.phase == "done" else progress
        return progress

    def _light(self, problem: tuple[int, ...]) -> tuple[int, int]:  # noqa: ARG002
        return self.n_rows_ * self.d_.shape[0], self.n_light_

    def _name_columns(self, batches: object) -> None:
        """The names that a table on disk has for the columns of X."""
        self.__dict__.pop("feature_names_in_", None)
        names = getattr(batches, "column_names", None)
        if names is not None:
            self.feature_names_in_ = names


def _pass(batches: Iterable[Any], progress: StreamProgress) -> tuple[Callable[[], Float64[Tensor, " k"]], int]:
    """What the next pass is, and how many sums it gives."""
    assert progress.climb is not None
    shape, point, climb = progress.survey.shape, progress.point(), progress.climb
    if progress.phase == "report":
        return lambda: report_pass(batches, shape, point), Report.length(shape)
    if climb.rough:
        return lambda: float32_pass(batches, shape, point), StreamSums.length(shape)
    return lambda: slopes_pass(batches, shape, point, curvature=climb.curvature), StreamSums.length(shape)


def _after(progress: StreamProgress, flat: Float64[Tensor, " k"], max_passes: int) -> StreamProgress:
    """Where the fit stands after a pass."""
    if progress.phase == "report":
        return progress.after_report(Report.of(flat, progress.survey.shape).slopes, max_passes)
    return progress.after_slopes(StreamSums.of(flat, progress.survey.shape), max_passes)


def _likely(drawn: Drawn | None, size: int, rows: int) -> Drawn | None:
    """Those of a rank's sample that may be in the sample of all ranks: more are not worth sending."""
    if drawn is None or rows <= size:
        return drawn
    # beyond six standard deviations of how many keys are smaller, a sample is a little too small at worst
    limit = (size + 6.0 * math.sqrt(size)) / rows
    chosen = drawn.keys < limit
    return Drawn(drawn.keys[chosen], drawn.numbers[chosen], drawn.rows[chosen])

"""Interface of a test of evidence: its input, its result and its entry in the list of tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from torch import Tensor

from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, scored
from mkc_torch.diagnosis.goodness_of_fit import units_of
from mkc_torch.diagnosis.model.fit import FittedModel, within_domain, without_term
from mkc_torch.diagnosis.model.term import Driver, Term
from mkc_torch.diagnosis.parts import OutputSize
from mkc_torch.diagnosis.result import EvidenceResult, HeldOutScore, SmoothCorrection
from mkc_torch.diagnosis.search.estimate import FinalEstimate
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["EvidenceContext", "EvidenceResult", "EvidenceTest", "SmoothCorrection", "gain_of"]


@dataclass(frozen=True)
class EvidenceContext:
    """Input of a test; read only.

    Attributes:
        base: the simulation without findings.
        first: result of the first search, significant or not; None without candidates.
        found: the search results of the findings, in order.
        held_out: scores on held-out blocks of the simulation without findings, and with 1, 2, ... findings.
        blocks: the held-out blocks.
        drivers: the recorded columns.
        seed: of random draws; each test creates its own generator.
        settings: thresholds.
        number: of the finding, in a test of each finding.
        estimate: the final parameters; None in ``ahead`` functions.
        ahead: result of the test's ``ahead`` function.
        pairs: scores without and with each finding in the search, by which it was confirmed.
    """

    base: FittedModel
    first: SearchResult | None
    found: tuple[SearchResult, ...]
    held_out: tuple[Evidence, ...]
    blocks: HeldOutBlocks
    drivers: tuple[Driver, ...]
    seed: int
    settings: Settings
    number: int = 0
    estimate: FinalEstimate | None = None
    ahead: Any = None
    pairs: tuple[tuple[Evidence, Evidence], ...] = ()

    @property
    def prepared(self) -> PreparedSimulation:
        return self.base.model.prepared

    @property
    def of_states(self) -> bool:
        """Whether the simulation integrates states, so that it can diverge."""
        return (
            self.prepared.ports.get("output") is not None
            and self.prepared.ports["output"].clock is None
            and any(port.clock is not None for port in self.prepared.ports.values())
        )

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the channels."""
        return units_of(self.prepared)

    @property
    def final(self) -> FinalEstimate:
        """The final parameters; not available in ``ahead`` functions."""
        assert self.estimate is not None
        return self.estimate

    @property
    def fits(self) -> tuple[FittedModel, ...]:
        """The fits without findings, and with 1, 2, ... findings."""
        return self.base, *(located.fit for located in self.found)

    @property
    def fit(self) -> FittedModel:
        """The fit with all findings, as the search returned it."""
        return self.fits[-1]

    @property
    def located(self) -> SearchResult:
        """The search result of the finding."""
        return self.found[self.number]

    @property
    def term(self) -> Term:
        """The term of the finding in the final model."""
        return self.fit.model.terms[self.number]

    @property
    def overlaid(self) -> bool:
        """Whether the models with and without this finding both include later findings."""
        clock = self.prepared.ports[self.term.port].clock
        return self.number < len(self.found) - 1 and clock is None

    @property
    def without_and_with(self) -> tuple[FittedModel, FittedModel]:
        """The models without and with the finding; the first may only be a start for a fit."""
        if self.overlaid:
            return within_domain(without_term(self.fit, self.number)), self.fit
        return self.fits[self.number], self.located.fit

    @property
    def inliers(self) -> Bool[Tensor, "N m"]:
        """The inliers of both the final fit and the model on held-out blocks."""
        last, settings = self.held_out[-1], self.settings.evidence
        near = last.residual.abs() <= settings.inlier * last.d
        near = near if self.prepared.recorded is None else near & self.prepared.recorded
        return near & (self.final.fit.weights > settings.believed)

    def rms(self, model: Evidence) -> float:
        """Return the RMSE of a model on held-out blocks, over the inliers."""
        return float(model.residual[self.inliers].square().mean().sqrt())

    def spread(self, model: Evidence, outputs: Mapping[str, OutputSize] | None = None) -> HeldOutScore:
        """Return the score of a model on held-out blocks; ``outputs`` has the sizes of its residuals if known."""
        mean = float(model.log_likelihood.mean())
        density = tuple(model.sigma.tolist()), tuple(model.d.tolist())
        return HeldOutScore(mean, self.rms(model), *density, {} if outputs is None else outputs)


@dataclass(frozen=True)
class EvidenceTest:
    """An entry of :data:`mkc_torch.diagnosis.evidence.TESTS`.

    Attributes:
        test: the test.
        ahead: expensive part of the test that does not need the final parameters; computed in a separate process, in
            parallel with their estimate and the next search.
        each_finding: whether it tests each finding instead of the whole diagnosis.
    """

    test: Callable[[EvidenceContext], EvidenceResult]
    ahead: Callable[[EvidenceContext], Any] | None = None
    each_finding: bool = False


def gain_of(final: FinalEstimate, number: int) -> Float[Tensor, " N"]:
    """Return the gain of an effect at each sample, in nats, with all other parameters fixed."""
    fit = final.fit
    model, parameters = fit.model, fit.parameters.clone()
    start = model.base + sum(model.sizes[:number])
    with_it = scored(model.residual(parameters), fit.sigma, fit.d, fit.bound, fit.recorded)
    parameters[start : start + model.sizes[number]] = 0.0
    return (with_it - scored(model.residual(parameters), fit.sigma, fit.d, fit.bound, fit.recorded)).detach()

"""A test of evidence: what it may look at, what it says, and how it is listed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from torch import Tensor

from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, scored
from mkc_torch.diagnosis.goodness_of_fit import units_of
from mkc_torch.diagnosis.linearised.estimate import FinalEstimate
from mkc_torch.diagnosis.model.drivers import Driver
from mkc_torch.diagnosis.model.fit import FittedModel, without_term
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.result import EvidenceResult, HeldOutScore, Row, SmoothCorrection, Table
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["EvidenceContext", "EvidenceResult", "EvidenceTest", "Row", "SmoothCorrection", "Table", "gain_of"]


@dataclass(frozen=True)
class EvidenceContext:
    """What a test may look at. It changes nothing of it.

    Attributes:
        base: the simulation alone.
        first: what the first search located, whether it counts or not; None where there was nothing to search.
        found: the findings as their searches located them, in order.
        held_out: the simulation alone, and with one finding more each, on blocks that its fit has not seen.
        blocks: those blocks.
        drivers: the recorded columns.
        seed: of draws; a test begins with a generator of its own.
        settings: the numbers that decide.
        number: of the finding, for a test that is asked of each.
        estimate: the final parameters; None ahead of them.
        ahead: what the test's own ``ahead`` gave.
        pairs: without and with each finding under the same pushes, by which it was confirmed.
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
        """Whether a trajectory is simulated, which may be lost."""
        return (
            self.prepared.ports.get("output") is not None
            and self.prepared.ports["output"].clock is None
            and any(port.clock is not None for port in self.prepared.ports.values())
        )

    @property
    def units(self) -> tuple[str, ...]:
        """Of the channels."""
        return units_of(self.prepared)

    @property
    def final(self) -> FinalEstimate:
        """The final parameters, which a test has and what goes ahead of it has not."""
        assert self.estimate is not None
        return self.estimate

    @property
    def fits(self) -> tuple[FittedModel, ...]:
        """The simulation alone, and with one finding more each."""
        return self.base, *(located.fit for located in self.found)

    @property
    def fit(self) -> FittedModel:
        """The simulation with all findings, as the searches left it."""
        return self.fits[-1]

    @property
    def located(self) -> SearchResult:
        """The finding's search."""
        return self.found[self.number]

    @property
    def term(self) -> Term:
        """The finding in the final model."""
        return self.fit.model.terms[self.number]

    @property
    def overlaid(self) -> bool:
        """Whether findings came later that belong to the models with and without this one alike."""
        clock = self.prepared.ports[self.term.port].clock
        return self.number < len(self.found) - 1 and clock is None

    @property
    def without_and_with(self) -> tuple[FittedModel, FittedModel]:
        """The models that differ by the finding alone; of the one without it perhaps only where to start."""
        if self.overlaid:
            return without_term(self.fit, self.number), self.fit
        return self.fits[self.number], self.located.fit

    @property
    def inliers(self) -> Bool[Tensor, "N m"]:
        """The samples that both the final fit and the model on held-out blocks believe."""
        last, settings = self.held_out[-1], self.settings.evidence
        return (last.residual.abs() <= settings.inlier * last.d) & (self.final.fit.weights > settings.believed)

    def rms(self, model: Evidence) -> float:
        """Root mean square of a model's held-out residuals over the inliers."""
        return float(model.residual[self.inliers].square().mean().sqrt())

    def spread(self, model: Evidence) -> HeldOutScore:
        """A model on held-out blocks."""
        mean = float(model.log_likelihood.mean())
        return HeldOutScore(mean, self.rms(model), tuple(model.sigma.tolist()), tuple(model.d.tolist()))


@dataclass(frozen=True)
class EvidenceTest:
    """A test as it is listed in :data:`mkc_torch.diagnosis.evidence.TESTS`.

    Attributes:
        test: what it says of a case.
        ahead: for a test that takes long, what of it needs no final parameters: done beside their estimate and the next
            search, in a process of its own, from the fit with all findings.
        each_finding: whether it is asked of each finding, and not once of the whole diagnosis.
    """

    test: Callable[[EvidenceContext], EvidenceResult]
    ahead: Callable[[EvidenceContext], Any] | None = None
    each_finding: bool = False


def gain_of(final: FinalEstimate, number: int) -> Float[Tensor, " N"]:
    """What one effect gains at each sample, in nats, all else as it is."""
    fit = final.fit
    model, parameters = fit.model, fit.parameters.clone()
    start = model.base + sum(model.sizes[:number])
    with_it = scored(model.residual(parameters), fit.sigma, fit.d, fit.bound)
    parameters[start : start + model.sizes[number]] = 0.0
    return (with_it - scored(model.residual(parameters), fit.sigma, fit.d, fit.bound)).detach()

"""Scores of the findings, of suspected sets and of changed columns, next to a search."""

from __future__ import annotations

from dataclasses import replace

from mkc_torch.diagnosis.environment import GoodnessOfFit
from mkc_torch.diagnosis.goodness_of_fit import goodness_of_fit, poor_fits, size_of
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import ProcessNoiseFit
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.pipeline.suspected import suspected_models
from mkc_torch.diagnosis.pipeline.trail import trail_of
from mkc_torch.diagnosis.score import basis_of, score
from mkc_torch.diagnosis.search.beam import BeamSearch, Candidate
from mkc_torch.diagnosis.search.columns import best_change


def with_scores(
    search: StepwiseSearch, base: ProcessNoiseFit, terms: tuple[Term, ...], options: SearchOptions
) -> StepwiseSearch:
    """Return a search of differential equations with the scores of its models and of the suspected sets.

    Without findings if a column scores clearly higher with another sign or unit: no effect can be believed then.

    Args:
        search: the search at its end.
        base: the fit without effects.
        terms: candidates.
        options: of the diagnosis.

    Raises:
        NoFitError: the fit without effects has no finite trajectory.
    """
    settings = options.settings
    start = base.fit if base.free is None else base.free
    basis = basis_of(base.fit, len({term.key for term in terms}), options.declared, settings)
    beam = BeamSearch(terms, basis, settings, options.declared)
    for fit, move in [(start, ""), *((located.fit, "found") for located in search.found)]:
        fits = [fit] if fit.open_loop in (None, fit) else [fit, fit.open_loop]
        tried = [Candidate(known, score(known, basis, settings), move) for known in fits if known is not None]
        best = max(tried, key=lambda model: model.value)
        beam.models[best.key] = best
    suspected = suspected_models(options.suspect, beam, start, settings.noise, quick=options.quick)
    chosen = search.found[-1].fit if search.found else None
    search = replace(search, models=(*trail_of(beam, chosen), *suspected))
    column = wrong_column(beam, base, options)
    if not column:
        return search
    return replace(search, found=(), evidence=search.evidence[:1], pairs=(), left=(), column=column)


def wrong_column(beam: BeamSearch, base: ProcessNoiseFit, options: SearchOptions) -> str:
    """Return the column whose other sign or unit scores clearly higher than any effect, in a sentence; else empty."""
    if options.quick:
        return ""
    settings, fits = options.settings, [fit for fit in (base.free, base.fit) if fit is not None]
    poor = bool(poor_fits(_goodness(fits[0]), settings.evidence.followed))
    found = best_change(fits, beam.basis, settings, poor=poor)
    if found is None or poor_fits(_goodness(found.fit), settings.evidence.followed):
        return ""
    gain = (found.value - beam.best.value) / beam.basis.kappa
    if not gain > settings.naming.separable:
        return ""
    sizes = dict(zip(found.fit.model.prepared.channels, size_of(found.fit.residual).tolist(), strict=True))
    reached = ", ".join(f"{name} {size:.3g}" for name, size in sizes.items())
    return (
        f"With the {found.change.sentence} the simulation scores {gain:.0f} nats more than with any effect; the "
        f"open-loop residual is then {reached}."
    )


def _goodness(fit: FittedModel) -> tuple[GoodnessOfFit, ...]:
    return goodness_of_fit(fit.model.prepared, fit.residual, {}, None)

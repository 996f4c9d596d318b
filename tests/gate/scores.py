"""Three scores of the known and the returned sets of effects: `python -m tests.gate.scores --gate DIR`.

The likelihood less prices that was used before the score of `mkc_torch.diagnosis.score`; this score; and the same for
models without disturbances of rates, the free run under the sensor's noise. Prints a table and writes DIR/scores.json.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import refit_open_loop
from mkc_torch.simulation.dynamics.flow import flow_of
from mkc_torch.simulation.dynamics.horizons import log_likelihood_ahead
from mkc_torch.simulation.dynamics.noise_grid import NoiseGrid
from mkc_torch.simulation.dynamics.noise_model import NoiseModel
from tests.gate.fits import Case, ScoredFit, best_of, case_of, known_fits, returned_fit
from tests.gate.known_sets import KNOWN_SETS
from tests.gate.work import Job, add_options, diagnosed, gate_folder, known_jobs

RESULT = "scores.json"
SETS = ("alone", "known", "returned")
SCORES = ("priced", "multi_horizon", "free_run")

DISTURBANCE = 6.0
"""Price of a disturbance in nats."""


def numbers_of(fit: FittedModel) -> int:
    """Return the number of fitted numbers of the effects."""
    return sum(fit.model.sizes) + sum(len(term.effect.fitted_shape) for term in fit.model.terms)


def priced_likelihood(fit: FittedModel) -> float:
    """Return the log-likelihood less 6 nats a disturbance and half log N a number."""
    observer = fit.model.prepared.observer
    disturbances = 0 if observer is None else len(observer.disturbances)
    return fit.log_likelihood - DISTURBANCE * disturbances - 0.5 * math.log(len(fit.residual)) * numbers_of(fit)


def free_run(fit: FittedModel, case: Case) -> float | None:
    """Return the score with white noise and drift of the outputs only; None if the fit loses the recording."""
    free = refit_open_loop(fit)
    system = None if free is None else free.model.prepared.dynamics
    if free is None or system is None:
        return None
    model, basis = free.model, case.basis
    flow = flow_of(system, free.parameters[: model.base], model.changes(free.parameters), model.near)
    if flow is None or not np.isfinite(flow.new).all():
        return None
    flow = replace(flow, counts=basis.counts)
    sensor = [
        basis.declared.get(name, max(own, step, 1e-300))
        for name, own, step in zip(system.channels, size_of(free.residual).tolist(), basis.rounding, strict=True)
    ]
    known = tuple(name in basis.declared for name in system.channels)
    grid = NoiseGrid(flow, NoiseModel(tuple(sensor), (), known, basis.rounding))
    noises = [noise for noise in grid.singles() if all(place >= flow.rates for place, _, _ in noise.components)]
    values, _ = log_likelihood_ahead(flow, noises, basis.horizons, basis.span)
    # a drift has a size and a time constant
    drift = basis.kappa * case.settings.noise.disturbance_gain + 2 * basis.number
    prices = [drift * len(noise.components) for noise in noises]
    best = max(float(each.mean()) - price for each, price in zip(values, prices, strict=True))
    own = basis.number * numbers_of(free) + basis.kappa * basis.choice * len(model.terms)
    return best - own if math.isfinite(best) else None


def three_scores(fits: Sequence[FittedModel], best: ScoredFit, case: Case) -> dict[str, float | None]:
    """Return the scores of a set, each of its best fit.

    Args:
        fits: fits of the set.
        best: the one with the highest multi-horizon score.
        case: the recording.
    """
    priced = max(priced_likelihood(fit) for fit in [*fits, best.fit])
    free = [value for value in (free_run(fit, case) for fit in fits) if value is not None]
    found = {"priced": priced, "multi_horizon": best.value, "free_run": max(free, default=-math.inf)}
    return {name: value if math.isfinite(value) else None for name, value in found.items()}


def scored_sets(job: Job, gate: Path) -> dict[str, Any]:
    """Return the scores of the simulation alone, the known set and the returned set; null without a returned set."""
    case = case_of(job.recording, job.request)
    returned = returned_fit(gate_folder(gate, job.name) / "model.json", case)
    sets: dict[str, Sequence[FittedModel]] = {"alone": [case.alone, case.noisy]}
    sets["known"] = known_fits(KNOWN_SETS[job.name], case, returned)
    if returned is not None:
        sets["returned"] = [returned]
    rows: dict[str, Any] = {name: three_scores(fits, best_of(fits, case), case) for name, fits in sets.items()}
    return {"returned": None, **rows, "samples": case.basis.samples}


def write_scores(job: Job, folder: Path) -> None:
    """Score in this process, and write ``row.json`` into a folder of DIR/scores."""
    row = scored_sets(job, folder.parent.parent)
    (folder / "row.json").write_text(json.dumps(row, allow_nan=False), encoding="utf-8")


def table(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the lines of a table: the scores less those of the simulation alone, of the known and the returned set.

    Example:
        >>> own = {"priced": 1.0, "multi_horizon": 2.0, "free_run": None}
        >>> known = {"priced": 11.0, "multi_horizon": 2.5, "free_run": 8.0}
        >>> table({"a": {"alone": own, "known": known, "returned": None}})[-1].split()
        ['a', '10.0', '-', '0.5', '-', '-', '-']
    """
    heads = [f"{score} {name}" for score in SCORES for name in SETS[1:]]
    lines = [f"{'recording':38}" + "".join(f"{head:>24}" for head in heads)]
    for name, row in rows.items():
        if row.get("failed"):
            lines.append(f"{name:38}  failed: {row['failed']}")
            continue
        cells = [_gain(row, kind, score) for score in SCORES for kind in SETS[1:]]
        lines.append(f"{name:38}" + "".join(f"{cell:>24}" for cell in cells))
    return lines


def _gain(row: Mapping[str, Any], kind: str, score: str) -> str:
    value, alone = ((row.get(name) or {}).get(score) for name in (kind, "alone"))
    return "-" if value is None or alone is None else f"{value - alone:.1f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Score the recordings of a gate. Returns 0."""
    options = add_options(argparse.ArgumentParser(description=__doc__)).parse_args(arguments)
    jobs = known_jobs(options.only, options.match, KNOWN_SETS)
    found = diagnosed(jobs, options.gate / "scores", workers=options.workers, limit_s=options.limit, task=write_scores)
    rows = dict(found)
    rows = {job.name: rows[job.name] for job in jobs}
    (options.gate / RESULT).write_text(json.dumps(rows, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    print("\n".join(table(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

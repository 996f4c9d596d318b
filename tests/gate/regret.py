"""Regret of the search: `python -m tests.gate.regret --gate DIR`.

The score of the known set of effects less that of the returned set, at the same price and on the same basis. The known
set is fitted from the shapes of a fit by hand, from the shapes of the grid, and from the returned fit; none of these
fits is known to the search. The returned set is that of `model.json` in the gate's folder. Recordings without a known
set are left out. Prints a table and writes DIR/regret.json.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mkc_torch.diagnosis.model.process_noise import refit_open_loop
from mkc_torch.diagnosis.model.suspect import suspect_id
from tests.gate.fits import Case, ScoredFit, best_of, case_of, known_fits, returned_fit
from tests.gate.known_sets import KNOWN_SETS
from tests.gate.work import Job, add_options, diagnosed, gate_folder, known_jobs

RESULT = "regret.json"

SMALL = 0.5
"""Regret in nats up to which the search has found the best set."""

LARGE = 4.5
"""Regret in nats that no recording may exceed; as far below 0 another set scores better than the known one."""


def regret_of(job: Job, gate: Path) -> dict[str, Any]:
    """Return the regret of a recording of the gate, with both sets."""
    case = case_of(job.recording, job.request)
    fit = returned_fit(gate_folder(gate, job.name) / "model.json", case)
    alone = best_of([case.alone, case.noisy], case)
    returned = alone if fit is None else best_of([fit], case)
    known = best_of(known_fits(KNOWN_SETS[job.name], case, fit), case)
    regret = known.value - returned.value
    return {
        "alone": _finite(alone.value),
        "known": _finite(known.value),
        "returned": _finite(returned.value),
        "regret": _finite(regret),
        "open_loop": {"known": _open_loop(known), "returned": _open_loop(returned)},
        "kappa": case.basis.kappa,
        "effects": {"known": _effects(known, case), "returned": _effects(returned, case)},
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _open_loop(scored: ScoredFit) -> dict[str, float]:
    """Return the RMS of the open-loop residual, by output."""
    free = refit_open_loop(scored.fit)
    if free is None:
        return {}
    return dict(zip(free.model.prepared.channels, free.residual.square().mean(0).sqrt().tolist(), strict=True))


def _effects(scored: ScoredFit, case: Case) -> list[str]:
    return [suspect_id(term, case.terms) for term in scored.fit.model.terms]


def write_regret(job: Job, folder: Path) -> None:
    """Compute the regret in this process, and write ``row.json`` into a folder of DIR/regret."""
    row = regret_of(job, folder.parent.parent)
    (folder / "row.json").write_text(json.dumps(row, allow_nan=False), encoding="utf-8")


def regrets(gate: Path, jobs: Sequence[Job], workers: int, limit_s: float) -> dict[str, dict[str, Any]]:
    """Return the rows of recordings with known sets, by name, and write them into the gate's folder."""
    found = dict(diagnosed(jobs, gate / "regret", workers=workers, limit_s=limit_s, task=write_regret))
    rows = {job.name: found[job.name] for job in jobs}
    (gate / RESULT).write_text(json.dumps(rows, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return rows


def table(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the lines of a table; scores are less that of the simulation alone.

    Example:
        >>> effects = {"known": ["drag@speed"], "returned": []}
        >>> row = {"alone": 1.0, "known": 9.0, "returned": 1.0, "regret": 8.0, "kappa": 1.5}
        >>> row |= {"open_loop": {"known": {"x": 0.1}, "returned": {"x": 0.2}}, "effects": effects}
        >>> table({"a": row})[-1].split()
        ['a', '1.0', '8.0', '0.0', '8.0', '0.1', '0.2', '1.5', 'drag@speed', '|', 'nothing']
    """
    heads = ("alone", "known", "returned", "regret", "RMS known", "RMS returned", "kappa")
    lines = [f"{'recording':38}" + "".join(f"{head:>14}" for head in heads) + "  known | returned"]
    for name, row in rows.items():
        if row.get("failed"):
            lines.append(f"{name:38}  failed: {row['failed']}")
            continue
        gains = [_less(row[kind], row["alone"]) for kind in ("known", "returned")]
        left = [" ".join(f"{size:.3g}" for size in row["open_loop"][kind].values()) for kind in ("known", "returned")]
        cells = [_less(row["alone"], 0.0), *gains, _less(row["regret"], 0.0), *left, f"{row['kappa']:.1f}"]
        sets = " | ".join(" + ".join(row["effects"][kind]) or "nothing" for kind in ("known", "returned"))
        lines.append(f"{name:38}" + "".join(f"{cell or '-':>14}" for cell in cells) + f"  {sets}")
    return lines


def _less(value: float | None, other: float | None) -> str:
    return "-" if value is None or other is None else f"{value - other:.1f}"


def count_line(rows: Mapping[str, float | None]) -> str:
    """Return how often the regret is small, and where it is large, from regrets by name; None is unknown.

    Example:
        >>> count_line({"a": 0.1, "b": 12.34, "c": -9.0, "d": None})
        'regret: at most 0.5 nats in 2 of 3, above 4.5: b (12.3); another set scores 4.5 better in: c (9.0); unknown: d'
    """
    known = {name: regret for name, regret in rows.items() if regret is not None}
    small = sum(regret <= SMALL for regret in known.values())
    large = [f"{name} ({regret:.1f})" for name, regret in known.items() if regret > LARGE]
    better = [f"{name} ({-regret:.1f})" for name, regret in known.items() if regret < -LARGE]
    unknown = [name for name, regret in rows.items() if regret is None]
    line = f"regret: at most {SMALL:g} nats in {small} of {len(known)}, above {LARGE:g}: {_listed(large)}; "
    line += f"another set scores {LARGE:g} better in: {_listed(better)}"
    return f"{line}; unknown: {_listed(unknown)}" if unknown else line


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute the regrets of a gate. Returns 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options = add_options(parser).parse_args(arguments)
    jobs = known_jobs(options.only, options.match, KNOWN_SETS)
    rows = regrets(options.gate, jobs, options.workers, options.limit)
    print("\n".join([*table(rows), count_line({name: row.get("regret") for name, row in rows.items()})]))
    return 0


if __name__ == "__main__":
    sys.exit(main())

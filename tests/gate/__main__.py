"""The gate for changes of the verdict: `python -m tests.gate --output DIR [--compare STORED.json]`.

Diagnoses the real recordings, cases and strangers' recordings next to the repository, a few recordings of each
scenario, and small draws of both proofs. The draws are the same in every run. Writes `DIR/gate.json`: for each
recording the verdict, findings, residuals, CPU and wall seconds, and whether it is right. Prints the counts and the
recordings that are not right; with `--compare`, also the differences from a stored `gate.json`.

    python -m tests.gate --output before                                # on the tree before the change
    python -m tests.gate --output after --compare before/gate.json      # and after it
    python -m tests.gate --output quick --only real cases --match rocket

Each recording is diagnosed in its own process with a time limit (`--limit`, wall seconds). Its CPU seconds are those of
`mkc diagnose` without the start of Python and without the report. Recordings outside the repository are left out if
their files are absent; the file names are printed. Rows are written during the run: `--resume` continues an
interrupted run. `--regret` adds the regret of the search to the rows of recordings whose effects are known, see
`tests.gate.regret`.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from examples.concealed_physics import known
from examples.concealed_physics.judge import judged
from tests.gate import drawn, regret
from tests.gate.compare import differences
from tests.gate.known_sets import KNOWN_SETS
from tests.gate.tables import compared_lines, count_lines, wrong_lines
from tests.gate.work import KNOWN, Job, diagnosed, known_answers, known_jobs

PARTS = ("real", "cases", "strangers", "scenarios", "proofs")
RESULT = "gate.json"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the gate. Returns 1 if a recording that was right in the compared run is wrong now, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="folder for the recordings, diagnoses and gate.json")
    parser.add_argument("--compare", type=Path, help="gate.json of another run")
    parser.add_argument("--workers", type=int, default=2, help="parallel processes")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts of the gate to run")
    parser.add_argument("--match", default="", help="only recordings whose name contains this text")
    parser.add_argument("--limit", type=float, default=600.0, help="time limit of a recording in wall seconds")
    parser.add_argument("--regret", action="store_true", help="also compare the score of the known set of effects")
    parser.add_argument("--resume", action="store_true", help="keep the rows that --output already has")
    options = parser.parse_args(arguments)
    stored = json.loads(options.compare.read_text(encoding="utf-8")) if options.compare else None
    started = time.perf_counter()
    result = run(options.output, options.only, options.match, options.workers, options.limit, resume=options.resume)
    regrets = _add_regret(result["recordings"], options) if options.regret else []
    result["wall_seconds"] = round(time.perf_counter() - started, 1)
    _write(options.output, result)
    lines = [*count_lines(result), *regrets, *wrong_lines(result["recordings"])]
    if stored is None:
        print("\n".join(lines))
        return 0
    differing = differences(stored["recordings"], result["recordings"])
    print("\n".join([*lines, *compared_lines(stored, result, differing)]))
    return int(any("right True -> False" in changes for changes in differing.values()))


def _add_regret(rows: dict[str, dict[str, Any]], options: argparse.Namespace) -> list[str]:
    """Add the key "regret" to the rows with known sets of effects, and return the line of its counts."""
    jobs = [job for job in known_jobs(options.only, options.match, KNOWN_SETS) if job.name in rows]
    found = {
        name: row.get("regret")
        for name, row in regret.regrets(options.output, jobs, options.workers, options.limit).items()
    }
    for name, value in found.items():
        rows[name]["regret"] = value
    return [regret.count_line(found)]


def run(
    output: Path, parts: Sequence[str], match: str, workers: int, limit_s: float, *, resume: bool
) -> dict[str, Any]:
    """Return ``recordings``, name to row, and ``counts``, part to its counts."""
    answers = {answer.name: answer for answer in known_answers(parts) if match in answer.name}
    jobs = [Job(answer.name, answer.recording, answer.request) for answer in answers.values()]
    draws: dict[str, list[drawn.Drawn]] = {}
    if "scenarios" in parts:
        draws["scenarios"] = list(drawn.all_scenarios(output, match=match, workers=workers))
    if "proofs" in parts:
        draws["proofs"] = list(drawn.all_proofs(output, match=match, workers=workers))
    jobs += [job for group in draws.values() for draw in group for job in draw.jobs]
    rows: dict[str, dict[str, Any]] = {}
    if resume and (output / RESULT).is_file():
        there = json.loads((output / RESULT).read_text(encoding="utf-8"))["recordings"]
        rows = {job.name: _judged(job.name, there[job.name], answers) for job in jobs if job.name in there}
    left = [job for job in jobs if job.name not in rows]
    for done, (name, row) in enumerate(diagnosed(left, output, workers=workers, limit_s=limit_s), start=1):
        rows[name] = _judged(name, row, answers)
        print(f"{done}/{len(left)} {name}: {row['verdict'] or row['failed']}, {row['cpu_seconds']} s", file=sys.stderr)
        _write(output, {"recordings": rows})
    counts: dict[str, dict[str, str]] = {
        part: {"right": _right([row for name, row in rows.items() if name.startswith(f"{part} ")])}
        for part in KNOWN
        if part in parts
    }
    for group in draws.values():
        for draw in group:
            own = {job.name: rows[job.name] for job in draw.jobs if job.name in rows}
            if own:
                first = next(iter(own))
                counts[" ".join(first.split()[:2])] = draw.counts(own)
            for name, outcome in draw.outcomes(own).items():
                if name in rows:
                    rows[name] |= {"truth": draw.truths[name]} | outcome
    return {"counts": counts, "recordings": {job.name: rows[job.name] for job in jobs if job.name in rows}}


def _judged(name: str, row: dict[str, Any], answers: Mapping[str, known.Known]) -> dict[str, Any]:
    return row | judged(row, answers[name].expected) if name in answers else row


def _right(rows: Sequence[dict[str, Any]]) -> str:
    return f"{sum(row['right'] for row in rows)}/{len(rows)}"


def _write(output: Path, result: dict[str, Any]) -> None:
    output.mkdir(parents=True, exist_ok=True)
    (output / RESULT).write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())

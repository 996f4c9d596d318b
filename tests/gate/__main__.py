"""The gate for changes of the verdict: `python -m tests.gate --output DIR [--compare STORED.json]`.

Diagnoses the real recordings and cases next to the repository, a few recordings of each scenario, and small draws of
both proofs, always the same, and writes `DIR/gate.json`: for each recording verdict, findings, residuals, CPU
and wall seconds, and whether it is right. Prints the counts and the recordings that are not right; with `--compare`,
also each recording in which a stored `gate.json` and this one differ.

    python -m tests.gate --output before                                # on the tree before the change
    python -m tests.gate --output after --compare before/gate.json      # and after it
    python -m tests.gate --output quick --only real cases --match rocket

Each recording has a process and a time limit (`--limit`, wall seconds). Its CPU seconds are those of `mkc diagnose`
without the start of Python and without the report. Recordings that lie outside the repository are left out, with
the file's name, where they are absent. Rows are kept while it runs: `--resume` goes on where an interrupted run ended.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from examples.concealed_physics import known
from examples.concealed_physics.judge import judged
from tests.gate import drawn
from tests.gate.compare import differences
from tests.gate.tables import compared_lines, count_lines, wrong_lines
from tests.gate.work import Job, diagnosed

PARTS = ("real", "cases", "scenarios", "proofs")
RESULT = "gate.json"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the gate; 0 unless a comparison found a recording that was right and is not any more."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="folder for the recordings, diagnoses and gate.json")
    parser.add_argument("--compare", type=Path, help="gate.json of another run")
    parser.add_argument("--workers", type=int, default=2, help="processes at once")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts of it")
    parser.add_argument("--match", default="", help="recordings whose name has this text in it")
    parser.add_argument("--limit", type=float, default=600.0, help="wall seconds for a recording")
    parser.add_argument("--resume", action="store_true", help="keep the rows that are in --output already")
    asked = parser.parse_args(arguments)
    stored = json.loads(asked.compare.read_text(encoding="utf-8")) if asked.compare else None
    started = time.perf_counter()
    result = run(asked.output, asked.only, asked.match, asked.workers, asked.limit, resume=asked.resume)
    result["wall_seconds"] = round(time.perf_counter() - started, 1)
    _write(asked.output, result)
    lines = [*count_lines(result), *wrong_lines(result["recordings"])]
    if stored is None:
        print("\n".join(lines))
        return 0
    differing = differences(stored["recordings"], result["recordings"])
    print("\n".join([*lines, *compared_lines(stored, result, differing)]))
    return int(any("right True -> False" in told for told in differing.values()))


def run(
    output: Path, parts: Sequence[str], match: str, workers: int, limit_s: float, *, resume: bool
) -> dict[str, Any]:
    """The gate's result: ``recordings``, name to row, and ``counts``, part to what is counted in it."""
    answers = {one.name: one for one in _known(parts) if match in one.name}
    jobs = [Job(one.name, one.recording, one.request) for one in answers.values()]
    draws: dict[str, list[drawn.Drawn]] = {}
    if "scenarios" in parts:
        draws["scenarios"] = list(drawn.all_scenarios(output, match=match, workers=workers))
    if "proofs" in parts:
        draws["proofs"] = list(drawn.both_proofs(output, match=match, workers=workers))
    jobs += [job for group in draws.values() for one in group for job in one.jobs]
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
        for part in ("real", "cases")
        if part in parts
    }
    for group in draws.values():
        for one in group:
            own = {job.name: rows[job.name] for job in one.jobs if job.name in rows}
            if own:
                first = next(iter(own))
                counts[" ".join(first.split()[:2])] = one.counts(own)
            for name, outcome in one.outcomes(own).items():
                if name in rows:
                    rows[name] |= {"truth": one.truths[name]} | outcome
    return {"counts": counts, "recordings": {job.name: rows[job.name] for job in jobs if job.name in rows}}


def _known(parts: Sequence[str]) -> Iterator[known.Known]:
    for part, recordings in (("real", known.real), ("cases", known.cases)):
        for one in recordings() if part in parts else ():
            absent = [str(file) for file in (one.recording, one.file) if not file.exists()]
            if absent:
                print(f"left out: {', '.join(absent)} is absent")
            else:
                yield one


def _judged(name: str, row: dict[str, Any], answers: Mapping[str, known.Known]) -> dict[str, Any]:
    return row | judged(row, answers[name].expected) if name in answers else row


def _right(rows: Sequence[dict[str, Any]]) -> str:
    return f"{sum(row['right'] for row in rows)}/{len(rows)}"


def _write(output: Path, result: dict[str, Any]) -> None:
    output.mkdir(parents=True, exist_ok=True)
    (output / RESULT).write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())

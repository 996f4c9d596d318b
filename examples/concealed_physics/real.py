"""Diagnoses of all recordings with known missing physics, in a table with fits by hand.

The recordings, real and simulated, are next to the project's folder; absent recordings are named and left out.
Columns:

    claimed    effects that are claimed, and whether the whole answer is right
    located    share of the first finding's gain, share of the time in which it arises, and where; whether the place is
               right, where that is known
    size       parameters of the missing physics with standard error, and the fit by hand
    bias       the simulation's own parameters, minus those by hand
    open loop  RMS residual of the open-loop simulation, before and after
    bound      RMS residual of the fit by hand
    CPU        seconds of the diagnosis

A search that reaches `--limit` is stopped; its row has the results so far and is marked. The folder `dynamics` shows
predictions of unseen runs by the balls, the heaters, the Silverbox and the servo of `shared/data`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from examples.blind_proof.statements import CLAIMS
from examples.concealed_physics.by_hand import BY_HAND, ByHand
from examples.concealed_physics.judge import judged
from examples.concealed_physics.known import SHARED, Known, cases, data, real

COLUMNS = ("recording", "left out", "claimed", "located", "size", "bias", "open loop", "bound", "CPU, s")


NOTHING: Mapping[str, Any] = {
    "verdict": "",
    "findings": [],
    "residual_before": {},
    "residual_after": {},
    "parameters": {},
    "sentences": [],
    "cpu_seconds": None,
}
"""The row of a diagnosis that failed."""


def recordings(shared: Path, only: str) -> Iterator[Known]:
    """Return the known recordings with a text in their name; absent files are printed."""
    for known in (*real(shared), *cases(shared), *data(shared)):
        if only not in known.name:
            continue
        absent = [str(file) for file in (known.recording, known.file) if not file.exists()]
        if absent:
            print(f"left out: {', '.join(dict.fromkeys(absent))} is absent", file=sys.stderr)
        else:
            yield known


def diagnosed(task: tuple[Known, Path, float]) -> tuple[str, dict[str, Any]]:
    """Return name and row of a recording, diagnosed in this process; an existing row is kept."""
    known, output, limit_s = task
    folder = output / re.sub(r"\W", "_", known.name)
    file = folder / "row.json"
    if not file.is_file():
        from examples.concealed_physics.row import write_row

        folder.mkdir(parents=True, exist_ok=True)
        try:
            write_row(known.file_in(folder), replace(known.request, time_limit=limit_s), folder)
        except Exception as error:  # a failed recording costs its row, not the table
            return known.name, {**NOTHING, "failed": f"{type(error).__name__}: {error}"}
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return known.name, found


def line(known: Known, row: Mapping[str, Any], hand: ByHand) -> list[str]:
    """Return the row of a recording in the table."""
    right = judged(row, known.expected)["right"]
    claimed = [found for found in row["findings"] if found["grade"] in CLAIMS]
    names = ", ".join(found["effect"].replace("_", " ") for found in claimed) or row["verdict"] or "no answer"
    return [
        known.name,
        hand.left_out,
        f"{names} ({'right' if right else 'wrong'}){stopped(row)}",
        located(claimed, hand),
        sizes(row, hand),
        "; ".join(bias(row["parameters"], hand)) or "-",
        "; ".join(open_loop(row)) or "-",
        "; ".join(f"{output} {value:.3g}" for output, value in hand.residual.items()) or "-",
        "-" if row["cpu_seconds"] is None else f"{row['cpu_seconds']:.0f}",
    ]


def stopped(row: Mapping[str, Any]) -> str:
    """Return a note if the search was stopped, with its time."""
    stop = row.get("stopped")
    return f", search stopped after {stop['seconds']:.0f} s" if stop else ""


def located(claimed: Sequence[Mapping[str, Any]], hand: ByHand) -> str:
    """Return the region in which the gain of the first finding arises."""
    region = next((found["region"] for found in claimed if found.get("region")), None)
    if region is None:
        return "-"
    right = (region["state"], region["kind"]) in hand.where
    judgement = f" ({'right' if right else 'wrong'})" if hand.where else ""
    shares = f"{region['share_of_gain']:.0%} in {region['share_of_time']:.0%}"
    return f"{shares}: {region['state']} {region['kind']} {region['bound']:.3g}{judgement}"


def sizes(row: Mapping[str, Any], hand: ByHand) -> str:
    """Return sizes with standard errors, and those by hand."""
    parts = []
    for (effect, name), value in hand.sizes.items():
        found = [p for entry in row["findings"] if entry["effect"] == effect for p in entry["parameters"]]
        parameter = next((p for p in found if p["name"] == name), None)
        error = None if parameter is None else parameter["standard_error"]
        size = "-" if parameter is None else f"{parameter['value']:.3g}" + ("" if error is None else f" ± {error:.2g}")
        parts.append(f"{name} {size}, by hand {value:.3g}")
    return "; ".join(parts) or "-"


def bias(parameters: Mapping[str, float], hand: ByHand) -> Iterator[str]:
    """Return relative differences of the simulation's parameters from those by hand."""
    for name, value in hand.parameters.items():
        if name in parameters:
            yield f"{name} {(parameters[name] - value) / value:+.1%}"


def open_loop(row: Mapping[str, Any]) -> Iterator[str]:
    """Return open-loop residuals by output, before and, where an effect is claimed, after."""
    claims = any(found["grade"] in CLAIMS for found in row["findings"])
    for output, before in row["residual_before"].items():
        after = row["residual_after"].get(output) if claims else None
        numbers = [f"{value:.3g}" for value in (before, after) if value is not None]
        yield f"{output} {' → '.join(numbers)}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=SHARED, help="folder with real, cases and data")
    parser.add_argument("--only", default="", help="only recordings with this text in their name")
    parser.add_argument("--output", type=Path, default=Path("known"), help="folder; existing rows are kept")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds after which each search is stopped")
    options = parser.parse_args(arguments)
    os.environ["OMP_NUM_THREADS"] = "1"  # of the processes that begin below
    chosen = {known.name: known for known in recordings(options.data, options.only)}
    tasks = [(known, options.output, options.limit) for known in chosen.values()]
    rows: dict[str, dict[str, Any]] = {}
    with multiprocessing.get_context("spawn").Pool(2, maxtasksperchild=1) as pool:
        for name, row in pool.imap_unordered(diagnosed, tasks):
            rows[name] = row
            print(f"{len(rows)}/{len(tasks)} {name}: {row['verdict']}, {row['cpu_seconds']} s", file=sys.stderr)
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * (len(COLUMNS) - 1)}---:|")
    for name, known in chosen.items():
        print(f"| {' | '.join(line(known, rows[name], BY_HAND.get(name, ByHand())))} |")
    wrong = {name: judged(rows[name], known.expected)["wrong"] for name, known in chosen.items()}
    seconds = sum(row["cpu_seconds"] or 0.0 for row in rows.values())
    print(f"\n{sum(not faults for faults in wrong.values())} of {len(rows)} right, {seconds:.0f} CPU seconds")
    for name, faults in wrong.items():
        if faults:
            print(f"  not right: {name}: {'; '.join(faults)}")


if __name__ == "__main__":
    main()

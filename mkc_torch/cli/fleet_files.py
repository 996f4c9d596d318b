"""The page of several recordings that were diagnosed or calibrated one by one, and which of them were done before."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.cli.console import FAILURES, complain
from mkc_torch.cli.diagnosis_request import Request

if TYPE_CHECKING:
    from mkc_torch.calibration import Calibration
    from mkc_torch.report.fleet import Fleet

SCHEMA = "mkc-fleet/1"

_FILE = "diagnosis.json"

WRITTEN = ("fleet.html", "fleet.csv", "fleet.json")
"""Files in the folder of the results."""


class Earlier(NamedTuple):
    """What an earlier call with the same options has left of some recordings: complete and interrupted results."""

    complete: list[Path]
    interrupted: list[Path]


def earlier_results(paths: Sequence[Path], output: Path, request: Request, simulation: str) -> Earlier:
    """Return the recordings whose results are complete, and those whose search was interrupted or reached a time limit.

    Args:
        paths: the recordings.
        output: folder of the results.
        request: options of this call; with ``force`` no result counts.
        simulation: its name.
    """
    found = Earlier([], [])
    for path in [] if request.force else paths:
        contents = list(_contents(output / path.stem).values())
        if contents and all(_has_options(each, request, simulation) for each in contents):
            ended = all(each["search"]["stopped"] is None for each in contents)
            (found.complete if ended else found.interrupted).append(path)
    return found


def _has_options(content: Mapping[str, Any], request: Request, simulation: str) -> bool:
    search = content["search"]
    found = (content["simulation"], content["level"], search["seed"], search["quick"])
    return found == (simulation, request.level, request.seed, request.quick)


def claim_page(output: Path) -> None:
    """Exit with one message if the page would replace a user's own file."""
    if not output.exists():
        return
    try:
        claim_folder(output, overwrite=True, files=WRITTEN)
    except FAILURES as error:
        complain(output, error)
        raise typer.Exit(1) from None


def is_doubtful(folder: Path) -> bool:
    """Whether a result of an earlier call must be looked at before it is used."""
    return any(content.get("answer") != "usable" for content in _contents(folder).values())


def write_diagnoses(paths: Sequence[Path], output: Path, failures: Mapping[str, str]) -> list[Path]:
    """Write the page, the table and the numbers of all recordings that have a diagnosis. Returns the files.

    Args:
        paths: the recordings, each with a folder of its name in ``output``.
        output: folder of the results.
        failures: reasons by the names of recordings that were not diagnosed.
    """
    from mkc_torch.report.fleet import fleet_of

    found: dict[str, Mapping[str, Any]] = {}
    for path in paths:
        for place, content in _contents(output / path.stem).items():
            found[place.relative_to(output).as_posix()] = content
    return _write(fleet_of(found, failures), output)


def write_calibrations(
    calibrations: Mapping[Path, Calibration], output: Path, failures: Mapping[str, str]
) -> list[Path]:
    """Write the same of all recordings that have a calibration; the keys are their folders."""
    from mkc_torch.report.fleet import fleet_of_calibrations

    found = {place.relative_to(output).as_posix(): calibration for place, calibration in calibrations.items()}
    return _write(fleet_of_calibrations(found, failures), output)


def _write(fleet: Fleet, output: Path) -> list[Path]:
    from mkc_torch.report.fleet import fleet_report

    content = {"schema": SCHEMA, **_finite(asdict(fleet))}
    texts = (fleet_report(fleet), _table(fleet), json.dumps(content, ensure_ascii=False, indent=2) + "\n")
    for name, text in zip(WRITTEN, texts, strict=True):
        write_atomically(output / name, text, overwrite=True)
    return [output / name for name in WRITTEN]


def _contents(folder: Path) -> dict[Path, Mapping[str, Any]]:
    """Content of each diagnosis.json in a recording's folder, or in the folders of its runs or joints."""
    places = [folder, *(sorted(each for each in folder.iterdir() if each.is_dir()) if folder.is_dir() else [])]
    return {
        place: json.loads((place / _FILE).read_text(encoding="utf-8")) for place in places if (place / _FILE).is_file()
    }


def _table(fleet: Fleet) -> str:
    """A row for each size of each recording; a recording without sizes has a row without effect."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    columns = ("recording", "result", "answer", "effect", "place", "grade", "parameter", "value", "standard_error")
    table.writerow([*columns, "unit"])
    for number, each in enumerate(fleet.recordings):
        first = (each.name, each.verdict, each.answer)
        own = [(q, size) for q in fleet.quantities for size in q.sizes if size.recording == number]
        for q, size in own:
            error = size.error if math.isfinite(size.error) else ""
            table.writerow([*first, q.effect, q.place, size.grade, q.parameter, size.value, error, q.unit])
        if not own:
            table.writerow([*first, *[""] * 7])
    return text.getvalue()


def _finite(content: Any) -> Any:
    """Replace numbers that JSON does not have by None."""
    if isinstance(content, Mapping):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content

"""Diagnose and correct recordings of a proof as ``mkc diagnose`` and ``mkc apply`` do."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from examples.blind_proof.equations.simulations import class_of
from examples.blind_proof.run import SIMULATIONS
from mkc_torch.cli.console import ConsoleStyle
from mkc_torch.cli.diagnosis_files import diagnose_file, named_simulation
from mkc_torch.cli.diagnosis_request import MAGNETOMETER, Request
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.protocol import Simulation

_QUIET = ConsoleStyle(terminal=False, width=100)


def diagnose(paths: list[Path], folder: Path) -> None:
    """Diagnose recordings, each with the simulation file written for it if there is one, without reports."""
    for path in paths:
        diagnose_with(request_for(path, path.parent.parent / SIMULATIONS / f"{path.stem}.py"), path, folder)


def diagnose_with(request: Request, path: Path, folder: Path) -> None:
    """Diagnose a recording; a failure writes a text file with its message."""
    place = folder / path.stem
    for old in ("diagnosis.json", "model.json"):  # an old result would be scored if the diagnosis failed
        (place / old).unlink(missing_ok=True)
    for outcome in diagnose_file(path, place, request, _QUIET):
        if outcome.failed:
            (folder / f"{path.stem}.error.txt").write_text(f"{outcome.text}\n", encoding="utf-8")


def apply(model: Path, path: Path) -> Mapping[str, Tensor]:
    """Correct a second recording."""
    simulation = request_for(path, path.parent.parent / SIMULATIONS / f"{path.stem}.py").simulation
    chosen = None if simulation == MAGNETOMETER else named_simulation(simulation)
    return corrected_columns(model, chosen, Recording.read(path))


def corrected_columns(model: Path, simulation: Simulation | None, recording: Recording) -> Mapping[str, Tensor]:
    """Return the columns that a model.json corrects, by the names of a recording."""
    known = DiagnosedModel.from_json(model.read_text(encoding="utf-8"), simulation=simulation)
    return known.correct(recording)[0]


def request_for(recording: Path, simulation: Path) -> Request:
    """Return the request of a user with this simulation file, or with a magnetometer if there is no such file.

    A model of MuJoCo has the same name with the suffix ``.xml``.
    """
    model = simulation.with_suffix(".xml")
    if model.is_file():
        return Request(simulation=str(model), force=True, report=False)
    named = f"{simulation}:{simulation_name(recording)}" if simulation.is_file() else MAGNETOMETER
    return Request(simulation=named, force=True, report=False)


def simulation_name(recording: Path) -> str:
    """Return the name of the simulation in its file, by the name of the recording.

    Example:
        >>> simulation_name(Path("cart_pole_00012.csv")), simulation_name(Path("case_00003.csv"))
        ('CartPole', 'sensor')
    """
    system = recording.stem.rpartition("_")[0]
    return "sensor" if system == "case" else class_of(system)

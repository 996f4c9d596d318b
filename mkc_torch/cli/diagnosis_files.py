"""Diagnose a file and write the results, for `mkc diagnose`."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mkc_torch._parallel.deadline import stopped_by_interrupt
from mkc_torch._support.files import claim_folder, write_atomically
from mkc_torch.cli.console import (
    FAILURES,
    ConsoleStyle,
    folder_names,
    folder_written,
    remove_if_empty,
    sentence_of,
)
from mkc_torch.cli.diagnosis_request import MAGNETOMETER, Outcome, Request, is_file_of_a_simulation
from mkc_torch.cli.diagnosis_summary import show
from mkc_torch.cli.recorded import read_magnetometer, read_table, refuse_no_magnetometer
from mkc_torch.cli.simulation_option import ALL, EACH
from mkc_torch.cli.steps import Steps
from mkc_torch.diagnosis import Diagnosis, diagnose
from mkc_torch.diagnosis.io.python_source import SourceError
from mkc_torch.diagnosis.optional import failure
from mkc_torch.diagnosis.verdict import conclusion
from mkc_torch.recording.column_names import split_unit
from mkc_torch.recording.join_recordings import joint_name
from mkc_torch.recording.recording import Recording, RecordingError
from mkc_torch.report.diagnosis.verdict import RunPaths
from mkc_torch.simulation.load import load_simulation, raised_in
from mkc_torch.simulation.stepped.mujoco import MujocoStepper

if TYPE_CHECKING:
    from mkc_torch.simulation import Simulation

_EXPERIMENT = "experiment"
WRITTEN = ("diagnosis.json", "model.json", "corrected.py", "corrected.xml", "report.html")


def diagnose_file(
    path: Path, folder: Path, request: Request, look: ConsoleStyle, step: Callable[[str], None] | None = None
) -> list[Outcome]:
    """Diagnose a file into a folder.

    If a table holds several runs, each run is diagnosed separately into a subfolder, unless the simulation fits runs
    jointly. A failed run does not stop the others. ``step`` is called with each stage.
    """
    try:
        request, note = decided(path, request)
        recording = read_recording(path, request)
        simulation = simulation_of(request)
        if request.joints:
            recording = _renamed(recording, f"{recording.name}, {', '.join(request.joints)}")
        claim_folder(folder, overwrite=request.force, files=WRITTEN)
    except Exception as error:
        return [_failed(path, ", ".join(request.joints), error)]
    with folder_written(folder):
        parts, outcomes = list(_parts(recording, simulation, folder)), []
        for number, (label, part, place) in enumerate(parts, start=1):
            which = f", run {label} ({number} of {len(parts)})" if len(parts) > 1 else ""
            stages = StageProgress(step, f"diagnosing {path.name}{which}")
            outcomes.append(_outcome(path, label, simulation, part, place, request, look, stages))
            if outcomes[-1].interrupted:
                break
        if all(outcome.failed for outcome in outcomes):
            remove_if_empty(folder)
    return [replace(outcome, note=note) for outcome in outcomes]


def diagnose_together(
    paths: Sequence[Path], folder: Path, request: Request, look: ConsoleStyle, step: Callable[[str], None] | None = None
) -> list[Outcome]:
    """Diagnose several files jointly, with one set of findings, into one folder.

    If a file cannot be read, nothing is diagnosed. ``step`` is called with each stage.
    """
    recordings, notes = [], []
    for path in paths:
        try:
            own, note = decided(path, request)
            recordings.append(read_recording(path, own))
        except Exception as error:
            return [_failed(path, "", error)]
        notes.append(note)
    subject = Path(joint_name([path.name for path in paths]))
    try:
        simulation = simulation_of(own)
        claim_folder(folder, overwrite=request.force, files=WRITTEN)
    except Exception as error:
        return [_failed(subject, "", error)]
    with folder_written(folder):
        stages = StageProgress(step, f"diagnosing {subject}")
        outcome = _outcome(subject, "", simulation, recordings, folder, own, look, stages)
        if outcome.failed:
            remove_if_empty(folder)
    return [replace(outcome, note=next((note for note in notes if note), ""))]


def decided(path: Path, request: Request) -> tuple[Request, str]:
    """Return the request with a simulation, chosen by the recording's columns if none is given, and a note on it.

    Raises:
        RecordingError: no simulation is given, and the recording has no magnetometer.
    """
    if not request.undecided:
        return request, ""
    try:
        refuse_no_magnetometer(path, request.columns, request.sensor)
    except RecordingError as error:
        raise RecordingError(
            "give --simulation or --simulator-output. Without them a recording is compared with the magnetometer, and "
            f"this recording has none. {error}"
        ) from None
    note = f"no --simulation is given; the recording has a magnetometer, so `--simulation {MAGNETOMETER}` is used."
    return replace(request, simulation=MAGNETOMETER), note


def read_recording(path: Path, request: Request) -> Recording:
    """Read a recording for the simulation of a request.

    Raises:
        RecordingError, OSError: the file cannot be used.
    """
    if request.simulator_output is None and request.simulation == MAGNETOMETER:
        return read_magnetometer(path, request.columns, request.units, request.sensor)[0]
    return read_table(path, request.columns, request.units)


class StageProgress:
    """Report the stages of a diagnosis to the progress of a command.

    Args:
        step: the progress, or a function called with each stage; None reports nothing.
        subject: name of the work, such as ``diagnosing a.csv``.
    """

    def __init__(self, step: Callable[[str], None] | None, subject: str) -> None:
        self._step, self._subject = step, subject

    def __call__(self, stage: str) -> None:
        """Report the stage that begins."""
        if isinstance(self._step, Steps):
            self._step.stage(self._subject, stage)
        elif self._step is not None:
            self._step(f"{self._subject}: {stage}")

    def count(self, thing: str, done: int, total: int) -> None:
        """Report how many parts of the stage are done."""
        if isinstance(self._step, Steps):
            self._step.part(thing, done, total)

    def bound(self, thing: str, done: int, most: int) -> None:
        """Report how many parts of the stage are done before those that follow, and their largest number."""
        if isinstance(self._step, Steps):
            self._step.bound(thing, done, most)

    def found(self, text: str) -> None:
        """Report what was found so far."""
        if isinstance(self._step, Steps):
            self._step.found = text


def write_diagnosis(
    diagnosis: Diagnosis,
    folder: Path,
    *,
    force: bool,
    report: bool = True,
    note: str = "",
    paths: RunPaths | None = None,
) -> tuple[Diagnosis, list[Path]]:
    """Write diagnosis.json, model.json and report.html into a folder.

    Differential equations also get corrected.py, the simulation with the findings, and a model of MuJoCo also
    corrected.xml. ``note`` is shown in the report. A file whose text ends in an internal error is left out, with a
    warning in the other files.

    Returns:
        The diagnosis with these warnings, and the written files.
    """
    from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
    from mkc_torch.report import diagnosis_report

    model = diagnosis.model
    made: dict[str, Callable[[Diagnosis], str]] = {}
    if model is not None:
        made["model.json"] = lambda _: model.to_json()
        made["corrected.py"] = lambda _: model.to_python(folder=folder)
        made["corrected.xml"] = lambda _: model.to_mjcf()[0]
    changes, warnings = (
        (None, ()) if model is None else _text_of("the changes of the model", lambda _: model.mjcf_changes(), diagnosis)
    )
    diagnosis = replace(diagnosis, warnings=(*diagnosis.warnings, *warnings)) if warnings else diagnosis
    # the files with warnings come last
    if report:
        made["report.html"] = lambda d: diagnosis_report(d, note=note, paths=paths, changes=changes or "")
    made["diagnosis.json"] = diagnosis_to_json
    texts: dict[str, str] = {}
    for name, text_of in made.items():
        text, warnings = _text_of(name, text_of, diagnosis)
        texts |= {} if text is None else {name: text}
        diagnosis = replace(diagnosis, warnings=(*diagnosis.warnings, *warnings)) if warnings else diagnosis
    for name in {"model.json", "corrected.py", "corrected.xml", *made} - set(texts):
        (folder / name).unlink(missing_ok=True)  # a file of an earlier diagnosis
    files = [name for name in WRITTEN if name in texts]
    for name in files:
        write_atomically(folder / name, texts[name], overwrite=force)
    return diagnosis, [folder / name for name in files]


def _text_of(
    name: str, text_of: Callable[[Diagnosis], str], diagnosis: Diagnosis
) -> tuple[str | None, tuple[str, ...]]:
    """Return the text of a file, and no warning; or None for a model without source, or with a warning on an error."""
    try:
        return text_of(diagnosis), ()
    except SourceError:
        return None, ()
    except Exception as error:
        return None, (failure(f"writing {name}", error),)


def _parts(recording: Recording, simulation: Simulation, folder: Path) -> Iterator[tuple[str, Recording, Path]]:
    """Yield the runs of a table with labels and folders, or the whole table if it is diagnosed at once."""
    if _EXPERIMENT not in recording or simulation.joins_experiments:
        yield "", recording, folder
        return
    parts = recording.experiments()
    for (label, part), name in zip(parts.items(), folder_names(list(parts)), strict=True):
        yield label, part, folder / name


def _outcome(
    path: Path,
    label: str,
    simulation: Simulation,
    recording: Recording | Sequence[Recording],
    folder: Path,
    request: Request,
    look: ConsoleStyle,
    progress: StageProgress,
) -> Outcome:
    try:
        # without a label the folder is claimed already
        claim_folder(folder, overwrite=request.force or not label, files=WRITTEN)
        with folder_written(folder) if label else nullcontext():
            with stopped_by_interrupt():
                diagnosis = diagnose(
                    simulation,
                    recording,
                    level=request.level,
                    surrogates=request.surrogates,
                    max_findings=request.max_findings,
                    seed=request.seed,
                    noise=request.noise,
                    input_hold=request.input_hold,
                    suspect=request.suspect,
                    quick=request.quick,
                    time_limit=request.time_limit,
                    progress=progress,
                )
            progress("writing the report")
            paths = _paths(path, folder, request)
            whole = write_diagnosis(diagnosis, folder, force=request.force, report=request.report, paths=paths)
    except Exception as error:
        own = raised_in(request.simulation, error) if is_file_of_a_simulation(request.simulation) else None
        return _failed(path, label, own or error)
    stopped = diagnosis.stop is not None and diagnosis.stop.reason == "interrupt"
    written, files = whole
    doubtful = conclusion(written).doubtful or written is not diagnosis
    try:
        text = look.set(lambda console: show(console, written, files, paths))
    except Exception as error:
        text = "\n".join([failure("printing the summary", error), *map(str, files), ""])
        doubtful = True
    return Outcome(text, failed=False, interrupted=stopped, doubtful=doubtful)


def _paths(path: Path, folder: Path, request: Request) -> RunPaths | None:
    """Return the paths for the proposed command; None if several recordings were diagnosed together."""
    if not path.exists():
        return None
    options: list[str] = []
    if request.simulator_output is not None:
        options += ["--simulator-output", str(request.simulator_output)]
    elif request.simulation != MAGNETOMETER:
        options += ["--simulation", request.simulation]
    options += request.read_with
    return RunPaths(str(path), str(folder / "model.json"), tuple(options))


def named_simulation(name: str, fitted: Sequence[str] = ()) -> Simulation:
    """Return the magnetometer, or load the user's simulation.

    Args:
        name: as for ``--simulation``.
        fitted: for a model of MuJoCo, patterns of the numbers to fit; empty for those that the file gives.

    Raises:
        SimulationFileError: the file cannot be used.
    """
    from mkc_torch.simulation import Magnetometer

    return Magnetometer() if name == MAGNETOMETER else load_simulation(name, fitted)


def paired_simulation(path: Path, columns: Mapping[str, str]) -> Simulation:
    """Read a simulator's output. Columns are renamed like those of the recording if they exist in the table.

    Raises:
        ValueError, OSError: the file cannot be used.
    """
    from mkc_torch.simulation import Paired

    table = Recording.read(path, recognise=False)
    there = {name: column for name, column in columns.items() if column in table or split_unit(column)[0] in table}
    return Paired(Recording.read(path, columns=there, recognise=False))


def simulation_of(request: Request) -> Simulation:
    """Return the simulation that the recordings are compared with.

    Raises:
        ValueError, OSError: its file cannot be used.
    """
    if request.simulator_output is not None:
        return paired_simulation(request.simulator_output, request.columns)
    found = named_simulation(request.simulation, request.fit)
    named = request.joints not in ((), (ALL,), (EACH,))
    return found.moving(request.joints) if named and isinstance(found, MujocoStepper) else found


def _renamed(recording: Recording, name: str) -> Recording:
    return Recording(
        recording.columns,
        name=name,
        units=recording.units,
        warnings=recording.warnings,
        labels=recording.labels,
        notes=recording.notes,
    )


def _failed(path: Path, label: str, error: Exception) -> Outcome:
    return Outcome(failure_sentence(path, label, error), failed=True)


def failure_sentence(path: Path, label: str, error: Exception) -> str:
    """Return the sentence on a recording, or a run of it, that could not be used."""
    subject = f"{path}, run {label}" if label else str(path)
    sentence = sentence_of(error) if isinstance(error, FAILURES) else _unexpected(error)
    sentence = sentence.removeprefix(f"{path.stem}/{label}: " if label else f"{path.stem}: ")  # the path has it already
    return sentence if sentence.startswith(subject) else f"{subject}: {sentence}"


def _unexpected(error: Exception) -> str:
    """Return the message of an internal error, with its file and line."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" in {Path(frames[-1].filename).name}, line {frames[-1].lineno}" if frames else ""
    message = sentence_of(error)
    detail = f": {message}" if message else ""
    return f"internal error ({type(error).__name__}{where}{detail}); please report it."

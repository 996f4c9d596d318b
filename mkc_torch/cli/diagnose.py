"""``mkc diagnose``: recordings in, and out for each what its simulation lacks, a model with it, and a report."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from mkc_torch.cli.console import (
    FAILURES,
    ConsoleStyle,
    Steps,
    complain,
    err,
    interrupts_told,
    not_written,
    out,
    parsed_columns,
    parsed_pairs,
    progress,
    refuse_same_names,
)
from mkc_torch.cli.diagnosis_request import (
    BETWEEN,
    LEVEL,
    MAGNETOMETER,
    SIMULATIONS,
    SURROGATES,
    TOGETHER,
    Outcome,
    Request,
    is_file_of_a_simulation,
)
from mkc_torch.cli.loading import loading
from mkc_torch.cli.units_option import HELP, METAVAR, SENSOR_HELP, parsed_units, without_units


def diagnose(
    recordings: Annotated[list[Path], typer.Argument(metavar="REC...", help="CSV or Parquet files with a header.")],
    output: Annotated[Path, typer.Option(help="Folder; each REC gets a folder of its name in it.")],
    simulation: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"What they are compared with: {', '.join(SIMULATIONS)} (default where mag_x, mag_y and mag_z are "
            "there), FILE.py:CLASS, or MODEL.fmu; the code in either file is run.",
        ),
    ] = None,
    simulated: Annotated[
        Path | None,
        typer.Option(metavar="SIM.csv", help="Instead of --simulation: what a simulator wrote, in the same columns."),
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(metavar="NAME=COLUMN,...", help="What the columns are called: mag_x=mx,temperature=IMU_T"),
    ] = None,
    unit: Annotated[list[str] | None, typer.Option(metavar=METAVAR, help=HELP)] = None,
    sensor: Annotated[str | None, typer.Option(metavar="NAME", help=SENSOR_HELP)] = None,
    experiments: Annotated[
        str | None,
        typer.Option(metavar="COLUMN", help="Column that separates runs in one table; default: experiment, if any."),
    ] = None,
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="One simulation and one set of findings for all REC, each with its own start; into OUTPUT/together.",
        ),
    ] = False,
    noise: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=SIZE", help="White noise of an output's sensor, if it is known: angle=0.005"),
    ] = None,
    between: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=HOW", help=f"What an input does between samples, if it is known: {', '.join(BETWEEN)}."
        ),
    ] = None,
    level: Annotated[float, typer.Option(metavar="RATE", help="Rate of false alarms.")] = LEVEL,
    surrogates: Annotated[
        int | None,
        typer.Option(metavar="N", help=f"Draws of noise for each p-value; default: {SURROGATES}, more at a low level."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="S", help="Of the draws of noise.")] = 0,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="A first look in less time: no p-values, false alarms not controlled."),
    ] = False,
    time_limit: Annotated[
        str | None,
        typer.Option(metavar="SECONDS", help="Stop after so long, for each REC, and write what is known then."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing results.")] = False,
) -> None:
    """Say what a simulation lacks: where recordings differ from it, by what physics, how sure, and how much it helps.

    Each REC gets diagnosis.json, model.json (for `mkc apply`) and report.html; with --together all of them get one of
    each. Exits with 0 when every recording was diagnosed, whatever was found, also in the time limit, and 1 when some
    were not. Ctrl-C stops the search, writes what is known, and exits with 130; a second one ends at once.
    """
    recordings, texts = without_units(recordings, unit or [])
    request = Request(
        simulation=_known(simulation, simulated),
        simulated=simulated,
        columns=_columns(columns, experiments),
        units=_units(texts, simulation),
        sensor=_sensor(sensor, simulation),
        noise=_noise(noise or []),
        input_hold=_between(between or []),
        level=_level(level),
        surrogates=_surrogates(surrogates, level, quick=quick),
        seed=seed,
        quick=quick,
        time_limit=_time_limit(time_limit),
        force=force,
    )
    refuse_same_names(recordings)
    with loading():
        from mkc_torch._parallel.processes import in_processes, keep_memory, one_thread
        from mkc_torch.cli.diagnosis_files import simulation_of
    total, failed, left = 0, 0, list(recordings)
    with interrupts_told(lambda: not_written(left, output)):
        _refuse_unusable(request, simulation_of)
    one_thread()
    keep_memory()
    look = ConsoleStyle.of(out())
    if together:
        raise typer.Exit(_all_together(output, request, look, recordings))
    with (
        interrupts_told(lambda: not_written(left, output)),
        progress(len(recordings), output) as step,
        # a single one is worked on in this process, and says which experiment it is at
        in_processes(
            partial(_diagnosed, output, request, look, step if len(recordings) == 1 else None), recordings
        ) as results,
    ):
        for path, result in zip(recordings, results, strict=True):
            step(f"diagnosing {path.name}")
            outcomes = _waited_for(result, path)
            _tell(outcomes, step)
            total += len(outcomes)
            failed += sum(outcome.failed for outcome in outcomes)
            if any(outcome.interrupted for outcome in outcomes):
                raise KeyboardInterrupt
            left.remove(path)
            step(None)
    if total > 1 and failed:
        err().print(f"mkc: {failed} of {total} recordings were not diagnosed.", soft_wrap=True)
    raise typer.Exit(1 if failed else 0)


def _diagnosed(output: Path, request: Request, look: ConsoleStyle, step: Steps | None, path: Path) -> list[Outcome]:
    from mkc_torch.cli.diagnosis_files import diagnose_file

    return diagnose_file(path, output / path.stem, request, look, step)


def _all_together(output: Path, request: Request, look: ConsoleStyle, paths: list[Path]) -> int:
    """Diagnoses the recordings as one; returns the exit code."""
    from mkc_torch.cli.diagnosis_files import diagnose_together

    with interrupts_told(lambda: not_written([output / TOGETHER], output)), progress(1, output) as step:
        step("diagnosing the recordings together")
        outcomes = diagnose_together(paths, output / TOGETHER, request, look, step)
        _tell(outcomes, step)
        if any(outcome.interrupted for outcome in outcomes):
            raise KeyboardInterrupt
        step(None)
    return int(any(outcome.failed for outcome in outcomes))


def _waited_for(result: Callable[[], list[Outcome]], path: Path) -> list[Outcome]:
    try:
        return result()
    except BrokenProcessPool:
        return [Outcome(f"{path}: its process ended, perhaps for lack of memory; try it in a call of its own.", True)]


def _tell(outcomes: list[Outcome], step: Steps) -> None:
    with step.aside():
        for note in dict.fromkeys(outcome.note for outcome in outcomes if outcome.note):
            err().print(f"mkc: {note}", soft_wrap=True)
        for outcome in outcomes:
            if outcome.failed:
                err().print(f"mkc: {outcome.text}", soft_wrap=True)
            else:
                typer.echo(outcome.text, nl=False)


def _known(simulation: str | None, simulated: Path | None) -> str:
    if simulation is not None and simulated is not None:
        raise typer.BadParameter(
            "give one of --simulation and --simulator-output: a simulation's name, or the table that one wrote."
        )
    if simulation is not None and simulation not in SIMULATIONS and not is_file_of_a_simulation(simulation):
        raise typer.BadParameter(
            f'--simulation "{simulation}" is not known; known: {", ".join(SIMULATIONS)}. Name one of them, or one of '
            "your own as FILE.py:CLASS or MODEL.fmu."
        )
    return simulation or ""


def _refuse_unusable(request: Request, simulation_of: Callable[[Request], object]) -> None:
    """Said once, before anything is written, and not again for each recording."""
    if request.undecided:
        return
    try:
        simulation_of(request)
    except FAILURES as error:
        complain(request.simulated or request.simulation, error)
        raise typer.Exit(1) from None


def _columns(columns: str | None, experiments: str | None) -> dict[str, str]:
    names = parsed_columns(columns)
    if experiments is None:
        return names
    if not experiments.strip():
        raise typer.BadParameter("--run-column is empty; name the column that separates the runs.")
    if names.setdefault("experiment", experiments.strip()) != experiments.strip():
        raise typer.BadParameter("--columns and --run-column name different columns for experiment; leave one out.")
    return names


def _units(texts: list[str], simulation: str | None) -> dict[str, str]:
    units = parsed_units(texts)
    if "mag" in units and simulation not in (None, MAGNETOMETER):
        raise typer.BadParameter(
            "--unit is that of a magnetometer's columns; a simulation of your own says its units in its `units`. Its "
            "time, and other columns by name, can be converted: --unit time=us."
        )
    return units


def _sensor(sensor: str | None, simulation: str | None) -> str | None:
    if sensor is not None and simulation not in (None, MAGNETOMETER):
        raise typer.BadParameter(
            "--sensor names a magnetometer; a simulation of your own takes columns by their names."
        )
    return sensor


def _noise(texts: list[str]) -> dict[str, float]:
    """Declared sizes of sensors' noise; whether the simulation has such outputs is known once it is loaded."""
    sizes: dict[str, float] = {}
    for name, text in parsed_pairs("--noise", texts, "angle=0.005").items():
        try:
            sizes[name] = float(text)
        except ValueError:
            raise typer.BadParameter(f'--noise {name}="{text}" is no number; write the size, {name}=0.005.') from None
        if not (math.isfinite(sizes[name]) and sizes[name] > 0.0):
            raise typer.BadParameter(
                f"--noise {name} must be above 0, in the output's unit, but is {text}; leave it out to have it "
                "estimated."
            )
    return sizes


def _between(texts: list[str]) -> dict[str, str]:
    pairs = parsed_pairs("--input-hold", texts, "torque=held")
    for name, how in pairs.items():
        if how not in BETWEEN:
            raise typer.BadParameter(f'--input-hold {name}="{how}" is not known; known: {", ".join(BETWEEN)}.')
    return pairs


def _level(level: float) -> float:
    if not 0.0 < level < 1.0:
        raise typer.BadParameter(f"--level must be a rate between 0 and 1 but is {level:g}.")
    return level


def _time_limit(text: str | None) -> float | None:
    if text is None:
        return None
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise typer.BadParameter(
            f"--time-limit must be a number of seconds above 0 but is {text}; leave it out for no limit."
        )
    return seconds


def _surrogates(count: int | None, level: float, *, quick: bool) -> int:
    """Draws for each p-value: no p-value can be smaller than one over their number plus one."""
    if quick and count is not None:
        raise typer.BadParameter("--quick draws no surrogates; leave out --surrogates, or --quick to have p-values.")
    fewest = math.ceil(1.0 / level - 1.0 - 1e-9)
    if count is None:
        return max(SURROGATES, fewest)
    if count < fewest:
        raise typer.BadParameter(
            f"--surrogates must be at least {fewest} at level {level:g}, for no p-value is smaller than "
            f"1 / (surrogates + 1), but is {count}."
        )
    return count

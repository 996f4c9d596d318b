"""``mkc diagnose``: find the physics that a simulation lacks; write a diagnosis, a model and a report."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mkc_torch.cli.console import (
    DOUBTFUL,
    FAILURES,
    ConsoleStyle,
    complain,
    err,
    interrupts_reported,
    not_written,
    out,
    parsed_pairs,
    progress,
    refuse_same_names,
)
from mkc_torch.cli.diagnosis_request import (
    LEVEL,
    MAGNETOMETER,
    MAX_FINDINGS,
    SIMULATIONS,
    SURROGATES,
    SUSPECTED,
    TOGETHER,
    Outcome,
    Request,
)
from mkc_torch.cli.loading import loading
from mkc_torch.cli.simulation_option import (
    COLUMNS_HELP,
    COLUMNS_METAVAR,
    FIT_HELP,
    INPUT_HOLD_HELP,
    JOINTS_HELP,
    OWN_SIMULATION,
    RUN_COLUMN_HELP,
    checked_columns,
    checked_input_hold,
    checked_sensor,
    checked_simulation,
    checked_units,
    parsed_fit,
    parsed_joints,
)
from mkc_torch.cli.steps import Steps
from mkc_torch.cli.units_option import (
    CONVERT_HELP,
    CONVERT_METAVAR,
    LABEL_HELP,
    SENSOR_HELP,
    reading_options,
    split_trailing_pairs,
)

if TYPE_CHECKING:
    from mkc_torch.simulation import Simulation

_MOST_NAMES = 5


def diagnose(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="REC...", help="CSV or Parquet files with a header, or logs")
    ],
    output: Annotated[Path, typer.Option(help="Folder for the results; each REC gets a subfolder of its name.")] = Path(
        "results"
    ),
    simulation: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"Simulation to compare with: {', '.join(SIMULATIONS)} (default for a magnetometer's recording), "
            f"{OWN_SIMULATION}",
        ),
    ] = None,
    simulator_output: Annotated[
        Path | None,
        typer.Option(
            metavar="SIM.csv", help="Instead of --simulation: a simulator's output for REC, in the same columns."
        ),
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(metavar=COLUMNS_METAVAR, help=COLUMNS_HELP),
    ] = None,
    convert: Annotated[list[str] | None, typer.Option(metavar=CONVERT_METAVAR, help=CONVERT_HELP)] = None,
    unit_label: Annotated[str | None, typer.Option(metavar="UNIT", help=LABEL_HELP)] = None,
    sensor: Annotated[str | None, typer.Option(metavar="NAME", help=SENSOR_HELP)] = None,
    run_column: Annotated[
        str | None,
        typer.Option(metavar="COLUMN", help=RUN_COLUMN_HELP),
    ] = None,
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="Diagnose all REC as runs of one system, with one set of findings; into OUTPUT/together.",
        ),
    ] = False,
    noise: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=SIZE", help="Known standard deviation of an output's white noise: angle=0.005"),
    ] = None,
    input_hold: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=HOLD", help=INPUT_HOLD_HELP),
    ] = None,
    fit: Annotated[
        list[str] | None,
        typer.Option(metavar="NUMBERS", help=FIT_HELP),
    ] = None,
    joints: Annotated[str | None, typer.Option(metavar="JOINTS", help=JOINTS_HELP)] = None,
    suspect: Annotated[
        list[str] | None,
        typer.Option(metavar="EFFECTS", help=f"Suspected effects to score next to the findings: {SUSPECTED}."),
    ] = None,
    level: Annotated[float, typer.Option(metavar="RATE", help="Accepted rate of false alarms.")] = LEVEL,
    surrogates: Annotated[
        int | None,
        typer.Option(metavar="N", help=f"Surrogates for each p-value; default: {SURROGATES}, more at a low level."),
    ] = None,
    max_findings: Annotated[
        int, typer.Option(min=0, metavar="N", help="Largest number of findings; 0 only tests for missing physics.")
    ] = MAX_FINDINGS,
    seed: Annotated[int, typer.Option(min=0, metavar="S", help="Seed of the surrogates.")] = 0,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="Faster, without p-values: false alarms are not controlled."),
    ] = False,
    time_limit: Annotated[
        str | None,
        typer.Option(metavar="SECONDS", help="Stop the search of each REC after this time; write the results so far."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Processes for several REC; default: one a core.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing results.")] = False,
) -> None:
    """Find the physics that a simulation lacks: its place, size and form, the evidence, and the improvement.

    For each REC, diagnosis.json, model.json (for `mkc apply`) and report.html are written; with --together, one set
    for all of them. Several REC also get fleet.html, fleet.csv and fleet.json, which compare their findings; REC that
    an earlier call with these options has completed are left as they are. The exit code is 0 if every recording was
    diagnosed, with or without findings, 1 if one was not, and 3 if all were but a result is not usable unseen: the
    simulation does not fit, structure remains unexplained, no finding is confirmed, the findings do not make the
    residual smaller, or a third of the samples was rejected. Ctrl-C stops the search, writes the results so far and
    exits with 130; a second Ctrl-C exits at once.
    """
    recordings, conversions = split_trailing_pairs(recordings, convert or [])
    request = Request(
        simulation=checked_simulation(simulation, simulator_output),
        simulator_output=simulator_output,
        columns=checked_columns(columns, run_column),
        units=checked_units(conversions, unit_label, simulation),
        sensor=checked_sensor(sensor, simulation),
        noise=_noise(noise or []),
        input_hold=checked_input_hold(input_hold or []),
        fit=parsed_fit(fit or [], simulation),
        joints=parsed_joints(joints, simulation),
        suspect=tuple(suspect or []),
        level=_level(level),
        surrogates=_surrogates(surrogates, level, quick=quick),
        max_findings=max_findings,
        seed=seed,
        quick=quick,
        time_limit=_time_limit(time_limit),
        force=force,
        read_with=reading_options(checked_columns(columns, run_column), conversions, unit_label, sensor),
    )
    refuse_same_names(recordings)
    with loading():
        from mkc_torch._parallel.processes import in_processes, keep_memory, one_thread
        from mkc_torch.cli.diagnosis_files import simulation_of
        from mkc_torch.cli.fleet_files import Earlier, claim_page, earlier_results, is_doubtful, write_diagnoses
        from mkc_torch.cli.joints import by_joints
    every, earlier = recordings, Earlier([], [])
    total, failed, left = 0, 0, list(recordings)
    with interrupts_reported(lambda: not_written(left, output)):
        name = _name_of_usable(request, simulation_of)
        if len(recordings) > 1 and not together:
            claim_page(output)
            earlier = earlier_results(recordings, output, request, name)
            recordings = [path for path in recordings if path not in earlier.complete]
            _print_done(earlier.complete)
            left = list(recordings)
        again = replace(request, force=True)
        own = {path: again if path in earlier.interrupted else request for path in recordings}
        works = [(path, each) for path in recordings for each in by_joints(path, own[path])]
    failures: dict[str, str] = {}
    doubtful = any(is_doubtful(output / path.stem) for path in earlier.complete)
    one_thread()
    keep_memory()
    look = ConsoleStyle.of(out())
    if together:
        raise typer.Exit(_all_together(output, request, look, recordings))
    with (
        interrupts_reported(lambda: not_written(left, output)),
        progress(len(works), output, lines=True) as step,
        # a single recording is diagnosed in this process, so that its run can be shown
        in_processes(partial(_diagnosed, output, look, step if len(works) == 1 else None), works, workers) as results,
    ):
        for number, ((path, each), result) in enumerate(zip(works, results, strict=True)):
            step(f"diagnosing {path.name}{''.join(f', {joint}' for joint in each.joints)}")
            outcomes = _waited_for(result, path)
            _print_outcomes(outcomes, step)
            total += len(outcomes)
            failed += sum(outcome.failed for outcome in outcomes)
            doubtful = doubtful or any(outcome.doubtful for outcome in outcomes)
            failures.update((path.name, outcome.text) for outcome in outcomes if outcome.failed)
            if any(outcome.interrupted for outcome in outcomes):
                raise KeyboardInterrupt
            if number + 1 == len(works) or works[number + 1][0] != path:
                left.remove(path)
                _join(output / path.stem, [own for other, own in works if other == path], step)
            step(None)
    if len(every) > 1:
        for written in write_diagnoses(every, output, failures):
            typer.echo(f"written       {written}")
    if total > 1 and failed:
        err().print(f"mkc: {failed} of {total} recordings were not diagnosed.", soft_wrap=True)
    raise typer.Exit(1 if failed else DOUBTFUL if doubtful else 0)


def _print_done(done: list[Path]) -> None:
    if done:
        names = ", ".join(path.name for path in done[:_MOST_NAMES]) + (", …" if len(done) > _MOST_NAMES else "")
        which = "1 recording was diagnosed before and is left as it is"
        if len(done) > 1:
            which = f"{len(done)} recordings were diagnosed before and are left as they are"
        err().print(f"mkc: {which}: {names}. --force repeats them.", soft_wrap=True)


def _diagnosed(output: Path, look: ConsoleStyle, step: Steps | None, work: tuple[Path, Request]) -> list[Outcome]:
    from mkc_torch.cli.diagnosis_files import diagnose_file

    path, request = work
    return diagnose_file(path, (output / path.stem).joinpath(*request.joints[:1]), request, look, step)


def _join(folder: Path, requests: list[Request], step: Steps) -> None:
    """Write the findings of all joints of a MuJoCo model into one file, if they were diagnosed one by one."""
    from mkc_torch.cli.joints import write_joined

    if len(requests) > 1 and (found := write_joined(folder, requests)) is not None:
        with step.aside():
            typer.echo(f"The model with the findings of all joints: {found}")


def _all_together(output: Path, request: Request, look: ConsoleStyle, paths: list[Path]) -> int:
    """Diagnose the recordings together. Returns the exit code."""
    from mkc_torch.cli.diagnosis_files import diagnose_together

    with interrupts_reported(lambda: not_written([output / TOGETHER], output)), progress(1, output, lines=True) as step:
        step("diagnosing the recordings together")
        outcomes = diagnose_together(paths, output / TOGETHER, request, look, step)
        _print_outcomes(outcomes, step)
        if any(outcome.interrupted for outcome in outcomes):
            raise KeyboardInterrupt
        step(None)
    if any(outcome.failed for outcome in outcomes):
        return 1
    return DOUBTFUL if any(outcome.doubtful for outcome in outcomes) else 0


def _waited_for(result: Callable[[], list[Outcome]], path: Path) -> list[Outcome]:
    try:
        return result()
    except BrokenProcessPool:
        return [Outcome(f"{path}: the process ended twice, perhaps out of memory; diagnose this file alone.", True)]


def _print_outcomes(outcomes: list[Outcome], step: Steps) -> None:
    with step.aside():
        for note in dict.fromkeys(outcome.note for outcome in outcomes if outcome.note):
            err().print(f"mkc: {note}", soft_wrap=True)
        for outcome in outcomes:
            if outcome.failed:
                err().print(f"mkc: {outcome.text}", soft_wrap=True)
            else:
                typer.echo(outcome.text, nl=False)


def _name_of_usable(request: Request, simulation_of: Callable[[Request], Simulation]) -> str:
    """Return the simulation's name, or exit with one message, before anything is written, if it cannot be loaded."""
    if request.undecided:
        return MAGNETOMETER
    try:
        return simulation_of(request).name
    except FAILURES as error:
        complain(request.simulator_output or request.simulation, error)
        raise typer.Exit(1) from None


def _noise(texts: list[str]) -> dict[str, float]:
    """Parse the declared noise of each output. The names are checked when the simulation is loaded."""
    sizes: dict[str, float] = {}
    for name, text in parsed_pairs("--noise", texts, "angle=0.005").items():
        try:
            sizes[name] = float(text)
        except ValueError:
            raise typer.BadParameter(f'--noise {name}="{text}" is not a number; write {name}=0.005.') from None
        if not (math.isfinite(sizes[name]) and sizes[name] > 0.0):
            raise typer.BadParameter(
                f"--noise {name} must be above 0, in the output's unit, but is {text}; without it the noise is "
                "estimated."
            )
    return sizes


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
    """Return the number of surrogates; the smallest p-value is 1 / (surrogates + 1)."""
    if quick and count is not None:
        raise typer.BadParameter("--quick draws no surrogates; leave out --surrogates, or --quick to have p-values.")
    fewest = math.ceil(1.0 / level - 1.0 - 1e-9)
    if count is None:
        return max(SURROGATES, fewest)
    if count < fewest:
        raise typer.BadParameter(
            f"--surrogates must be at least {fewest} at level {level:g}, because the smallest p-value is "
            f"1 / (surrogates + 1), but is {count}."
        )
    return count

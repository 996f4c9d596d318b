"""Print the content of a file, or return it as data for JSON."""

from __future__ import annotations

import re
import shlex
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mkc_torch.cli.diagnosis_request import MAGNETOMETER
from mkc_torch.cli.recorded import read_magnetometer
from mkc_torch.recording.formats.base import RecordingError
from mkc_torch.recording.inspection import FileSeen, SensorSeen, TopicSeen

_MOST_PROPOSED = 3
"""Most commands that are proposed for columns that may be a magnetometer."""


def commands_of(seen: FileSeen) -> tuple[list[str], list[str]]:
    """Return the commands that calibrate the recognised sensors, and notes.

    Returns:
        The commands, with the options they need, and the notes. If a question is open there are no commands, and the
        question is the first note.
    """
    if seen.question or not seen.sensors:
        return [], [seen.question] if seen.question else []
    notes: list[str] = []
    options: set[str | None] = set()
    for sensor in seen.sensors:
        sentences, option = _trial(seen, sensor)
        notes += [sentence for sentence in sentences if sentence not in notes]
        options |= {option}
    command = f"mkc calibrate {shlex.quote(str(seen.path))}"
    if len(options) > 1 or None in options:  # one call for each sensor
        pairs = [(sensor, *_trial(seen, sensor)) for sensor in seen.sensors]
        return [
            f"{command} --sensor {shlex.quote(sensor.name)}{option} --output results/{shlex.quote(sensor.name)}"
            for sensor, _, option in pairs
            if option is not None
        ], notes
    return [f"{command}{options.pop()} --output results"], notes


def _trial(seen: FileSeen, sensor: SensorSeen) -> tuple[list[str], str | None]:
    """Read a sensor. Returns its warnings and the option it needs, "" for none, None if reading fails."""
    try:
        recording, _ = read_magnetometer(seen.path, {}, {}, sensor.name or None)
    except RecordingError as error:
        _, found, after = str(error).partition("`--convert mag=")
        return [str(error)], f" --convert mag={after.partition('`')[0]}" if found else None
    return [*recording.warnings, *recording.notes], ""


def as_data(seen: FileSeen) -> dict[str, Any]:
    """Return the content of a file as data for JSON."""
    commands, notes = commands_of(seen)
    data = asdict(seen) | {"path": str(seen.path), "commands": commands, "notes": notes}
    for sensor in data["sensors"]:
        sensor["columns"], sensor["units"] = dict(sensor["columns"]), dict(sensor["units"])
    return data


def show(console: Console, seen: FileSeen, found: tuple[list[str], list[str]]) -> None:
    """Print the commands that take a file, then its topics and columns, the recognised sensors and the notes."""
    commands, notes = found
    console.print()
    console.print(Text(str(seen.path), style="bold"), soft_wrap=True)
    for command in [*commands, *_if_named(seen), *_diagnoses(seen)]:
        console.print(Text.assemble(f"{'to do':<8}", (command, "cyan")), soft_wrap=True)
    for topic in seen.topics:
        console.print(Text(_about(topic)), soft_wrap=True)
        console.print(_columns(topic))
    for sensor in seen.sensors:
        where = f" {sensor.name}" if sensor.name else ""
        console.print(
            Text(f"magnetometer{where}: {', '.join(_taken(dict(sensor.columns), dict(sensor.units)))}"), soft_wrap=True
        )
    for sentence in notes:
        console.print(Text(f"note: {sentence}"), soft_wrap=True)


def _if_named(seen: FileSeen) -> list[str]:
    """Return the commands that calibrate the columns that may be a magnetometer, if there are few."""
    options = re.findall(r"`(--columns [^`]+)`", seen.question or "")
    if not 1 <= len(options) <= _MOST_PROPOSED:
        return []
    path = shlex.quote(str(seen.path))
    return [f"mkc calibrate {path} {option} --output results  (if this is a magnetometer)" for option in options]


def _diagnoses(seen: FileSeen) -> list[str]:
    """Return the command that diagnoses the file: with the magnetometer, or with the user's simulation."""
    path = shlex.quote(str(seen.path))
    if not seen.sensors or seen.question:
        return [f"mkc diagnose {path} --simulation FILE.py:CLASS  (your simulation of these columns)"]
    name = seen.sensors[0].name
    which = f" --sensor {shlex.quote(name)}" if name else ""
    return [f"mkc diagnose {path} --simulation {MAGNETOMETER}{which}"]


def _about(topic: TopicSeen) -> str:
    """Return a line on a topic: rows, rate, duration, gaps and runs."""
    parts = [f"{topic.rows:,} rows"]
    if topic.rate is not None and topic.seconds is not None:
        parts += [f"{topic.rate:.4g} Hz", f"{topic.seconds:.5g} s"]
        parts.append(f"{topic.gaps} gaps, the longest {topic.longest_gap:.4g} s" if topic.gaps else "no gaps")
        if topic.runs > 1:
            parts.append(f"{topic.runs} runs")
    else:
        parts.append("no time")
    return f"{topic.name or 'table'}: {', '.join(parts)}"


def _columns(topic: TopicSeen) -> Table:
    table = Table.grid(padding=(0, 3, 0, 0))
    for name in ("column", "kind", "unit", "looks like", "without a value"):
        table.add_column(name, overflow="fold", justify="right" if name.startswith("without") else "left")
    table.add_row(*(Text(word, style="dim") for word in ("column", "kind", "unit", "looks like", "without a value")))
    for column in topic.columns:
        missing = f"{column.missing:,}" if column.missing else ""
        table.add_row(*map(Text, (column.name, column.kind, column.unit, column.looks_like, missing)))
    return table


def _taken(columns: dict[str, str], units: dict[str, str]) -> list[str]:
    """Return the source of each column, such as ``mag_x from magX [uT]``."""
    sources = []
    for new, old in columns.items():
        unit = f" in {units[new]}" if new in units and units[new] not in old else ""
        sources.append(f"{new} from {old}{unit}" if new != old else f"{new}{unit}")
    return sources

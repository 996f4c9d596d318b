"""What is in a file, as tables on a terminal and as data."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mkc_torch._words.terms import term
from mkc_torch.cli.recorded import read_magnetometer
from mkc_torch.recording.formats.base import RecordingError
from mkc_torch.recording.inspection import FileSeen, SensorSeen, TopicSeen

__all__ = ["as_data", "commands_of", "show"]


def commands_of(seen: FileSeen) -> tuple[list[str], list[str]]:
    """The command that calibrates what is recognised, with the options it needs; and what there is to say of it first.

    Returns:
        Commands, none where there is a question; and sentences, of which the first is the question.
    """
    if seen.question or not seen.sensors:
        return [], [seen.question]
    told: list[str] = []
    options: set[str | None] = set()
    for sensor in seen.sensors:
        sentences, option = _asked(seen, sensor)
        told += [sentence for sentence in sentences if sentence not in told]
        options |= {option}
    command = f"mkc calibrate {shlex.quote(str(seen.path))}"
    if len(options) > 1 or None in options:  # each sensor in a call of its own
        pairs = [(sensor, *_asked(seen, sensor)) for sensor in seen.sensors]
        return [
            f"{command} --sensor {shlex.quote(sensor.name)}{option} --output results/{shlex.quote(sensor.name)}"
            for sensor, _, option in pairs
            if option is not None
        ], told
    return [f"{command}{options.pop()} --output results"], told


def _asked(seen: FileSeen, sensor: SensorSeen) -> tuple[list[str], str | None]:
    """What reading a sensor tells, and the option that it asks for, empty for none; None where it fails."""
    try:
        recording, _ = read_magnetometer(seen.path, {}, {}, sensor.name or None)
    except RecordingError as error:
        _, found, after = str(error).partition("`--unit mag=")
        return [str(error)], f" --unit mag={after.partition('`')[0]}" if found else None
    return list(recording.warnings), ""


def as_data(seen: FileSeen) -> dict[str, Any]:
    """The same as data for JSON."""
    commands, told = commands_of(seen)
    data = asdict(seen) | {"path": str(seen.path), "commands": commands, "told": told}
    for sensor in data["sensors"]:
        sensor["columns"], sensor["units"] = dict(sensor["columns"]), dict(sensor["units"])
    return data


def show(console: Console, seen: FileSeen, found: tuple[list[str], list[str]]) -> None:
    """Print what is in a file, what would be read of it, and the command."""
    commands, told = found
    console.print()
    console.print(Text(str(seen.path), style="bold"), soft_wrap=True)
    for topic in seen.topics:
        console.print(Text(_about(topic)), soft_wrap=True)
        console.print(_columns(topic))
    for sensor in seen.sensors:
        where = f" {sensor.name}" if sensor.name else ""
        console.print(
            Text(f"magnetometer{where}: {', '.join(_taken(dict(sensor.columns), dict(sensor.units)))}"), soft_wrap=True
        )
    for sentence in told:
        console.print(Text(f"note: {sentence}"), soft_wrap=True)
    for command in commands:
        console.print(Text.assemble(f"{term('label.to_do'):<8}", (command, "cyan")), soft_wrap=True)


def _about(topic: TopicSeen) -> str:
    """A line on a topic: rows, rate, duration, gaps, runs."""
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
    """What is read as what: mag_x from magX [uT]."""
    told = []
    for new, old in columns.items():
        unit = f" in {units[new]}" if new in units and units[new] not in old else ""
        told.append(f"{new} from {old}{unit}" if new != old else f"{new}{unit}")
    return told

"""List the effects of the catalogue, and where each can act in a simulation: as data for JSON, or as a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mkc_torch.diagnosis.model.shapes import candidates_of, ports_of
from mkc_torch.diagnosis.model.suspect import short_name, spelled, suspect_id
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects import CATALOGUE
from mkc_torch.effects.base import Effect
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation import Simulation
from mkc_torch.simulation.declared_ports import declared_ports
from mkc_torch.simulation.ports import Port

COLUMN = "COLUMN"
"""The driver of an effect while no recording is known."""

_EXPERIMENT = "experiment"


@dataclass(frozen=True)
class Place:
    """Where an effect can act in a simulation.

    Attributes:
        suspect: the effect with its port and its driver, as `mkc diagnose --suspect` accepts them.
        port: full name of the port.
        drivers: columns that drive the effect; ``COLUMN`` while no recording is known; empty without a driver.
    """

    suspect: str
    port: str
    drivers: tuple[str, ...]


@dataclass(frozen=True)
class ListedEffect:
    """An effect of the catalogue; variants with the same id and explanation are listed together.

    Attributes:
        id, name, equation, explanation: texts of the effect.
        ports: names or kinds of the ports where it acts.
        roles: roles of the columns that can drive it.
        places: where it can act in the simulation; empty without a simulation.
    """

    id: str
    name: str
    equation: str
    explanation: str
    ports: tuple[str, ...]
    roles: tuple[str, ...]
    places: tuple[Place, ...] = ()


@dataclass(frozen=True)
class EffectsSummary:
    """The effects, and where they can act in a simulation.

    Attributes:
        simulation: name of the simulation; None for the whole catalogue.
        exact: whether the places are those of a recording, and not all that a recording could have.
        effects: the effects that can act; without a simulation, all effects.
        without_place: ids of the other effects of the catalogue.
        notes: sentences about the list.
    """

    simulation: str | None
    exact: bool
    effects: tuple[ListedEffect, ...]
    without_place: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def whole_catalogue() -> EffectsSummary:
    """Return all effects, without a simulation."""
    groups: dict[tuple[str, str], list[Effect]] = {}
    for effect in CATALOGUE:
        groups.setdefault((effect.id, effect.explanation), []).append(effect)
    notes = ("with --simulation, the ports where each effect can act are listed.",)
    return EffectsSummary(None, False, tuple(map(_listed, groups.values())), notes=notes)


def declared_places(simulation: Simulation) -> EffectsSummary:
    """Return where effects can act in a simulation by its declarations, for any recording.

    Raises:
        ValueError: the simulation declares no states, inputs or outputs, or they are inconsistent.
    """
    ports = declared_ports(simulation)
    found = [(effect, place) for effect in CATALOGUE for place in _possible_places(effect, ports)]
    notes = ["with a recording, REC, the list is exact."]
    if any(place.drivers for _, place in found):
        notes.append(f"{COLUMN} is a recorded column that the simulation does not use.")
    return _summary(simulation.name, found, exact=False, notes=notes)


def recorded_places(simulation: Simulation, recording: Recording) -> EffectsSummary:
    """Return where effects can act in a simulation of a recording, with the columns that can drive them.

    Of runs that are diagnosed separately the first is used.

    Raises:
        ValueError: the recording cannot be simulated.
    """
    if _EXPERIMENT in recording and not simulation.joins_experiments:
        recording = next(iter(recording.experiments().values()))
    prepared = simulation.prepare(recording)
    drivers, terms = candidates_of(simulation, prepared.open_loop(), CATALOGUE, DriverSettings())
    first: dict[tuple[object, ...], Term] = {}
    for term in terms:
        first.setdefault(term.key, term)
    found = [(term.effect, Place(suspect_id(term, terms), term.port, term.columns)) for term in first.values()]
    return _summary(simulation.name, found, exact=True, notes=drivers.warnings)


def _possible_places(effect: Effect, ports: Mapping[str, Port]) -> list[Place]:
    drivers: list[tuple[str, ...]] = [()] if not effect.roles or effect.driver_optional else []
    drivers += [(COLUMN,)] if effect.roles else []
    return [
        Place(spelled(effect, short_name(effect, port), driver), port, driver)
        for port in ports_of(effect, ports)
        for driver in drivers
    ]


def _summary(name: str, found: Sequence[tuple[Effect, Place]], *, exact: bool, notes: Iterable[str]) -> EffectsSummary:
    effects: dict[str, list[Effect]] = {}
    places: dict[str, list[Place]] = {}
    for effect, place in found:
        effects.setdefault(effect.id, []).append(effect)
        places.setdefault(effect.id, []).append(place)
    listed = tuple(
        replace(_listed(variants), places=tuple(dict.fromkeys(places[id_]))) for id_, variants in effects.items()
    )
    others = tuple(dict.fromkeys(effect.id for effect in CATALOGUE if effect.id not in effects))
    return EffectsSummary(name, exact, listed, others, tuple(notes))


def _listed(variants: Sequence[Effect]) -> ListedEffect:
    """Return one entry for variants of an effect, with the texts of the first."""
    first = variants[0]
    ports = dict.fromkeys(effect.port for effect in variants)
    roles = dict.fromkeys(role for effect in variants for role in effect.roles)
    return ListedEffect(first.id, first.display_name, first.equation, first.explanation, tuple(ports), tuple(roles))


def as_data(summary: EffectsSummary) -> dict[str, Any]:
    """Return the list as data for JSON."""
    return asdict(summary)


def show(console: Console, summary: EffectsSummary) -> None:
    """Print the list: a table on a terminal, otherwise a line for each effect or place."""
    rows: list[tuple[str, ...]]
    header: tuple[str, ...]
    if summary.simulation is None:
        header = ("effect", "port", "driver", "what it is")
        rows = [(e.id, ", ".join(e.ports), _driven_by(e.roles), e.explanation) for e in summary.effects]
    else:
        header = (f"in {summary.simulation}", "what it is")
        rows = [(place.suspect, effect.explanation) for effect in summary.effects for place in effect.places]
    if console.is_terminal:
        console.print(_table(header, rows))
    else:
        for line in _lines([header, *rows]):
            console.print(line, soft_wrap=True)
    if summary.without_place:
        console.print(Text(f"no port or driver for: {', '.join(summary.without_place)}"), soft_wrap=True)
    for note in summary.notes:
        console.print(Text(f"note: {note}"), soft_wrap=True)


def _driven_by(roles: Sequence[str]) -> str:
    return "any column" if "any" in roles else ", ".join(roles)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Return a table in which an explanation stands once for all places of an effect."""
    table = Table.grid(padding=(0, 3, 0, 0))
    for _ in header:
        table.add_column(overflow="fold")
    table.add_row(*(Text(word, style="dim") for word in header))
    before = ""
    for row in rows:
        table.add_row(*map(Text, row[:-1]), Text("" if row[-1] == before else row[-1]))
        before = row[-1]
    return table


def _lines(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a line for each row, with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["   ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]

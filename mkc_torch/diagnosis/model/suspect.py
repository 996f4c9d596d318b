"""Suspected effects as text, such as ``coulomb_friction@speed + input_lag@command``, and the candidates they mean.

The grammar is ``EFFECT[@PORT][(DRIVER)]``, joined by ``+``; blanks around the parts are ignored. A name with ``+``,
``(``, repeated blanks or quotation marks at its begin is written in quotation marks, which are doubled inside.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import NamedTuple

from mkc_torch._support.arguments import format_value, refuse_other_type
from mkc_torch.diagnosis.model.shapes import candidates_of, ports_of
from mkc_torch.diagnosis.model.term import Key, Term
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects import CATALOGUE
from mkc_torch.effects.base import Effect
from mkc_torch.simulation.protocol import PreparedSimulation, Simulation

EXAMPLE = "coulomb_friction@speed + input_lag@command + driver_input_gain@current(temperature)"
"""A text for messages and help."""

_SIMILAR = 0.6
"""Smallest similarity of two names, as difflib measures it, for a proposal."""

_QUOTED = r'"(?:[^"]|"")*"|' + r"'(?:[^']|'')*'"
_EFFECT = rf"{_QUOTED}|[^@(+\"']+"
_PORT = rf"{_QUOTED}|[^(+\"'][^(+]*"
_DRIVER = rf"{_QUOTED}|(?![\"'])(?:[^()]|\([^()]*\))+"
_ITEM = re.compile(rf"\s*({_EFFECT})\s*(?:@\s*({_PORT})\s*)?(?:\(\s*({_DRIVER})\s*\)\s*)?(?:\+|$)")
"""An effect, its port and its driver, up to the next plus sign or the end."""


class _Suspect(NamedTuple):
    """An effect in the text, with its port and its driver; None where it is not given."""

    effect: str
    port: str | None
    driver: str | None


def suspected_terms(text: str, terms: Sequence[Term], prepared: PreparedSimulation) -> tuple[tuple[Term, ...], ...]:
    """Return the candidates of each effect that a text names, in its order.

    A port is named by its full name, such as ``rate of speed``, by this name without its kind, ``speed``, or by one of
    the quantities that it changes, such as an axis of a sensor. A full name precedes a name without its kind, and this
    precedes a quantity. A short name of several ports of an effect means all of them, as ``a`` in ``exchange of a and
    b`` and ``exchange of a and c``. The port can be left out if the effect has a single port. The driver is a column;
    several columns that act together are joined by commas, or named by their role, ``position``. Without a driver the
    effect's form without a driver is meant, otherwise its only driver.

    Args:
        text: the effects, ``EFFECT[@PORT][(DRIVER)]`` joined by ``+``.
        terms: all candidates, as :func:`mkc_torch.diagnosis.model.shapes.candidate_terms` returns them.
        prepared: the simulation with its recording, for which the candidates were made.

    Returns:
        For each effect, all candidates at the chosen ports with the chosen driver: one for each shape of its grid.

    Raises:
        TypeError: the text is not a string.
        ValueError: the text is empty or has another form, names an effect, a port or a driver that is unknown or that
            this simulation does not have, leaves out a port or a driver of which there are several, or names a
            candidate twice.

    Example:
        >>> import torch
        >>> from mkc_torch.diagnosis.model.shapes import candidate_terms
        >>> from mkc_torch.effects import CATALOGUE
        >>> from mkc_torch.recording import Recording
        >>> from mkc_torch.simulation import Static
        >>> class Thermistor(Static):
        ...     inputs, outputs, parameters = ("temperature",), ("voltage",), {"slope": 0.01}
        ...
        ...     def output(self, time, u, p):
        ...         return {"voltage": p.slope * u.temperature}
        >>> time = torch.arange(0.0, 10.0, 0.1)
        >>> recording = Recording({"time": time, "temperature": 20.0 + time, "voltage": 0.01 * time.cos()})
        >>> prepared = Thermistor().prepare(recording)
        >>> terms = candidate_terms(prepared, (), CATALOGUE)
        >>> lag, gain = suspected_terms("input_lag + gain@voltage", terms, prepared)
        >>> [term.key for term in gain], {term.key for term in lag}, len(lag)
        ([('gain', (), 'output voltage')], {('input_lag', (), 'input temperature')}, 2)
    """
    refuse_other_type("suspect", text, str, "text", f"write, for example, {EXAMPLE!r}")
    chosen: list[tuple[Term, ...]] = []
    known: dict[Key, str] = {}
    for suspect in _parsed(text):
        found = _at_port(suspect, _of_effect(suspect.effect, terms, prepared), prepared)
        found = _with_driver(suspect, found)
        for key in dict.fromkeys(term.key for term in found):
            if key in known:
                raise ValueError(
                    f"Expected argument `suspect` to name each effect once but got `{known[key]}` twice; leave one out."
                )
            known[key] = suspect_id(next(term for term in found if term.key == key), terms)
        chosen.append(found)
    return tuple(chosen)


def texts_of(suspect: object) -> tuple[str, ...]:
    """Return the texts of the suspected sets of effects, of which one can be given alone.

    Raises:
        TypeError: neither a text nor a sequence of texts.

    Example:
        >>> texts_of("input_lag@command"), texts_of(["gain", "offset"]), texts_of(())
        (('input_lag@command',), ('gain', 'offset'), ())
    """
    texts = (suspect,) if isinstance(suspect, str) else suspect
    if not isinstance(texts, (list, tuple)):
        raise TypeError(
            f"Expected argument `suspect` to be a text or a sequence of texts but got {format_value(suspect)}; write, "
            f"for example, {EXAMPLE!r}."
        )
    for number, text in enumerate(texts):
        refuse_other_type(f"suspect[{number}]", text, str, "text", f"write, for example, {EXAMPLE!r}")
    return tuple(texts)


def refuse_unknown(
    texts: Sequence[str],
    simulation: Simulation,
    prepared: PreparedSimulation,
    effects: Sequence[Effect],
    settings: DriverSettings,
) -> None:
    """Raise for suspected effects that the search could not score.

    Args:
        texts: the suspected sets of effects.
        simulation: as given by the user.
        prepared: the simulation with its recording.
        effects: the catalogue.
        settings: which columns are drivers.

    Raises:
        ValueError: the simulation has no differential equations, or a text is refused by :func:`suspected_terms`.
    """
    if not texts:
        return
    if prepared.dynamics is None:
        raise ValueError(
            "Expected argument `suspect` to be empty, because suspected effects are scored for differential equations "
            f"only and {prepared.name} has none, but got {texts[0]!r}; leave it out."
        )
    terms = candidates_of(simulation, prepared.open_loop(), effects, settings)[1]
    for text in texts:
        suspected_terms(text, terms, prepared)


def suspect_id(term: Term, terms: Sequence[Term] = ()) -> str:
    """Return the text by which :func:`suspected_terms` selects the candidates with the key of a term.

    Args:
        term: a candidate.
        terms: all candidates; the port is then named in full if its short name means another port of the effect too,
            such as an input and an output of one name.

    Example:
        >>> from mkc_torch.effects.dynamics.coulomb_friction import CoulombFriction
        >>> suspect_id(Term(CoulombFriction(), None, {}, "rate of speed"))
        'coulomb_friction@speed'
    """
    own = term.effect.form_id
    ports = {other.port: short_name(other.effect, other.port) for other in terms if other.effect.form_id == own}
    short = short_name(term.effect, term.port)
    alike = short in ports or sum(short == other for other in ports.values()) > 1
    return spelled(term.effect, term.port if alike else short, term.columns)


def spelled(effect: Effect, port: str, columns: Sequence[str]) -> str:
    """Return an effect, a name of a port and the columns that drive the effect, as a suspected effect is written.

    Example:
        >>> from mkc_torch.effects.dynamics.driver_input_gain import DriverInputGain
        >>> spelled(DriverInputGain(), "current", ["temperature"]), spelled(DriverInputGain(), "der(x)", ["a  b"])
        ('driver_input_gain@current(temperature)', 'driver_input_gain@"der(x)"("a  b")')
    """
    driver = f"({_quoted(', '.join(columns), _DRIVER)})" if columns else ""
    return f"{_quoted(effect.form_id, _EFFECT)}@{_quoted(port, _PORT)}{driver}"


def short_name(effect: Effect, port: str) -> str:
    """Return the name of a port without its kind, where the effect acts at all ports of this kind.

    Example:
        >>> from mkc_torch.effects.dynamics.coupling import Coupling
        >>> from mkc_torch.effects.dynamics.input_lag import InputLag
        >>> short_name(InputLag(), "input torque"), short_name(Coupling(), "exchange of warm and cold")
        ('torque', 'warm and cold')
    """
    for prefix in (f"{effect.port} of ", f"{effect.port} "):
        if port.startswith(prefix) and port != prefix:
            return port.removeprefix(prefix)
    return port.rpartition("entry of ")[2]


def _quoted(name: str, pattern: str) -> str:
    """Return a name, in quotation marks if it would be read differently without them."""
    if name and re.fullmatch(pattern, name) and name[0] not in "\"'" and _normalised(name) == name:
        return name
    doubled = name.replace('"', '""')
    return f'"{doubled}"'


def _parsed(text: str) -> Iterator[_Suspect]:
    """Yield the effects of a text with their ports and drivers.

    Raises:
        ValueError: a part of the text is not ``EFFECT[@PORT][(DRIVER)]``.
    """
    begin, more = 0, True
    while more:
        found = _ITEM.match(text, begin)
        if found is None or not found[1].strip():
            raise ValueError(
                "Expected argument `suspect` to be effects joined by +, each EFFECT, EFFECT@PORT or "
                f"EFFECT@PORT(DRIVER), but got {text[begin:].strip() or text!r}; write, for example, {EXAMPLE!r}."
            )
        yield _Suspect(_plain(found[1]) or "", _plain(found[2]), _plain(found[3]))
        begin, more = found.end(), found[0].endswith("+")


def _plain(given: str | None) -> str | None:
    """Return a name without its quotation marks and the blanks around it; None for None."""
    if given is None:
        return None
    given = given.strip()
    mark = given[:1]
    return given[1:-1].replace(2 * mark, mark) if mark in ("'", '"') else given


def _normalised(name: str) -> str:
    """Return a name with single blanks, and a blank after each comma."""
    return re.sub(r"\s*,\s*", ", ", " ".join(name.split()))


def _same(given: str, names: Iterable[str]) -> list[str]:
    """Return the names that are equal to a given name, or else equal except for blanks."""
    known = list(names)
    return [given] if given in known else [name for name in known if _normalised(name) == _normalised(given)]


def _of_effect(name: str, terms: Sequence[Term], prepared: PreparedSimulation) -> tuple[Term, ...]:
    """Return all candidates of an effect.

    Raises:
        ValueError: there is no such effect, or it cannot act in the simulation.
    """
    found = tuple(term for term in terms if term.effect.form_id == name)
    if found:
        return found
    there = dict.fromkeys(term.effect.id for term in terms)
    others = f"effects that can act there are {_listed(there)}"
    of_catalogue = [effect for effect in CATALOGUE if effect.id == name]
    if not of_catalogue:
        known = [*there, *(effect.id for effect in CATALOGUE)]
        raise ValueError(
            f"Expected argument `suspect` to name effects but got `{name}`, which is unknown; "
            f"{_proposal(name, known)}in {prepared.name}, {others}."
        )
    acting = [effect for effect in of_catalogue if ports_of(effect, prepared.ports)]
    lacks = "has no port there"
    if acting:
        alone = any(not effect.roles or effect.driver_optional for effect in acting)
        lacks = "has no shape longer than a sample there" if alone else "has no column there that can drive it"
    raise ValueError(
        f"Expected argument `suspect` to name effects that can act in {prepared.name} but got `{name}`, which {lacks}; "
        f"{others}."
    )


def _at_port(suspect: _Suspect, terms: Sequence[Term], prepared: PreparedSimulation) -> tuple[Term, ...]:
    """Return the candidates at the ports that are named, of candidates of a single effect.

    Raises:
        ValueError: the effect has no such port, or it has several and none is named.
    """
    short = {term.port: short_name(term.effect, term.port) for term in terms}
    ports = _listed(_quoted(name, _PORT) for name in dict.fromkeys(short.values()))
    if suspect.port is None:
        if len(short) > 1:
            example = spelled(
                terms[0].effect, short[terms[0].port], () if suspect.driver is None else (suspect.driver,)
            )
            raise ValueError(
                f"Expected argument `suspect` to name the port of `{suspect.effect}`, which can act at {len(short)} "
                f"ports, but got no port; write, for example, `{example}`; its ports in {prepared.name} are {ports}."
            )
        return tuple(terms)
    levels: tuple[Mapping[str, Sequence[str]], ...] = (
        {port: (port,) for port in short},
        {port: (name,) for port, name in short.items()},
        {port: prepared.ports[port].channels for port in short},
    )
    for names in levels:
        named = [port for port, its in names.items() if _same(suspect.port, its)]
        if named:
            return tuple(term for term in terms if term.port in named)
    known = [*short.values(), *short, *(name for port in short for name in prepared.ports[port].channels)]
    raise ValueError(
        f"Expected argument `suspect` to name a port of `{suspect.effect}` but got `{suspect.port}`, where it cannot "
        f"act; {_proposal(suspect.port, known)}its ports in {prepared.name} are {ports}."
    )


def _with_driver(suspect: _Suspect, terms: Sequence[Term]) -> tuple[Term, ...]:
    """Return the candidates with the driver that is named, of candidates of a single effect.

    Raises:
        ValueError: there is no such driver, or there are several and none is named.
    """
    drivers = {term.columns: term.driver for term in terms}
    names = {", ".join(columns): columns for columns in drivers if columns}
    listed = _listed(_quoted(name, _DRIVER) for name in names)
    if suspect.driver is None:
        chosen = () if () in drivers else next(iter(drivers))
        if len(drivers) > 1 and chosen:
            raise ValueError(
                f"Expected argument `suspect` to name the driver of `{suspect.effect}`, which {len(drivers)} columns "
                f"can drive, but got no driver; write, for example, `{suspect_id(terms[0])}`; its drivers in this "
                f"recording are {listed}."
            )
        return tuple(term for term in terms if term.columns == chosen)
    others = {
        name: columns
        for columns, driver in drivers.items()
        if driver is not None
        for name in (*driver.copies, *([driver.role] if len(columns) > 1 else []))
    }
    for known in (names, others):
        if same := _same(suspect.driver, known):
            return tuple(term for term in terms if term.columns == known[same[0]])
    if not names:
        raise ValueError(
            f"Expected argument `suspect` to give no driver to `{suspect.effect}`, which depends on no column, but got "
            f"`{suspect.driver}`; write `{suspect_id(terms[0])}`."
        )
    raise ValueError(
        f"Expected argument `suspect` to name a driver of `{suspect.effect}` but got `{suspect.driver}`, which cannot "
        f"drive it; {_proposal(suspect.driver, [*names, *others])}its drivers in this recording are {listed}."
    )


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names) or "none"


def _proposal(given: str, known: Iterable[str]) -> str:
    """Return a question for the most similar names, up to three, and a blank; empty if none is similar."""
    similar = get_close_matches(given, list(dict.fromkeys(known)), 3, _SIMILAR)
    return f"did you mean {' or '.join(f'`{name}`' for name in similar)}? " if similar else ""

"""Drivers of effects, the terms that pair an effect with a driver at a port, and parallel work on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

from mkc_torch._parallel.pool import shared
from mkc_torch._support.note import Note
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Shape
from mkc_torch.recording.recording import Recording
from mkc_torch.recording.time_order import note_if_few
from mkc_torch.simulation.ports import Port
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

COPY = 1e-9
"""Distance of a correlation from ±1 below which two columns are one driver."""

ANY = "any"
"""The role of a column of unknown role."""

INPUT = "input"
"""The role of an input of a simulation without a state, for effects that state it."""

PAIR = "pair"
"""The role of two columns together."""

_ROLE_OF_NAME: Mapping[str, str] = {"temperature": "temperature", "temp": "temperature", "current": "current"}
_ROLE_OF_UNIT: Mapping[str, str] = {"°C": "temperature", "K": "temperature", "A": "current"}
_POSITION = ("position_x", "position_y", "position_z")


@dataclass(frozen=True)
class Driver:
    """One or several columns that drive an effect together.

    Attributes:
        columns: their names.
        role: "temperature", "current", "position", "input", "pair" or "any".
        values: (N, k), finite, less ``reference``.
        reference: (k,), the columns' means.
        units: of the columns.
        copies: names of columns that are equal except for offset and gain.
    """

    columns: tuple[str, ...]
    role: str
    values: Float[Tensor, "N k"]
    reference: Float[Tensor, " k"]
    units: tuple[str, ...]
    copies: tuple[str, ...] = ()


@dataclass(frozen=True)
class Drivers:
    """The drivers of a recording, and warnings about columns that cannot drive an effect."""

    drivers: tuple[Driver, ...]
    warnings: tuple[str, ...]


def find_drivers(
    recording: Recording,
    taken: frozenset[str],
    settings: DriverSettings,
    roles: frozenset[str] = frozenset(),
    measured: frozenset[str] = frozenset(),
) -> Drivers:
    """Return the drivers among a recording's columns.

    A column's role comes from its name (``temperature``, ``temp_imu``, ``current_2`` …) or its unit. Missing values
    are filled from their neighbours in time; a few values far from all others count as missing.

    Args:
        recording: the samples in use.
        taken: columns that the simulation uses itself.
        settings: which columns are drivers, and which values count as missing.
        roles: further roles, of a user's own effects: a column has such a role if its name is the role or begins with
            it.
        measured: columns that are compared with the simulation; a column that repeats one of them is no driver.

    Example:
        >>> ramp = torch.linspace(20.0, 30.0, 50)
        >>> columns = {"time": ramp, "temp_imu": ramp, "load": ramp.sin(), "state": torch.ones(50)}
        >>> found = find_drivers(Recording(columns), frozenset({"time"}), DriverSettings())
        >>> [(d.columns, d.role) for d in found.drivers], found.warnings
        ([(('temp_imu',), 'temperature'), (('load',), 'any')], ('Column `state` is constant and can drive nothing.',))
    """
    warnings: list[str] = []
    usable: dict[str, Tensor] = {}
    for name in recording.names:
        if name in taken or name == "experiment":
            continue
        values, complaint = _usable(name, recording[name], settings)
        repeated = None if values is None else _repeated(values, recording, measured, settings)
        if repeated is not None:
            values, complaint = (
                None,
                [Note(f"Column `{name}` repeats `{repeated}` and is left out: it drives nothing.")],
            )
        warnings += complaint
        if values is not None:
            usable[name] = values
    drivers = []
    if all(name in usable for name in _POSITION):
        columns = torch.stack([usable.pop(name) for name in _POSITION], -1)
        drivers.append(_driver(_POSITION, "position", columns, tuple(recording.units[n] for n in _POSITION)))
    known = {name: _own_role(name, roles) or role_of(name, recording.units[name]) for name in usable}
    drivers += _singles(usable, recording.units, known, warnings)
    return Drivers(tuple(drivers), tuple(warnings))


def _driver(
    columns: tuple[str, ...], role: str, values: Tensor, units: tuple[str, ...], copies: tuple[str, ...] = ()
) -> Driver:
    reference = values.mean(0)
    return Driver(columns, role, values - reference, reference, units, copies)


def input_drivers(prepared: PreparedSimulation) -> tuple[Driver, ...]:
    """Return the inputs of a simulation that vary, as drivers of effects that inputs can drive."""
    names = [name.removeprefix("input ") for name, port in prepared.ports.items() if port.kind == "input"]
    known = prepared.recording
    return tuple(
        _driver((name,), role_of(name, known.units[name]), known[name].unsqueeze(-1), (known.units[name],))
        for name in names
        if name in known and float(known[name].amax()) > float(known[name].amin())
    )


def role_of(name: str, unit: str) -> str:
    """Return the role of a column by its name's first word, else by its unit.

    Example:
        >>> role_of("temperature", "°C"), role_of("esc_power", "A"), role_of("current_3", ""), role_of("rpm", "")
        ('temperature', 'current', 'current', 'any')
    """
    return _ROLE_OF_NAME.get(name.lower().split("_")[0]) or _ROLE_OF_UNIT.get(unit, ANY)


def _own_role(name: str, roles: frozenset[str]) -> str:
    """Return the longest role of a user's effects that the column's name begins with; empty without such a role."""
    fitting = [role for role in roles - {ANY, "position", INPUT, PAIR} if (name == role or name.startswith(f"{role}_"))]
    return max(fitting, key=len, default="")


def _usable(name: str, values: Tensor, settings: DriverSettings) -> tuple[Tensor | None, list[str]]:
    finite = values.isfinite()
    share = float(finite.double().mean())
    if share < settings.fewest_finite:
        found = "no finite values" if share == 0 else f"only {share:.0%} finite values"
        return None, [Note(f"Column `{name}` has {found} and is left out.")]
    warnings: list[str] = []
    if share < 1.0:
        lacking = f"Column `{name}` lacks {int((~finite).sum())} values, filled from their neighbours in time."
        warnings.append(note_if_few(lacking, int((~finite).sum()), len(values)))
        values = _filled(values, finite)
    wild = _wild(values, settings)
    if bool(wild.any()):
        first, last = (f"{float(end):.6g}" for end in torch.aminmax(values[wild]))
        values_text = first if first == last else f"between {first} and {last}"
        warnings.append(
            f"Column `{name}` has {int(wild.sum())} value{'s' if int(wild.sum()) > 1 else ''} ({values_text}) far from "
            "all others; they count as missing, and are filled from their neighbours in time."
        )
        values = _filled(values, ~wild)
    spread = float(values.amax() - values.amin())
    if spread <= 1e-12 * float(values.abs().amax()):
        return None, [*warnings, Note(f"Column `{name}` is constant and can drive nothing.")]
    return values, warnings


def _wild(values: Float[Tensor, " N"], settings: DriverSettings) -> Bool[Tensor, " N"]:
    """Mark a few values far from all others that are short glitches, or all equal, as a code for "no value" is."""
    few = max(int(settings.wild_share * len(values)), 1)
    ordered = values.sort().values
    span = ordered[-1 - few] - ordered[few]
    far = (values - ordered[len(values) // 2]).abs() > settings.wild * span
    if not bool(span > 0) or not 0 < int(far.sum()) <= few:
        return torch.zeros_like(far)
    _, length = torch.unique_consecutive(far, return_counts=True)
    runs = length[int(not bool(far[0])) :: 2]
    same = bool((values[far] == values[far][0]).all())
    return far if same or int(runs.max()) <= settings.wild_in_a_row else torch.zeros_like(far)


def _repeated(
    values: Float[Tensor, " N"], recording: Recording, measured: frozenset[str], settings: DriverSettings
) -> str | None:
    """Return the measured column that equals these values except for offset, gain and rounding, or None."""
    unit = _centred(values)
    for name in sorted(measured):
        if name in recording and bool(recording[name].isfinite().all()):
            other = _centred(recording[name])
            if abs(float(unit @ other)) > settings.repeats:
                return name
    return None


def _centred(values: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    away = values - values.mean()
    return away / torch.linalg.vector_norm(away).clamp(min=1e-300)


def _filled(values: Tensor, finite: Tensor) -> Tensor:
    known = finite.nonzero().squeeze(-1)
    index = torch.arange(len(values))
    right = torch.searchsorted(known, index).clamp(max=len(known) - 1)
    left = (right - (known[right] > index).long()).clamp(min=0)
    a, b = known[left], known[right]
    share = ((index - a).double() / (b - a).clamp(min=1)).clamp(0.0, 1.0)
    return torch.lerp(values[a], values[b], share)


def _singles(
    usable: Mapping[str, Tensor], units: Mapping[str, str], roles: Mapping[str, str], warnings: list[str]
) -> list[Driver]:
    """Return one driver for each group of columns that are copies; a member with a known role represents it."""
    if not usable:
        return []
    names = sorted(usable, key=lambda name: roles[name] == ANY)
    table = torch.stack([usable[name] for name in names])
    centred = table - table.mean(-1, keepdim=True)
    centred = centred / torch.linalg.vector_norm(centred, dim=-1, keepdim=True)
    same = (centred @ centred.mT).abs() > 1.0 - COPY
    drivers, done = [], set()
    for i, name in enumerate(names):
        if i in done:
            continue
        group = [j for j in same[i].nonzero().squeeze(-1).tolist() if j >= i and j not in done]
        done.update(group)
        copies = tuple(names[j] for j in group if j != i)
        if copies:
            names_text = ", ".join(f"`{copy}`" for copy in copies)
            warnings.append(
                f"Column `{name}` and {names_text} are copies of one another: inseparable in this recording."
            )
        drivers.append(_driver((name,), roles[name], usable[name].unsqueeze(-1), (units[name],), copies))
    order = {name: k for k, name in enumerate(usable)}
    return sorted(drivers, key=lambda d: order[d.columns[0]])


Key = tuple[str, tuple[str, ...], str]
"""Identity of a candidate without its shape: the effect's ``form_id``, its columns and its port."""


@dataclass(frozen=True)
class Term:
    """An effect with its driver (None for time or the signal alone), its shape, and its port if it has a choice.

    ``first``: it acts before the effects with memory at its port; by default effects with memory act first.
    """

    effect: Effect
    driver: Driver | None
    shape: Shape
    at: str = ""
    first: bool = False

    @property
    def columns(self) -> tuple[str, ...]:
        return () if self.driver is None else self.driver.columns

    @property
    def port(self) -> str:
        """The port where it acts."""
        return self.at or self.effect.port

    @property
    def key(self) -> Key:
        """Identity without the shape."""
        return self.effect.form_id, self.columns, self.port

    @property
    def family(self) -> Key:
        """Identity without the shape, the same for a common size and for a size of each recording."""
        return self.effect.id, self.columns, self.port

    def context(self, prepared: PreparedSimulation, signal: Tensor | None) -> Context:
        """Return the context in which the effect is evaluated."""
        port = prepared.ports[self.port]
        time = prepared.time if port.clock is None else port.clock.time
        values = time.new_zeros(len(time), 0) if self.driver is None else port.at(self.driver.values)
        if signal is None:
            signal = time.new_zeros(len(time), len(port.channels))
        return context_at(port, time, values, self.driver, signal)

    def size(self, context: Context) -> int:
        return sum(quantity.size for quantity in self.effect.quantities(self.shape, context))


def context_at(port: Port, time: Tensor, values: Tensor, driver: Driver | None, signal: Tensor) -> Context:
    """Return the context of an effect at a port; the values are those of the driver, less its reference."""
    return Context(
        time,
        values,
        () if driver is None else driver.units,
        signal,
        port.unit,
        port.channels,
        port.carries,
        port.parts,
        port.part_units,
        port.run,
        () if driver is None else tuple(driver.reference.tolist()),
        () if driver is None else driver.columns,
    )


def continuous(term: Term) -> list[str]:
    """Return the names of a candidate's shape numbers that are refined."""
    return [name for name in term.shape if name in term.effect.continuous]


T = TypeVar("T")


def run_parallel(
    works: Sequence[Callable[[], T]], prepared: PreparedSimulation, terms: Sequence[Term] = (), thing: str = ""
) -> list[T]:
    """Return the results of functions, in their order.

    Args:
        works: independent functions.
        prepared, terms: a simulation and effects that results may hold.
        thing: name of the items that progress counts.
    """
    return shared(works, common_parts(prepared, terms), thing)


def common_parts(prepared: PreparedSimulation, terms: Sequence[Term]) -> list[object]:
    """Return the parts of a simulation and its effects that every process holds and that need not be sent."""
    return [prepared, *(part for term in terms for part in (term.effect, term.driver) if part is not None)]

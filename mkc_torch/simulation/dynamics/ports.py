"""Ports of differential equations, where effects act: rates, exchanges, inputs, their entries, parameters, outputs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.kinds import CELSIUS, kind_of
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.entries import entries
from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.surroundings import surroundings
from mkc_torch.simulation.dynamics.varying import varying_parameters
from mkc_torch.simulation.parameter import Parameter
from mkc_torch.simulation.ports import Port, SignalSizes, SignalTimes

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_MEMORIES: Mapping[str, Mapping[str, bool]] = {
    "hysteretic rate": {"memory_of": False},
    "lagged rate": {"lagged": True},
    "resonant rate": {"deflection_of": False, "hidden": True},
}
"""Internal states by kind of port: name prefix, and whether they start at the state's value or at 0."""

RATES = ("rate", "loaded rate", *_MEMORIES, "exchange")
"""Kinds of ports at which an effect adds to rates of change."""

ENTRY = "entry"
"""Kind of the ports where effects of a rate add to an input, which moves several rates."""

_ENTRY_OF = {kind: kind.replace("rate", ENTRY) for kind in _MEMORIES}

ENTRIES = (ENTRY, *_ENTRY_OF.values())
"""Kinds of ports at which an effect that depends on states adds to an input."""

_REVERSED = 0.05
"""Share of the recording for which a state must be positive, and negative, to count as reversing."""

_HEIGHTS = ("height", "altitude", "elevation", "heave", "z")
"""Names of positions that are heights."""


@dataclass(frozen=True)
class PortContext:
    """The properties of a system and its recording that its ports depend on.

    Attributes:
        system: the equations.
        recording: the recording.
        channels: the columns that are outputs.
        known: the parameters.
        kinematic: state whose rate is another state, to that state.
        guess: (N, n), a first guess of the states at the samples.
        clock: the times at which rates and inputs are computed.
        run: (N,), number of each sample's run.
    """

    system: Equations
    recording: Recording
    channels: tuple[str, ...]
    known: Mapping[str, Parameter]
    kinematic: Mapping[str, str]
    guess: Float[Tensor, "N n"]
    clock: SignalTimes
    run: Int[Tensor, " N"]

    def ports(self) -> dict[str, Port]:
        """The ports: rates, exchanges of states of a unit, inputs, their entries, constants, parameters, and outputs.

        Where an input moves one rate only, an effect at its entry would be the same as at the rate, and has no port.
        """
        system = self.system
        places = {}
        steps = system.steps
        forces, constants = ({}, ()) if steps is None else (steps.forces, steps.constants)
        without = (*forces, *constants, *(() if steps is None else steps.followed))
        free = [state for state in system.states if state not in self.kinematic and state not in forces.values()]
        for state in free:
            parts = self._parts(state)
            rate = {"rate": f"rate of {state}"} if "position" in parts else {}
            places[f"rate of {state}"] = self._rate_port(state, "rate", {**parts, **rate})
            if "position" in parts and system.inputs:
                places[f"loaded rate of {state}"] = self._rate_port(state, "loaded rate", {**parts, "load": "load"})
            for kind in self._remembering(parts):
                port = self._rate_port(state, kind, parts)
                places[f"{kind} of {state}"] = replace(port, memory=memory_at(kind, state))
        pairs = [
            (first, second) for first, second in combinations(free, 2) if self._unit_of(first) == self._unit_of(second)
        ]
        for first, second in pairs:
            sideways = {"sideways": second} if self._is_way(first) and self._is_way(second) else {}
            both = "level" in self._parts(first) and "level" in self._parts(second)
            levels = {"level": first, "other level": second} if both else {}
            port = self._rate_port(first, "exchange", {"own": first, "other": second, **sideways, **levels})
            places[f"exchange of {first} and {second}"] = replace(port, channels=(first, second))
        for name in (name for name in system.inputs if name not in without):
            actuator = {} if name in self._surroundings.values() else {"actuator": name}
            pace = self._pace_of(name)
            changing = {"pace": name} if pace.largest > 0.0 else {}
            places[f"input {name}"] = Port(
                (name,),
                self._unit_of(name),
                pointwise=False,
                kind="input",
                parts={"own": name, **changing, **actuator},
                part_units={"own": self._unit_of(name), "pace": per_second(self._unit_of(name))},
                sizes={"own": SignalSizes.of(self.recording[name]), "pace": pace},
                clock=self.clock,
                run=self.run[self.clock.before],
            )
        for name, speed in self._entries().items():
            places[f"entry of {name}"] = self._entry_port(name, speed, "rate")
            # elsewhere the rates have these effects
            for kind in self._remembering(self._parts(speed)) if name in forces else ():
                port = self._entry_port(name, speed, kind)
                places[f"{port.kind} of {name}"] = replace(port, memory=memory_at(kind, speed))
        for name in constants:
            parts, unit = {"own": name}, self._unit_of(name)
            places[f"constant {name}"] = Port(
                (name,),
                unit,
                pointwise=False,
                kind="constant",
                parts=parts,
                part_units={"own": unit},
                clock=self.clock,
                run=self.run[self.clock.before],
            )
        for name in varying_parameters(system):
            known = self.known[name]
            places[f"parameter {name}"] = Port(
                (name,),
                known.unit,
                pointwise=False,
                kind="parameter",
                parts={"own": name},
                part_units={"own": known.unit},
                sizes={"own": SignalSizes(*(abs(known.value),) * 2, known.value, known.value)},
                clock=self.clock,
                run=self.run[self.clock.before],
            )
        for name in self.channels:
            unit = self._unit_of(name)
            parts = {"own": name} if system.steps is None else {"own": name, "stepped": name}
            places[f"output {name}"] = Port(
                (name,),
                unit,
                pointwise=False,
                kind="single output",
                parts=parts,
                part_units=dict.fromkeys(parts, unit),
                run=self.run,
            )
        parts = {"own": self.channels[0], **{f"output {name}": name for name in self.channels[1:]}}
        if self.system.inputs and self.system.restart_after is None:
            parts["driven"] = self.channels[0]
        units = {part: self._unit_of(name) for part, name in parts.items()}
        unit = common_unit(self._unit_of(name) for name in self.channels)
        output = Port(self.channels, unit, pointwise=False, parts=parts, part_units=units, run=self.run)
        return places | {"output": output}

    def _entries(self) -> dict[str, str]:
        """Inputs that move several rates, to the state that is the speed there; inputs of the surroundings left out."""
        found = entries(self.system, self.known, self.kinematic)
        return {name: speed for name, speed in found.items() if name not in self._surroundings.values()}

    def _entry_port(self, name: str, speed: str, stands_for: str) -> Port:
        parts = {part: of for part, of in self._parts(speed).items() if part != "surroundings"}
        port = self._rate_port(speed, _ENTRY_OF.get(stands_for, ENTRY), parts)
        return replace(port, channels=(name,), unit=self._unit_of(name), stands_for=stands_for)

    def _remembering(self, parts: Mapping[str, str]) -> tuple[str, ...]:
        """Kinds of ports with internal states at the rate of a state with these parts."""
        if self.system.restart_after is not None:
            return ()  # each segment of a run would start without the memory of the segment before
        needs = {"hysteretic rate": "position", "lagged rate": "own", "resonant rate": "flowing"}
        return tuple(kind for kind, part in needs.items() if part in parts)

    def _parts(self, state: str) -> dict[str, str]:
        """Signals by role that an effect on the rate of a state can refer to."""
        positions = [i for i, j in self.kinematic.items() if j == state]
        parts = {"own": state, **({"position": positions[0]} if positions else {})}
        if positions and self._unit_of(positions[0]) == "rad":
            parts["angle"] = positions[0]
        if positions and self._reverses(positions[0]):
            parts["deflection"] = positions[0]
        if positions and positions[0].lower().split("_")[0] in _HEIGHTS:
            parts["height"] = positions[0]
        if self._reverses(state):
            parts["reversing"] = state
        if state in self._surroundings:
            parts["surroundings"] = self._surroundings[state]
        if (unit := self._unit_of(state)) in (*CELSIUS, "K"):
            parts["temperature"] = state
        elif kind_of(unit, state) != "temperature":
            parts["flowing"] = state
            if not positions:
                parts["level"] = state
        return parts

    def _is_way(self, state: str) -> bool:
        """Whether a state is a linear speed, judged by names and units."""
        positions = [i for i, j in self.kinematic.items() if j == state]
        return self._unit_of(state) == "m/s" or (bool(positions) and self._unit_of(positions[0]) not in ("rad", "°"))

    def _reverses(self, state: str) -> bool:
        """Whether a state has either sign for more than ``_REVERSED`` of the recording, by the first guess."""
        values = self.guess[:, self.system.states.index(state)]
        return min(float((values > 0).double().mean()), float((values < 0).double().mean())) > _REVERSED

    def _rate_port(self, state: str, kind: str, parts: Mapping[str, str]) -> Port:
        unit = self._unit_of(state)
        return Port(
            (state,),
            per_second(unit),
            pointwise=False,
            kind=kind,
            carries=(*self.system.states, *self.system.inputs, *(parts[of] for of in ("load", "rate") if of in parts)),
            parts=parts,
            part_units={part: self._unit_of(state if part == "surroundings" else name) for part, name in parts.items()},
            sizes=self._sizes(state, parts),
            clock=self.clock,
            run=self.run[self.clock.before],
        )

    @cached_property
    def _surroundings(self) -> dict[str, str]:
        return surroundings(self.system)

    def _sizes(self, state: str, parts: Mapping[str, str]) -> dict[str, SignalSizes]:
        """Sizes of the parts that are states; for the surroundings, of the state's difference to them."""
        values = dict(zip(self.system.states, self.guess.unbind(-1), strict=True))
        sizes = {part: SignalSizes.of(values[name]) for part, name in parts.items() if name in values}
        if "surroundings" in parts:
            sizes["surroundings"] = SignalSizes.of(values[state] - self.recording[parts["surroundings"]])
        return sizes

    def _pace_of(self, name: str) -> SignalSizes:
        """Sizes of the change per s of an input."""
        step = self.recording["time"].diff()
        within = (self.run.diff() == 0) & (step > 0.0)
        change = self.recording[name].diff()[within] / step[within]
        return SignalSizes.of(change) if len(change) else SignalSizes.of(step.new_zeros(1))

    def _unit_of(self, name: str) -> str:
        return self.system.units.get(name, self.recording.units[name] if name in self.recording else "")


def memory_at(kind: str, state: str) -> dict[str, str]:
    """Internal states at the rate of a state, or at an input with this speed, with the state that each starts equal to.

    An internal state without such a state starts at 0.

    Example:
        >>> memory_at("resonant rate", "speed"), memory_at("rate", "speed")
        ({'deflection_of_speed': '', 'hidden_speed': 'speed'}, {})
    """
    return {f"{name}_{state}": state if alike else "" for name, alike in _MEMORIES.get(kind, {}).items()}


def per_second(unit: str) -> str:
    """The unit of a rate.

    Example:
        >>> per_second("rad"), per_second("")
        ('rad/s', '1/s')
    """
    return f"{unit}/s" if unit else "1/s"


def common_unit(units: Iterable[str]) -> str:
    """The common unit; empty where units differ."""
    found = set(units)
    return found.pop() if len(found) == 1 else ""

"""Ports at the outputs of a simulation without states: a port for each output, and a port for all."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.context import SEVERAL
from mkc_torch.effects.kinds import kind_of
from mkc_torch.simulation.ports import Changes, Port, SignalSizes

if TYPE_CHECKING:
    from jaxtyping import Float, Int

ALL = "all outputs"
"""Name of the port of all outputs together, of kind "outputs"; the port of an output is named ``output NAME``."""


def output_ports(
    channels: Sequence[str],
    units: Mapping[str, str],
    unit: str,
    measured: Float[Tensor, "N m"],
    fixed: Collection[str] = (),
    unscaled: Collection[str] = (),
    run: Int[Tensor, " N"] | None = None,
) -> dict[str, Port]:
    """The ports of outputs.

    Args:
        channels: names of the outputs.
        units: unit of each output.
        unit: common unit; empty where the units differ.
        measured: the recorded outputs, for the sizes of the signals.
        fixed: outputs that no parameter of the simulation shifts; they have the part "fixed zero".
        unscaled: outputs that no parameter of the simulation scales; they have the part "fixed scale".
        run: number of each sample's run; None where the simulation has no runs.

    Example:
        >>> ports = output_ports(("angle",), {"angle": "rad"}, "rad", torch.ones(5, 1))
        >>> [(name, port.kind, port.unit) for name, port in ports.items()]
        [('all outputs', 'outputs', 'rad'), ('output angle', 'output', 'rad')]
    """
    angles = [_is_angle(name, units[name], measured[:, k]) for k, name in enumerate(channels)]
    alike = len(channels) > 1 and len({units[name] for name in channels}) == 1
    joined = dict.fromkeys([SEVERAL, *["angle"] * all(angles)], channels[0]) if alike else {}
    port = Port(tuple(channels), unit, allows_drift=True, kind="outputs", run=run)
    ports = {ALL: replace(port, parts=joined, part_units=dict.fromkeys(joined, unit))}
    for k, name in enumerate(channels):
        known = ["fixed zero"] * (name in fixed) + ["fixed scale"] * (name in unscaled) + ["angle"] * angles[k]
        parts = dict.fromkeys(("own", "compared", *known), name)
        ports[f"output {name}"] = Port(
            (name,),
            units[name],
            kind="output",
            parts=parts,
            part_units=dict.fromkeys(parts, units[name]),
            sizes={"own": SignalSizes.of(measured[:, k])},
            run=run,
        )
    return ports


def _is_angle(name: str, unit: str, values: Float[Tensor, " N"]) -> bool:
    """Whether an output is a joint angle: by its unit, or without a unit by its name and its range."""
    return kind_of(unit, name) == "angle" and (bool(unit) or float(values.abs().max()) <= _TURN)


_TURN = 6.3
"""Largest joint angle in rad of an output without a unit."""


def changed_outputs(outputs: Float[Tensor, "N m"], channels: Sequence[str], changes: Changes) -> Float[Tensor, "N m"]:
    """The outputs with the changes by effects: first at each output, then at all outputs."""
    outputs = _each_changed(outputs, channels, changes)
    return outputs + changes[ALL](outputs) if ALL in changes else outputs


def output_signals(
    outputs: Float[Tensor, "N m"], channels: Sequence[str], changes: Changes
) -> dict[str, Float[Tensor, "N k"]]:
    """The signals at the ports."""
    own = {f"output {name}": outputs[:, [k]] for k, name in enumerate(channels)}
    return {ALL: _each_changed(outputs, channels, changes)} | own


def _each_changed(outputs: Tensor, channels: Sequence[str], changes: Changes) -> Tensor:
    columns = [
        outputs[:, [k]] + changes[f"output {name}"](outputs[:, [k]]) if f"output {name}" in changes else outputs[:, [k]]
        for k, name in enumerate(channels)
    ]
    return torch.cat(columns, -1)

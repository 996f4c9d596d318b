"""Export of a simulation with its findings as Python source."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mkc_torch.diagnosis.model.joint import in_order_of_the_chain
from mkc_torch.effects.kinds import absolute_zero, zero_of
from mkc_torch.recording.recording import DEFAULT_UNITS
from mkc_torch.simulation.dynamics.definition import Dynamics
from mkc_torch.simulation.dynamics.entries import entries
from mkc_torch.simulation.dynamics.ports import memory_at
from mkc_torch.simulation.dynamics.surroundings import surroundings
from mkc_torch.simulation.dynamics.user_functions import kinematic
from mkc_torch.simulation.fmu import is_of_an_fmu
from mkc_torch.simulation.load import file_of
from mkc_torch.simulation.parameter import Parameter, known_parameters
from mkc_torch.simulation.stepped.mujoco.description import Description
from mkc_torch.simulation.stepped.mujoco.stepper import is_of_a_model

if TYPE_CHECKING:
    from torch import Tensor

    from mkc_torch.diagnosis.model.term import Term

_DIGITS = 9
"""Significant digits of a number in the source."""
_FROM_HERE: Mapping[str, str] = {
    "lagged(": "from mkc_torch.effects import lagged",
    "played(": "from mkc_torch.effects import played",
    "rate_limited(": "from mkc_torch.effects import rate_limited",
    "resampled(": "from mkc_torch.effects import resampled",
    "shifted(": "from mkc_torch.effects import shifted",
    "soft_clip(": "from mkc_torch.effects import soft_clip",
    "curve_within(": "from mkc_torch.effects import curve_within",
    "travelled(": "from mkc_torch.effects import travelled",
    "beyond(": "from mkc_torch.effects import beyond",
    "selected_size(": "from mkc_torch.effects import selected_size",
    "SimpleNamespace(": "from types import SimpleNamespace",
    "Parameter(": "from mkc_torch.simulation import Parameter",
}


class SourceError(ValueError):
    """The model cannot be exported as Python."""


def python_source(
    system: Dynamics,
    theta: Sequence[float],
    terms: Sequence[Term],
    gammas: Sequence[Tensor],
    measured: Sequence[str],
    holds: Mapping[str, str],
    module: str | None = None,
    folder: Path | None = None,
) -> str:
    """Return the source of a module with a class derived from the diagnosed class, see
    :meth:`DiagnosedModel.to_python`.

    Args:
        system: the diagnosed simulation.
        theta: its parameters, then the initial states, which only give guesses of internal states.
        terms, gammas: the effects.
        measured: names of the measured outputs.
        holds: what each input does between samples; a class has a single hold, so different ones are not exported.
        module: to import the diagnosed class from.
        folder: of the written file, if known.
    """
    kind = type(system)
    rates: list[str] = []
    memories = {name: like for term in terms for name, like in _memories(term, system).items()}
    inputs: list[str] = []
    entering: list[str] = []
    outputs: list[str] = []
    varied: list[str] = []
    single: list[str] = []
    for number in in_order_of_the_chain(terms, range(len(terms))):
        term, gamma = terms[number], gammas[number]
        lines = _lines(term, [_rounded(float(value)) for value in gamma], system, measured)
        kinds = {"output": outputs, "input": inputs, "constant": inputs, "entry": entering, "parameter": varied}
        place = kinds.get(term.port.partition(" ")[0], rates)
        place = single if term.port.startswith("output ") else place
        if " entry of " in term.port:  # the force acts at the input, and its internal states have rates
            rates += [f"# {term.effect.id}: {term.effect.equation}", *lines[1:], *_over_a_step(term, system)]
            place, lines = entering, lines[:1]
        if place is outputs and outputs:
            place.append("y = dict(shown)")  # the next effect acts on these outputs
        place += [f"# {term.effect.id}: {term.effect.equation}", *lines]
    label = ", ".join(term.effect.display_name for term in terms) or "nothing more"
    body = [
        f"class Corrected{kind.__name__}({kind.__name__}):",
        f'    """{kind.__name__} with fitted parameters, and {label}."""',
        "",
        "    parameters = {",
        *(f"        {line}" for line in _parameters(system, theta)),
        "    }",
        *_sizes_of(terms),
        *_inputs(system, terms),
        *_hold(system, holds),
        *_restarts(system),
        *_states(system, memories, theta),
        *_varied(varied),
        *_output(single, varied),
        *_actuator(inputs, varied, own=kind.actuator is not Dynamics.actuator, columns=bool(_inputs(system, terms))),
        *_entering(entering),
        *_derivative(memories, rates, "self.entering(time, x, u, p)" if entering else "u", varied),
        *_sensor(outputs),
    ]
    text = "\n".join(body)
    loaded = None if module else _loaded(kind, folder)
    base = loaded or f"from {module or kind.__module__.removeprefix('_simulation_')} import {kind.__name__}"
    # order of imports: standard library, torch, this package, the user's file
    used = [line for name, line in _FROM_HERE.items() if name in text]
    first = [line for line in used if "mkc_torch" not in line]
    own = sorted([line for line in used if "mkc_torch" in line] + [_of_class(loaded)] * bool(loaded))
    torch = ["import torch"] if "torch." in text else []
    groups = [first, [*torch, *own], [base]]
    imports = "\n\n".join("\n".join(group) for group in groups if group)
    return (
        f'"""{kind.__name__}, with the findings of `mkc diagnose`; all numbers were fitted to its recording."""\n\n'
        f"{imports}\n\n\n{text}\n\n\n{_alone(kind)}"
    )


def _alone(kind: type) -> str:
    """Return the lines for `python corrected.py NEW.csv`."""
    return (
        'if __name__ == "__main__":\n'
        "    from mkc_torch.diagnosis.validation.alone import run_alone\n\n"
        f"    run_alone(Corrected{kind.__name__})\n"
    )


def _of_class(line: str | None) -> str:
    name = next((name for name in ("fmu_class", "mjcf_class") if f" = {name}(" in (line or "")), "base_class")
    return f"from mkc_torch.simulation import {name}"


def _loaded(kind: type, folder: Path | None) -> str | None:
    """Return a line that loads a class from its file, by a relative path; None without such a file or path.

    With a relative path, both files can be moved together.
    """
    file: Path | None
    if is_of_an_fmu(kind):
        of_a_model, file = "fmu_class", kind.evaluation.description.path
    elif is_of_a_model(kind):
        of_a_model, file = "mjcf_class", kind.description.path
    else:
        of_a_model, file = "", file_of(kind)
    if file is None or (folder is None and not of_a_model):
        return None
    try:
        way = Path(file.name if folder is None else os.path.relpath(file.resolve(), folder.resolve())).as_posix()
    except ValueError:  # on another drive
        return None
    if of_a_model:
        chosen = _chosen(kind.description) if is_of_a_model(kind) else ""
        return f"{kind.__name__} = {of_a_model}({json.dumps(way, ensure_ascii=False)}, __file__{chosen})"
    return f"{kind.__name__} = base_class({json.dumps(f'{way}:{kind.__name__}', ensure_ascii=False)}, __file__)"


def _chosen(model: Description) -> str:
    """Return the arguments that choose the numbers and joints of a MuJoCo model."""
    fitted = f", fitted={model.fitted!r}" if model.fitted else ""
    return fitted if model.whole is None else f"{fitted}, joints={tuple(model.positions)!r}"


def _parameters(system: Dynamics, theta: Sequence[float]) -> list[str]:
    lines = []
    for (name, parameter), value in zip(system.parameters.items(), theta, strict=False):
        number = repr(_rounded(value))
        if isinstance(parameter, Parameter):
            sentences = [
                f"{key}={json.dumps(known, ensure_ascii=False)}"
                for key, known, free in (
                    ("lower", parameter.lower, -float("inf")),
                    ("upper", parameter.upper, float("inf")),
                    ("unit", parameter.unit, ""),
                )
                if known != free
            ]
            number = f"Parameter({', '.join([number, *sentences])})"
        lines.append(f'"{name}": {number},')
    return lines


def _sizes_of(terms: Sequence[Term]) -> list[str]:
    """Return the line that selects the recording whose sizes apply, where sizes differ between recordings."""
    names = next((term.effect.recordings for term in terms if term.effect.recordings), ())
    return [f'    sizes_of = ""  # set to the recording whose sizes apply: {", ".join(map(repr, names))}'] * bool(names)


def _inputs(system: Dynamics, terms: Sequence[Term]) -> list[str]:
    """Return the line of the inputs with the columns that drive the effects."""
    columns = dict.fromkeys(column for term in terms for column in term.columns)
    new = [json.dumps(column, ensure_ascii=False) for column in columns if column not in system.inputs]
    return [f"    inputs = (*{type(system).__name__}.inputs, {', '.join(new)})"] if new else []


def _hold(system: Dynamics, holds: Mapping[str, str]) -> list[str]:
    """Return the line of the inputs' hold, if the diagnosis chose another than that of the class."""
    chosen = set(holds.values())
    return [f'    input_hold = "{chosen.pop()}"'] if len(chosen) == 1 and chosen != {system.input_hold} else []


def _restarts(system: Dynamics) -> list[str]:
    """Return the line of the restarts, if the diagnosis chose them."""
    chosen = system.restart_after
    return [f"    restart_after = {chosen!r}"] if chosen != type(system).restart_after else []


def _states(system: Dynamics, memories: Mapping[str, str], theta: Sequence[float]) -> list[str]:
    """Return the lines of states with the effects' internal states, and guesses of their initial values."""
    base, first = type(system).__name__, theta[len(system.parameters) :]
    guesses: dict[str, float] = {}
    for name, like in memories.items():
        begun = first[system.states.index(like) :: len(system.states)] if like else ()
        guesses |= {name: sum(begun) / len(begun)} if begun else {}
    text = ", ".join(json.dumps(name) for name in memories)
    lines = [f"    states = (*{base}.states, {text})"] if memories else []
    tied = ", ".join(f"{json.dumps(name)}: {json.dumps(like)}" for name, like in memories.items())
    lines += [f"    starts_as = {{**{base}.starts_as, {tied}}}"] if memories else []
    guessed = ", ".join(f"{json.dumps(name)}: {_rounded(value)!r}" for name, value in guesses.items())
    return [*lines, f"    initial = {{**{base}.initial, {guessed}}}"] if guessed else lines


def _varied(varied: list[str]) -> list[str]:
    """Return the method of the parameters that effects change."""
    if not varied:
        return []
    lines = ["p = SimpleNamespace(**vars(p))", *varied, "return p"]
    return ["", "    def varied(self, u, p):", *(f"        {line}" for line in lines)]


def _output(single: list[str], varied: list[str]) -> list[str]:
    """Return the method of the outputs, with effects on parameters and on single outputs."""
    if not single and not varied:
        return []
    plain = f"super().output(time, x, u, {'self.varied(u, p)' if varied else 'p'})"
    lines = [f"shown = dict({plain})", *single, "return shown"] if single else [f"return {plain}"]
    return ["", "    def output(self, time, x, u, p):", *(f"        {line}" for line in lines)]


def _actuator(inputs: list[str], varied: list[str], *, own: bool, columns: bool) -> list[str]:
    """Return the method of the acting inputs.

    Args:
        inputs, varied: lines of the effects on inputs and on parameters.
        own: whether the class has an actuator of its own, which may depend on parameters.
        columns: whether there are new inputs, which it would not return.
    """
    if not inputs and not (own and (varied or columns)):
        return []
    p = "self.varied(u, p)" if varied else "p"
    u = "acting" if inputs else "u"
    acting = ["acting = SimpleNamespace(**vars(u))", *inputs] if inputs else []
    found = f"super().actuator(time, {u}, {p}, run)"
    lines = [*acting, f"return {{**vars({u}), **{found}}}" if own and columns else f"return {found}"]
    return ["", "    def actuator(self, time, u, p, run):", *(f"        {line}" for line in lines)]


def _entering(entering: list[str]) -> list[str]:
    if not entering:
        return []
    lines = ["acting = SimpleNamespace(**vars(u))", *entering, "return acting"]
    return ["", "    def entering(self, time, x, u, p):", *(f"        {line}" for line in lines)]


def _derivative(memories: Mapping[str, str], rates: list[str], acting: str, varied: list[str]) -> list[str]:
    p = "self.varied(u, p)" if varied else "p"
    if not rates and (varied or acting != "u"):
        return [
            "",
            "    def derivative(self, time, x, u, p):",
            f"        return super().derivative(time, x, {acting}, {p})",
        ]
    if not rates:
        return []
    still = [f'rates["{name}"] = torch.zeros_like(x.{name})' for name in memories]
    return [
        "",
        "    def derivative(self, time, x, u, p):",
        *(f"        {line}" for line in ["rates = self.plain_rates(time, x, u, p)", *still, *rates, "return rates"]),
        "",
        "    def plain_rates(self, time, x, u, p):",
        f"        rates = super().derivative(time, x, {acting}, {p})",
        '        return dict(rates) if hasattr(rates, "keys") else dict(zip(self.states, rates))',
    ]


def _sensor(outputs: list[str]) -> list[str]:
    if not outputs:
        return []
    lines = ["y = super().sensor(time, y, p, run)", "shown = dict(y)", *outputs, "return shown"]
    return ["", "    def sensor(self, time, y, p, run):", *(f"        {line}" for line in lines)]


def _memories(term: Term, system: Dynamics) -> dict[str, str]:
    """Return an effect's internal states, each with the state that gives its initial value; empty for 0."""
    kind, _, place = term.port.rpartition(" of ")
    return memory_at(term.effect.port, _speed_at(place, system)) if "entry" in kind else memory_at(kind, place)


def _over_a_step(term: Term, system: Dynamics) -> list[str]:
    """Return the line by which a deflection moves with the speeds at the end of a step."""
    if not term.port.startswith("resonant") or system.steps is None:
        return []
    deflection, speed = (f'rates["{name}"]' for name in _memories(term, system))
    own = _speed_at(term.port.rpartition(" of ")[2], system)
    return [f'{deflection} = {deflection} + self.time_step * ({speed} - rates["{own}"])']


def _speed_at(name: str, system: Dynamics) -> str:
    """Return the state that is the speed at an input."""
    known = known_parameters(system.name, system.parameters)
    return entries(system, known, kinematic(system, known))[name]


def _lines(term: Term, gamma: Sequence[float], system: Dynamics, measured: Sequence[str]) -> list[str]:
    """Return assignments that add an effect at its port."""
    if not term.effect.has_code:
        raise SourceError(f"{term.effect.id} cannot be exported as Python: it has no `code` method.")
    if not all(column.isidentifier() for column in term.columns):
        raise SourceError(
            f"{term.effect.id} cannot be exported as Python: its column {term.columns[0]!r} is no name in Python; "
            "rename the column."
        )
    shape = {name: _rounded(value) for name, value in term.shape.items()}
    before: list[str] = []
    if "rate of " in term.port:
        state = term.port.rpartition("rate of ")[2]
        memories = _memories(term, system)
        targets = [f'rates["{name}"]' for name in (state, *memories)]
        names = _parts(state, system) | _numbered([f"x.{name}" for name in memories])
        before = _load(state) if term.port.startswith("loaded") else []
    elif term.port.startswith("exchange of "):
        first, _, other = term.port.removeprefix("exchange of ").partition(" and ")
        targets = [f'rates["{first}"]', f'rates["{other}"]']
        names = {"own": f"x.{first}", "other": f"x.{other}"}
    elif "entry of " in term.port:
        name, memories = term.port.rpartition("entry of ")[2], _memories(term, system)
        targets = [f"acting.{name}", *(f'rates["{memory}"]' for memory in memories)]
        names = _parts(_speed_at(name, system), system) | _numbered([f"x.{memory}" for memory in memories])
    elif term.port.startswith(("input ", "constant ")):
        name = term.port.partition(" ")[2]
        targets, names = [f"acting.{name}"], {"own": f"acting.{name}"}
    elif term.port.startswith("output "):
        name = term.port.removeprefix("output ")
        targets, names = [f'shown["{name}"]'], {"own": f'shown["{name}"]'}
    elif term.port.startswith("parameter "):
        name = term.port.removeprefix("parameter ")
        targets, names = [f"p.{name}"], {"own": f"p.{name}"}
    else:
        targets, names = [f'shown["{name}"]' for name in measured], {name: f'y["{name}"]' for name in measured}
    added = term.effect.code(gamma, shape, {**names, **_driver_names(term, names)})
    each = zip(targets, added, strict=False)
    return [*before, *(f"{target} = {target} {_signed(expression)}" for target, expression in each)]


def _signed(expression: str) -> str:
    return f"- {expression[1:]}" if expression.startswith("-") else f"+ {expression}"


def _parts(state: str, system: Dynamics) -> dict[str, str]:
    """Return expressions of the quantities that an effect on a rate uses."""
    rates = kinematic(system, known_parameters(system.name, system.parameters))
    position = next((name for name, rate in rates.items() if rate == state), state)
    zero = zero_of(system.units.get(state, DEFAULT_UNITS.get(state, "")))
    return {
        "own": f"x.{state}",
        **dict.fromkeys(("position", "angle", "deflection"), f"x.{position}"),
        "surroundings": f"u.{surroundings(system).get(state, '')}",
        "load": "load",
        "rate": f'self.plain_rates(time, x, u, p)["{state}"]',
        "zero": repr(zero),
    }


def _driver_names(term: Term, names: Mapping[str, str]) -> dict[str, str]:
    """Return expressions of an effect's driver, less its mean and as recorded."""
    if term.driver is None:
        return {}
    recorded, mean = f"u.{term.driver.columns[0]}", _rounded(float(term.driver.reference[0]))
    absolute = absolute_zero(term.driver.units[0], mean)
    return {
        "recorded": recorded,
        "mean": repr(mean),
        "absolute_mean": repr(_rounded(mean + absolute)),
        "driver": f"({recorded} - {mean!r})" if mean >= 0 else f"({recorded} + {-mean!r})",
        "zero_of_driver": repr(zero_of(term.driver.units[0])) if term.driver.units[0] else names.get("zero", "0.0"),
    }


def _numbered(memories: Sequence[str]) -> dict[str, str]:
    """Return expressions of internal states: memory, memory_2, ..."""
    return {"memory" if k == 0 else f"memory_{k + 1}": memory for k, memory in enumerate(memories)}


def _load(state: str) -> list[str]:
    """Return lines that compute the load: the inputs' effect at this speed, relative to standstill without inputs."""
    return [
        f'still = SimpleNamespace(**{{**vars(x), "{state}": torch.zeros_like(x.{state})}})',
        "idle = SimpleNamespace(**{name: torch.zeros_like(value) for name, value in vars(u).items()})",
        f'coasting = self.plain_rates(time, x, idle, p)["{state}"]',
        f'held = self.plain_rates(time, still, idle, p)["{state}"]',
        f'load = (self.plain_rates(time, x, u, p)["{state}"] - coasting - held).abs()',
    ]


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")

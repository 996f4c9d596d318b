"""The content of an FMU's modelDescription.xml that a diagnosis needs."""

from __future__ import annotations

import math
import re
import tempfile
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mkc_torch.simulation.fmu.units import unit_of
from mkc_torch.simulation.parameter import Parameter

_REAL = ("Real", "Float64")
_EXTRA = 'FMUs are read by FMPy, which is not installed; install it with `pip install "mkc-torch[fmu]"`.'


class FmuError(ValueError):
    """An FMU that cannot be used; the message states why, and the remedy."""


@dataclass(frozen=True)
class FmuVariable:
    """A real variable of an FMU.

    Attributes:
        name: name as a Python identifier.
        label: name in the FMU, such as "body.phi[1]".
        reference: value reference in the FMU.
        unit: unit in the notation of this package.
    """

    name: str
    label: str
    reference: int
    unit: str


@dataclass(frozen=True)
class Description:
    """The description of an FMU for model exchange, or for co-simulation only.

    Attributes:
        path: path of the file.
        version: version of FMI, 2 or 3.
        name: name of the model, as an identifier.
        token, identifier: GUID and model identifier, by which its binary is instantiated and found.
        exchange: whether it is for model exchange; otherwise it contains its tool's solver.
        states, inputs, outputs: the continuous real variables.
        rates: the derivatives of the states, in the same order.
        parameters: the fixed and tunable parameters, with start values and bounds.
        events: number of event indicators.
        derivatives: whether it has directional derivatives.
        timeless: whether it declares the dependencies of all rates and outputs, and none depends on time.
    """

    path: Path
    version: int
    name: str
    token: str
    identifier: str
    exchange: bool
    states: tuple[FmuVariable, ...]
    rates: tuple[FmuVariable, ...]
    inputs: tuple[FmuVariable, ...]
    outputs: tuple[FmuVariable, ...]
    parameters: Mapping[FmuVariable, Parameter]
    events: int
    derivatives: bool
    timeless: bool


def the_library() -> Any:
    """The module fmpy.

    Raises:
        ImportError: FMPy is not installed.
    """
    try:
        import fmpy
    except ImportError as error:
        raise ImportError(_EXTRA) from error
    return fmpy


def read_description(path: Path) -> Description:
    """Read the description of an FMU.

    Raises:
        FmuError: no such file, a damaged file, an unsupported version of FMI, no equations, or parameters without start
            values.
        ImportError: FMPy is not installed.
    """
    model = _read(path)
    version = int(model.fmiVersion.partition(".")[0])
    kind = model.modelExchange or model.coSimulation
    if kind is None:
        raise FmuError(
            f"{path}: this FMU is for scheduled execution only; export it for model exchange, or for co-simulation."
        )
    exchange = model.modelExchange is not None
    variables = model.modelVariables
    names = _names([variable for variable in variables if variable.type in _REAL])
    rates = [unknown.variable for unknown in model.derivatives if unknown.variable is not None]
    states = [rate.derivative for rate in rates]
    if exchange and not states:
        raise FmuError(
            f"{path}: this FMU has no continuous states, so there is no differential equation in it; let its tool "
            "simulate the recording, and give its output with `--simulator-output SIM.csv`."
        )
    if any(item is None or item.dimensions or item.type not in _REAL for item in [*rates, *states]):
        raise FmuError(f"{path}: a state of this FMU is not a single real number; export its states one by one.")
    inputs = [item for item in variables if item.causality == "input" and _single(item)]
    outputs = [item for item in variables if item.causality == "output" and _single(item) and not _same(item, rates)]
    return Description(
        path=path,
        version=version,
        name=re.sub(r"\W", "_", model.modelName or path.stem).lstrip("0123456789") or "Model",
        token=model.guid,
        identifier=kind.modelIdentifier,
        exchange=exchange,
        states=_quantities(states, names),
        rates=_quantities(rates, names),
        inputs=_quantities(inputs, names),
        outputs=_quantities(outputs, names),
        parameters=dict(_parameters(path, variables, names)),
        events=len(model.eventIndicators) if version == 3 else int(model.numberOfEventIndicators or 0),
        derivatives=bool(getattr(kind, "providesDirectionalDerivative", False)
                         or getattr(kind, "providesDirectionalDerivatives", False)),
        timeless=all(item.dependencies is not None and all(by.causality != "independent" for by in item.dependencies)
                     for item in (*model.outputs, *model.derivatives)),
    )  # fmt: skip


def _read(path: Path) -> Any:
    fmpy = the_library()
    if not path.is_file():
        raise FmuError(f"{path}: there is no such file.")
    try:
        version = _version(path)
        if version not in ("2", "3"):
            raise FmuError(
                f"{path}: this FMU is of FMI {version}; FMI 2.0 and 3.0 are read. Export it as one of these, or let "
                "its tool simulate the recording, and give its output with `--simulator-output SIM.csv`."
            )
        # from a folder: FMPy leaves an archive open if it fails to read it
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(path) as archive:
            archive.extract("modelDescription.xml", folder)
            return fmpy.read_model_description(folder, validate=False)
    except FmuError:
        raise
    except zipfile.BadZipFile:
        raise FmuError(
            f"{path}: this is not an FMU, or it is damaged: it is not a zip archive. Export it again."
        ) from None
    except OSError:
        raise
    except Exception as error:  # any error of the parser
        reason = " ".join(str(error).split())
        raise FmuError(
            f"{path}: its modelDescription.xml cannot be parsed ({reason[:200]}). Export the FMU again."
        ) from None


def _version(path: Path) -> str:
    """The major version of FMI if it is supported, else the text of the version."""
    with zipfile.ZipFile(path) as archive:
        if "modelDescription.xml" not in archive.namelist():
            raise FmuError(
                f"{path}: this is not an FMU, or it is damaged: it has no modelDescription.xml. Export it again."
            )
        with archive.open("modelDescription.xml") as file:
            head = file.read(4096).decode("utf-8", errors="replace")
    found = re.search(r"fmiVersion\s*=\s*[\"']\s*([^\"']*)", head)
    text = found[1] if found else "(no version)"
    return text.partition(".")[0] if text.startswith(("2.", "3.")) else text


def _single(variable: Any) -> bool:
    return variable.type in _REAL and not variable.dimensions


def _same(variable: Any, others: Iterable[Any]) -> bool:
    return any(variable is other for other in others)


def _names(variables: Sequence[Any]) -> dict[int, str]:
    """A Python identifier for each variable: id of the variable to name."""
    found: dict[int, str] = {}
    taken: set[str] = set()
    for variable in variables:
        plain = re.sub(r"\W+", "_", variable.name).strip("_") or "variable"
        name = plain if plain[0].isalpha() or plain[0] == "_" else f"v_{plain}"
        number, first = 2, name
        while name in taken:
            name, number = f"{first}_{number}", number + 1
        taken.add(name)
        found[id(variable)] = name
    return found


def _quantities(variables: Sequence[Any], names: Mapping[int, str]) -> tuple[FmuVariable, ...]:
    return tuple(
        FmuVariable(names[id(item)], item.name, item.valueReference, _attribute(item, "unit")) for item in variables
    )


def _attribute(variable: Any, what: str) -> str:
    """An attribute of a variable or of its declared type; empty if neither has it."""
    value = getattr(variable, what) or getattr(variable.declaredType, what, None)
    return unit_of(value) if what == "unit" else value or ""


def _parameters(
    path: Path, variables: Sequence[Any], names: Mapping[int, str]
) -> Iterable[tuple[FmuVariable, Parameter]]:
    for item in variables:
        if item.causality != "parameter" or item.variability not in ("fixed", "tunable") or not _single(item):
            continue
        if item.start in (None, ""):
            raise FmuError(
                f"{path}: its parameter {item.name} has no start, which FMI requires; export it with a value, or make "
                "it a constant."
            )
        bounds = [_number(path, item.name, _attribute(item, what) or other) for what, other in
                  (("min", -math.inf), ("max", math.inf))]  # fmt: skip
        start = _number(path, item.name, item.start)
        if bounds[0] == bounds[1]:
            continue  # it has a single possible value
        (quantity,) = _quantities([item], names)
        try:
            parameter = Parameter(start, bounds[0], bounds[1], quantity.unit)
        except ValueError as error:
            raise FmuError(f"{path}: its parameter {item.name} cannot be fitted: {error}") from None
        yield quantity, parameter


def _number(path: Path, name: str, text: Any) -> float:
    try:
        return float(text)
    except ValueError:
        raise FmuError(f"{path}: its parameter {name} has the value {text!r}, which is not a number.") from None

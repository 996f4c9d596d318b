"""FMUs of a few equations: C by the system's compiler, zipped with a modelDescription.xml of FMI 2.0 or 3.0.

Derivatives with respect to states, inputs and parameters are from SymPy, as an independent reference.
"""

from __future__ import annotations

import functools
import inspect
import re
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.sax.saxutils import quoteattr

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
TOKEN = "{4c6f1a52-0000-4000-8000-000000000001}"

STATES, RATES, INPUTS, OUTPUTS, PARAMETERS, EVENTS = 100, 200, 300, 400, 500, 900
"""First value reference of each kind; the independent variable has 0."""


@dataclass(frozen=True)
class Model:
    """Equations as text in the common syntax of SymPy and C, in the names of states, inputs and parameters.

    ``parameters`` are (start, lower, upper, unit), ``events`` the event indicators. An ``if`` in an equation is written
    ``Piecewise``; a condition that is frozen between events is a relation, ``r0``, ``r1`` and so on by the number of
    its event indicator: 1 where the indicator was positive at the last event.
    """

    name: str
    rates: Mapping[str, str]
    parameters: Mapping[str, tuple[float | None, float | None, float | None, str]]
    inputs: Sequence[str] = ()
    outputs: Mapping[str, str] = field(default_factory=dict)
    start: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    events: Sequence[str] = ()
    reset: Mapping[str, str] = field(default_factory=dict)
    variability: str = "tunable"
    memory: bool = False

    @property
    def states(self) -> tuple[str, ...]:
        return tuple(self.rates)


PENDULUM = Model(
    "Pendulum",
    {"angle": "speed", "speed": "torque - stiffness*sin(angle) - damping*speed"},
    {"stiffness": (9.0, None, None, ""), "damping": (0.1, 0.0, None, "1/s")},
    ("torque",),
    units={"angle": "rad", "speed": "rad/s", "torque": "N.m"},
)
"""The equations of docs/own_simulation.md."""


def make_fmu(path: Path, model: Model, version: int = 2, **how: object) -> Path:
    """Write an FMU.

    Args:
        path: path of the file.
        model: its equations.
        version: version of FMI, 2 or 3.
        how: arguments of :func:`description`.
    """
    derivatives = bool(how.get("derivatives", True))
    library = _compiled(source(model, version, derivatives=derivatives))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description(model, version, **how))
        place = "linux64" if version == 2 else "x86_64-linux"
        archive.write(library, f"binaries/{place}/{model.name}.so")
    return path


@functools.cache
def _compiled(text: str) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="made_fmu_"))
    (folder / "model.c").write_text(text, encoding="utf-8")
    command = [str(COMPILER), "-O2", "-shared", "-fPIC", "-w", "-o", "model.so", "model.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    return folder / "model.so"


def description(
    model: Model,
    version: int = 2,
    *,
    derivatives: bool = True,
    kind: str = "ModelExchange",
    fmi: str | None = None,
    without: Sequence[str] = (),
) -> str:
    """Return the modelDescription.xml, without the variables named in ``without``."""
    real = "Real" if version == 2 else "Float64"
    variables = [("time", 0, "independent", "continuous", "", None, ("", "", ""))]
    for k, name in enumerate(model.states):
        variables.append((name, STATES + k, "local", "continuous", "", model.start.get(name, 0.0), ("", "", "")))
    for k, name in enumerate(model.states):
        variables.append((f"der({name})", RATES + k, "local", "continuous", name, None, ("", "", "")))
    for k, name in enumerate(model.inputs):
        variables.append((name, INPUTS + k, "input", "continuous", "", 0.0, ("", "", "")))
    for k, name in enumerate(model.outputs):
        variables.append((name, OUTPUTS + k, "output", "continuous", "", None, ("", "", "")))
    for k, (name, (start, lower, upper, unit)) in enumerate(model.parameters.items()):
        variables.append((name, PARAMETERS + k, "parameter", model.variability, "", start, (lower, upper, unit)))
    variables += [
        (f"event {k}", EVENTS + k, "local", "continuous", "", None, ("", "", ""))
        for k in range(len(model.events) if version == 3 else 0)
    ]
    place = {variable[0]: number for number, variable in enumerate(variables, 1)}
    lines = []
    for name, reference, causality, variability, of, start, (lower, upper, unit) in variables:
        if name in without:
            continue
        attributes = {"start": start, "min": lower, "max": upper, "unit": unit or model.units.get(name, "")}
        attributes = {key: value for key, value in attributes.items() if value not in (None, "")}
        if of:
            attributes["derivative"] = place[of] if version == 2 else STATES + model.states.index(of)
        exact = " initial='exact'" if name in model.states else ""
        own = " ".join(f"{key}={quoteattr(str(value))}" for key, value in attributes.items())
        head = (
            f"name={quoteattr(name)} valueReference='{reference}' causality='{causality}' variability='{variability}'"
        )
        head += exact
        if version == 2:
            lines.append(f"<ScalarVariable {head}><{real} {own}/></ScalarVariable>")
        else:
            lines.append(f"<{real} {head} {own}/>")
    units = sorted({*model.units.values(), *(parameter[3] for parameter in model.parameters.values())} - {""})
    unit_lines = "".join(f"<Unit name={quoteattr(unit)}/>" for unit in units)
    unit_lines = f"<UnitDefinitions>{unit_lines}</UnitDefinitions>" if units else ""
    structure = _structure(model, version, place)
    provides = "providesDirectionalDerivative" if version == 2 else "providesDirectionalDerivatives"
    can = f"{provides}='{str(derivatives).lower()}'"
    if kind == "CoSimulation" and version == 2:
        can = "canHandleVariableCommunicationStepSize='true'"
    token = "guid" if version == 2 else "instantiationToken"
    count = f"numberOfEventIndicators='{len(model.events)}'" if version == 2 else ""
    return (
        f"<?xml version='1.0' encoding='UTF-8'?><fmiModelDescription fmiVersion='{fmi or f'{version}.0'}' "
        f"modelName='{model.name}' {token}='{TOKEN}' {count}><{kind} modelIdentifier='{model.name}' {can}/>"
        f"{unit_lines}<ModelVariables>{''.join(lines)}</ModelVariables>{structure}</fmiModelDescription>"
    )


def _structure(model: Model, version: int, place: Mapping[str, int]) -> str:
    def depends(text: str) -> str:
        """Return the attribute ``dependencies``: the time, states and inputs in an equation."""
        words = set(re.findall(r"[A-Za-z_]\w*", text))
        by = [name for name in ("time", *model.states, *model.inputs) if name in words or model.events]
        kinds = {"time": 0} | {name: STATES + k for k, name in enumerate(model.states)}
        kinds |= {name: INPUTS + k for k, name in enumerate(model.inputs)}
        return f"dependencies='{' '.join(str((place if version == 2 else kinds)[name]) for name in by)}'"

    if version == 2:
        outputs = "".join(f"<Unknown index='{place[name]}' {depends(text)}/>" for name, text in model.outputs.items())
        rates = "".join(
            f"<Unknown index='{place[f'der({name})']}' {depends(text)}/>" for name, text in model.rates.items()
        )
        outputs = f"<Outputs>{outputs}</Outputs>" if outputs else ""
        rates = f"<Derivatives>{rates}</Derivatives>" if rates else ""
        return f"<ModelStructure>{outputs}{rates}</ModelStructure>"
    outputs = "".join(
        f"<Output valueReference='{OUTPUTS + k}' {depends(text)}/>" for k, text in enumerate(model.outputs.values())
    )
    rates = "".join(
        f"<ContinuousStateDerivative valueReference='{RATES + k}' {depends(text)}/>"
        for k, text in enumerate(model.rates.values())
    )
    events = "".join(f"<EventIndicator valueReference='{EVENTS + k}'/>" for k in range(len(model.events)))
    return f"<ModelStructure>{outputs}{rates}{events}</ModelStructure>"


def source(model: Model, version: int, *, derivatives: bool = True) -> str:
    """Return the C source."""
    import sympy
    from sympy.parsing.sympy_parser import parse_expr

    relations = [f"r{k}" for k in range(len(model.events))]
    names = ["time", *model.states, *model.inputs, *model.parameters, *relations]
    symbols = {name: sympy.Symbol(name, real=True) for name in names}

    def parsed(text: str) -> sympy.Expr:
        return sympy.sympify(parse_expr(text, local_dict=dict(symbols)))

    places = {"time": "m->time"}
    places |= {name: f"m->x[{k}]" for k, name in enumerate(model.states)}
    places |= {name: f"m->u[{k}]" for k, name in enumerate(model.inputs)}
    places |= {name: f"m->p[{k}]" for k, name in enumerate(model.parameters)}
    places |= {name: f"m->r[{k}]" for k, name in enumerate(relations)}

    def c(expression: sympy.Expr) -> str:
        text = sympy.ccode(expression)
        return re.sub(r"\b[A-Za-z_]\w*\b", lambda found: places.get(found[0], found[0]), text)

    rates = [parsed(text) for text in model.rates.values()]
    outputs = [parsed(text) for text in model.outputs.values()]
    events = [parsed(text) for text in model.events]
    knowns = [(STATES + k, name) for k, name in enumerate(model.states)]
    knowns += [(INPUTS + k, name) for k, name in enumerate(model.inputs)]
    knowns += [(PARAMETERS + k, name) for k, name in enumerate(model.parameters)] if version == 3 else []
    slopes = []
    for first, wholes in ((RATES, rates), (OUTPUTS, outputs)):
        for k, whole in enumerate(wholes):
            for reference, name in knowns:
                slope = sympy.diff(whole, symbols[name])
                if slope != 0:
                    slopes.append(f"if (of == {first + k} && by == {reference}) return {c(slope)};")
    starts = [f"m->x[{k}] = {model.start.get(name, 0.0)!r};" for k, name in enumerate(model.states)]
    starts += [f"m->p[{k}] = {start or 0.0!r};" for k, (start, *_) in enumerate(model.parameters.values())]
    resets = [f"m->x[{model.states.index(name)}] = {c(parsed(text))};" for name, text in model.reset.items()]
    body = _SHARED
    for key, text in {
        "@NX@": str(max(1, len(model.states))),
        "@NU@": str(max(1, len(model.inputs))),
        "@NP@": str(max(1, len(model.parameters))),
        "@NE@": str(len(model.events)),
        "@START@": "\n".join(starts),
        "@RATES@": "\n".join(f"f[{k}] = {c(rate)};" for k, rate in enumerate(rates)),
        "@OUTPUTS@": "\n".join(f"if (k == {k}) return {c(output)};" for k, output in enumerate(outputs)),
        "@EVENTS@": "\n".join(f"z[{k}] = {c(event)};" for k, event in enumerate(events)),
        "@RESET@": "\n".join(resets),
        "@RESETS@": "1" if resets else "0",
        "@MEMORY@": "1" if model.memory else "0",
        "@SLOPES@": "\n".join(slopes) if derivatives else "",
    }.items():
        body = body.replace(key, text)
    own = _FMI2 if version == 2 else _FMI3
    return body + own + _stubs(own, version)


def _stubs(own: str, version: int) -> str:
    """Stubs that return an error for all other functions of the standard."""
    from fmpy import fmi2, fmi3

    kinds = (fmi2.FMU2Model, fmi2.FMU2Slave) if version == 2 else (fmi3.FMU3Model, fmi3.FMU3Slave)
    prefix = f"fmi{version}"
    names = {name for kind in kinds for name, _ in inspect.getmembers(kind) if name.startswith(prefix)}
    return "\n".join(f"int {name}(void) {{ return 3; }}" for name in sorted(names) if f"{name}(" not in own)


def with_memory(model: Model) -> Model:
    """Return the model with a memory: the number of events changes its first rate."""
    return replace(model, memory=True)


_SHARED = r"""
#include <stdlib.h>
#include <string.h>
#include <math.h>
#include <stddef.h>
typedef struct { double time, x[@NX@], u[@NU@], p[@NP@], r[@NE@ + 1]; int events; } M;
static void start(M *m) { memset(m, 0, sizeof(M)); @START@ }
static void rates(M *m, double *f) { @RATES@ if (@MEMORY@) f[0] += 0.01 * m->events; }
static double output(M *m, unsigned k) { @OUTPUTS@ return NAN; }
static void indicators(M *m, double *z) { @EVENTS@ }
static double slope(M *m, unsigned of, unsigned by) { @SLOPES@ return 0.0; }
static int event(M *m) {
    double z[@NE@ + 1]; int fired = 0;
    indicators(m, z);
    for (int k = 0; k < @NE@; k++) { int now = z[k] > 0; if (now != (int)m->r[k]) fired = 1; m->r[k] = now; }
    if (fired) { m->events++; @RESET@ }
    return fired && @RESETS@;
}
static int get(M *m, const unsigned *vr, size_t n, double *v) {
    double f[@NX@]; rates(m, f);
    for (size_t i = 0; i < n; i++) {
        unsigned k = vr[i] % 100, kind = vr[i] / 100;
        if (vr[i] == 0) v[i] = m->time;
        else if (kind == 1) v[i] = m->x[k];
        else if (kind == 2) v[i] = f[k];
        else if (kind == 3) v[i] = m->u[k];
        else if (kind == 4) v[i] = output(m, k);
        else if (kind == 5) v[i] = m->p[k];
        else return 3;
    }
    return 0;
}
static int set(M *m, const unsigned *vr, size_t n, const double *v) {
    for (size_t i = 0; i < n; i++) {
        unsigned k = vr[i] % 100, kind = vr[i] / 100;
        if (kind == 1) m->x[k] = v[i];
        else if (kind == 3) m->u[k] = v[i];
        else if (kind == 5) m->p[k] = v[i];
        else return 3;
    }
    return 0;
}
"""

_FMI2 = r"""
typedef struct { int need, terminate, nominals, values, timed; double next; } Info;
const char *fmi2GetVersion(void) { return "2.0"; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
void *fmi2Instantiate(const char *n, int t, const char *g, const char *r, void *c, int v, int l) {
    M *m = malloc(sizeof(M)); start(m); return m; }
void fmi2FreeInstance(void *c) { free(c); }
int fmi2SetupExperiment(void *c, int d, double t, double s, int e, double p) { ((M *)c)->time = s; return 0; }
int fmi2EnterInitializationMode(void *c) { return 0; }
int fmi2ExitInitializationMode(void *c) { event(c); return 0; }
int fmi2Terminate(void *c) { return 0; }
int fmi2Reset(void *c) { start(c); return 0; }
int fmi2GetReal(void *c, const unsigned *vr, size_t n, double *v) { return get(c, vr, n, v); }
int fmi2SetReal(void *c, const unsigned *vr, size_t n, const double *v) { return set(c, vr, n, v); }
int fmi2EnterEventMode(void *c) { return 0; }
int fmi2NewDiscreteStates(void *c, Info *i) { memset(i, 0, sizeof(Info)); i->values = event(c); return 0; }
int fmi2EnterContinuousTimeMode(void *c) { return 0; }
int fmi2SetTime(void *c, double t) { ((M *)c)->time = t; return 0; }
int fmi2SetContinuousStates(void *c, const double *x, size_t n) { memcpy(((M *)c)->x, x, n * 8); return 0; }
int fmi2GetContinuousStates(void *c, double *x, size_t n) { memcpy(x, ((M *)c)->x, n * 8); return 0; }
int fmi2GetDerivatives(void *c, double *f, size_t n) { rates(c, f); return 0; }
int fmi2GetEventIndicators(void *c, double *z, size_t n) { indicators(c, z); return 0; }
int fmi2GetDirectionalDerivative(void *c, const unsigned *z, size_t nz, const unsigned *v, size_t nv,
                                 const double *dv, double *dz) {
    for (size_t i = 0; i < nv; i++) if (v[i] / 100 == 5) return 3;
    for (size_t j = 0; j < nz; j++) { dz[j] = 0;
        for (size_t i = 0; i < nv; i++) dz[j] += slope(c, z[j], v[i]) * dv[i]; }
    return 0; }
"""

_FMI3 = r"""
#include <stdbool.h>
const char *fmi3GetVersion(void) { return "3.0"; }
void *fmi3InstantiateModelExchange(const char *n, const char *g, const char *r, bool v, bool l, void *e, void *c) {
    M *m = malloc(sizeof(M)); start(m); return m; }
void fmi3FreeInstance(void *c) { free(c); }
int fmi3EnterInitializationMode(void *c, bool d, double t, double s, bool e, double p) { ((M *)c)->time = s; return 0; }
int fmi3ExitInitializationMode(void *c) { event(c); return 0; }
int fmi3Terminate(void *c) { return 0; }
int fmi3Reset(void *c) { start(c); return 0; }
int fmi3GetFloat64(void *c, const unsigned *vr, size_t n, double *v, size_t k) { return get(c, vr, n, v); }
int fmi3SetFloat64(void *c, const unsigned *vr, size_t n, const double *v, size_t k) { return set(c, vr, n, v); }
int fmi3EnterEventMode(void *c) { return 0; }
int fmi3UpdateDiscreteStates(void *c, bool *need, bool *end, bool *nominals, bool *values, bool *timed, double *next) {
    *need = *end = *nominals = *timed = false; *values = event(c); return 0; }
int fmi3EnterContinuousTimeMode(void *c) { return 0; }
int fmi3SetTime(void *c, double t) { ((M *)c)->time = t; return 0; }
int fmi3SetContinuousStates(void *c, const double *x, size_t n) { memcpy(((M *)c)->x, x, n * 8); return 0; }
int fmi3GetContinuousStates(void *c, double *x, size_t n) { memcpy(x, ((M *)c)->x, n * 8); return 0; }
int fmi3GetContinuousStateDerivatives(void *c, double *f, size_t n) { rates(c, f); return 0; }
int fmi3GetEventIndicators(void *c, double *z, size_t n) { indicators(c, z); return 0; }
int fmi3GetDirectionalDerivative(void *c, const unsigned *z, size_t nz, const unsigned *v, size_t nv,
                                 const double *dv, size_t ndv, double *dz, size_t ndz) {
    for (size_t j = 0; j < nz; j++) { dz[j] = 0;
        for (size_t i = 0; i < nv; i++) dz[j] += slope(c, z[j], v[i]) * dv[i]; }
    return 0; }
"""

"""The public API as text: `python -m tests.public_api` writes `tests/public_api.txt`, which the tests compare.

griffe reads names, signatures and types from the source; it is a part of what builds the manual (ISC licence).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import griffe

ROOT = Path(__file__).resolve().parents[1]
SNAPSHOT = ROOT / "tests" / "public_api.txt"

MODULES = (
    "mkc_torch",
    "mkc_torch.functional",
    "mkc_torch.density",
    "mkc_torch.losses",
    "mkc_torch.metrics",
    "mkc_torch.lightning",
    "mkc_torch.linear",
    "mkc_torch.linear.streaming",
    "mkc_torch.covariance",
    "mkc_torch.nonlinear",
    "mkc_torch.recording",
    "mkc_torch.calibration",
    "mkc_torch.simulation",
    "mkc_torch.effects",
    "mkc_torch.diagnosis",
)


def public_api() -> str:
    """Every public name with its signature, a name a line, the members of a class below it."""
    package = griffe.load("mkc_torch", search_paths=[ROOT], resolve_aliases=True, resolve_external=False)
    lines: list[str] = []
    for module in MODULES:
        found = package if module == "mkc_torch" else package[module.removeprefix("mkc_torch.")]
        lines.append(f"# {module}")
        for name in sorted(str(export) for export in found.exports or ()):
            lines += _lines(found[name], "") if name in found.members else [f"{name}"]
    return "\n".join(lines) + "\n"


def _lines(member: griffe.Object | griffe.Alias, indent: str) -> Iterator[str]:
    target = member.final_target if member.is_alias else member
    if target.is_function:
        yield f"{indent}{member.name}{_signature(target)}"
    elif target.is_class:
        bases = "".join(f" < {base}" for base in target.bases)
        yield f"{indent}class {member.name}{_signature(target, of_class=True)}{bases}"
        for name, inner in sorted(target.members.items()):
            if not name.startswith("_") and not (inner.is_alias and not inner.is_class):
                yield from _lines(inner, indent + "    ")
    elif target.is_attribute:
        yield f"{indent}{member.name}: {target.annotation}"
    else:
        yield f"{indent}{member.name}"


def _signature(target: griffe.Object, *, of_class: bool = False) -> str:
    """The parameters, with types and defaults, and what a function returns."""
    parameters = list(target.parameters)
    if parameters and parameters[0].name in ("self", "cls"):
        parameters = parameters[1:]
    if of_class and not parameters:
        return ""
    texts, keyword_only = [], False
    for parameter in parameters:
        kind = parameter.kind
        if kind is griffe.ParameterKind.keyword_only and not keyword_only:
            keyword_only = True
            texts.append("*")
        stars = {griffe.ParameterKind.var_positional: "*", griffe.ParameterKind.var_keyword: "**"}.get(kind, "")
        text = f"{stars}{parameter.name}"
        if parameter.annotation is not None:
            text += f": {parameter.annotation}"
        if parameter.default is not None and not stars:
            text += f" = {parameter.default}"
        texts.append(text)
        keyword_only = keyword_only or stars == "*"
    returns = "" if of_class or getattr(target, "returns", None) is None else f" -> {target.returns}"
    return f"({', '.join(texts)}){returns}"


def main() -> None:
    """Write the snapshot."""
    SNAPSHOT.write_text(public_api(), encoding="utf-8")


if __name__ == "__main__":
    main()

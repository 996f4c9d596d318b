"""``mkc new-simulation`` and ``mkc new-effect``: write a template and its test."""

from __future__ import annotations

import keyword
import sys
from importlib.machinery import PathFinder
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Annotated

import typer

from mkc_torch._support.files import write_atomically
from mkc_torch.cli.console import FAILURES, complain, out

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the file, such as kite; the class is called Kite.")]
Folder = Annotated[Path, typer.Option(help="Folder to write into.")]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]


Model = Annotated[
    Path | None,
    typer.Option(
        "--from", metavar="MODEL.xml", help="A model for MuJoCo: write NAME.csv, a recording with its columns, instead."
    ),
]


def new_simulation(name: Name, output: Folder = Path(), model: Model = None, force: Force = False) -> None:
    """Write NAME.py, a template for your own simulation, and test_NAME.py, which simulates and diagnoses it.

    With --from, write NAME.csv instead: 20 s simulated by a model for MuJoCo, with the columns that a recording needs.
    """
    if model is None:
        _write("simulation", name, output, force=force)
    else:
        _write_recording(model, output / f"{name}.csv", force=force)


def _write_recording(model: Path, target: Path, *, force: bool) -> None:
    """Write a recording simulated by a model for MuJoCo, and print the command that diagnoses such a recording."""
    from mkc_torch.recording import write_table
    from mkc_torch.simulation.stepped.mujoco.example import example_recording

    try:
        if target.exists() and not (force and target.is_file()):
            raise FileExistsError(f"{target} exists; choose another name, or replace it with `--force`.")
        columns = example_recording(model)
        target.parent.mkdir(parents=True, exist_ok=True)
        write_table(target, columns, overwrite=force)
    except (*FAILURES, ImportError) as error:
        complain(model, error)
        raise typer.Exit(1) from None
    out().print(f"{target}: {', '.join(columns)}", soft_wrap=True)
    out().print(f"mkc diagnose YOURS.csv --simulation {model}", soft_wrap=True)


def new_effect(name: Name, output: Folder = Path(), force: Force = False) -> None:
    """Write NAME.py, a template for your own effect, and test_NAME.py, which finds it in a simulated recording."""
    _write("effect", name, output, force=force)


def _write(kind: str, name: str, folder: Path, *, force: bool) -> None:
    _refuse_name(name)
    words = {"name": name, "class": _in_capitals(name)}
    targets = {folder / f"{name}.py": kind, folder / f"test_{name}.py": f"test_{kind}"}
    try:
        for path in targets:  # write both files or none
            if path.exists() and not (force and path.is_file()):
                raise FileExistsError(f"{path} exists; choose another name, or replace it with `--force`.")
        folder.mkdir(parents=True, exist_ok=True)
        for path, template in targets.items():
            write_atomically(path, _text(template, words), overwrite=force)
    except FAILURES as error:
        complain(path, error)
        raise typer.Exit(1) from None
    out().print("\n".join(str(path) for path in targets), soft_wrap=True)


def _text(template: str, words: dict[str, str]) -> str:
    text = (files("mkc_torch.cli") / "templates" / f"{template}.txt").read_text(encoding="utf-8")
    return Template(text).substitute(words)


def _in_capitals(name: str) -> str:
    """Return the name of the class.

    Example:
        >>> _in_capitals("two_tanks"), _in_capitals("kite")
        ('TwoTanks', 'Kite')
    """
    return "".join(part[:1].upper() + part[1:] for part in name.split("_"))


def _refuse_name(name: str) -> None:
    """Raise if a name cannot be that of a new module.

    Raises:
        typer.BadParameter: the name is not an identifier, is taken by a module, or equals the name of the class.
    """
    if not name.isidentifier() or keyword.iskeyword(name) or not _in_capitals(name).isidentifier():
        raise typer.BadParameter(
            f'"{name}" cannot be the name of a module; use letters, digits and _, such as kite. Give the folder by '
            "--output."
        )
    places = [place for place in sys.path if place and Path(place).resolve() != Path.cwd()]
    taken = name in sys.builtin_module_names or name in sys.stdlib_module_names
    if taken or PathFinder.find_spec(name, places) is not None:
        raise typer.BadParameter(f"a module {name} is installed, and this file would hide it; choose another name.")
    if _in_capitals(name) == name:
        raise typer.BadParameter(
            f'"{name}" would be the name of the file and of the class; write it in lower case, {name.lower()}.'
        )

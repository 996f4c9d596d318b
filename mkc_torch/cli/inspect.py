"""``mkc inspect``: show the content of files, and what ``mkc calibrate`` would read from them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mkc_torch.cli.console import FAILURES, complain, err, out, progress
from mkc_torch.cli.loading import loading

if TYPE_CHECKING:
    from mkc_torch.recording.inspection import FileSeen


def inspect(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Tables or logs.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Show topics, columns, rates, gaps and units of files, and what `mkc calibrate` and `mkc diagnose` take.

    The exit code is 0 if every file was read, and 1 otherwise.
    """
    with loading():
        from mkc_torch.cli.inspection_summary import as_data, commands_of, show
        from mkc_torch.recording.inspection import inspect_file
    console, found, failed = out(), [], 0
    with progress(len(files), lines=True) as step:
        for path in files:
            step(f"reading {path.name}")
            seen = _seen(inspect_file, path)
            commands = None if seen is None or as_json else commands_of(seen)
            with step.aside():
                if seen is None:
                    failed += 1
                elif commands is None:
                    found.append(as_data(seen))
                else:
                    show(console, seen, commands)
            step(None)
    if as_json:
        typer.echo(json.dumps(found, ensure_ascii=False, indent=2, allow_nan=False))
    if len(files) > 1 and failed:
        err().print(f"mkc: {failed} of {len(files)} files were not read.", soft_wrap=True)
    raise typer.Exit(1 if failed else 0)


def _seen(look: Any, path: Path) -> FileSeen | None:
    try:
        found: FileSeen = look(path)
    except FAILURES as error:
        complain(path, error)
        return None
    return found

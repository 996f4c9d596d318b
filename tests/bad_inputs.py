"""Bad inputs and the message that each gets; `python -m tests.bad_inputs` writes them to docs/bad_inputs.md."""

from __future__ import annotations

import math
import re
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from typer.testing import CliRunner

from mkc_torch import EllipsoidFit, Recording, functional, losses
from mkc_torch.cli.app import app
from mkc_torch.density import fit_density
from mkc_torch.linear import MKCRegression, NotFittedError
from mkc_torch.nonlinear import NoFitError, fit
from mkc_torch.simulation import Parameter
from tests.docs.pages import ROOT
from tests.recording.test_bad_input import BAD
from tests.recording.test_strange_files import (
    EXPECTED_WARNINGS,
    FIELD,
    LINES,
    OTHER,
    PLAIN,
    READABLE_FILES,
    TIME,
    table,
)

PAGE = ROOT / "docs" / "bad_inputs.md"

HEAD = """# Bad inputs, and what is reported

Each row is an input to the command line or to Python, and the message that it gets; `tests/bad_inputs.py` prints
them. No traceback, no NaN, no file changed: `tests/test_bad_inputs.py` gives each input again and checks this.

"""
LOGS = (".parquet", ".ulg", ".bin", ".log", ".mcap", ".bag", ".mat", ".h5", ".mf4")


@dataclass(frozen=True)
class BadInput:
    """An input: its heading on the page, its description, and a function that returns its message, given a folder."""

    group: str
    given: str
    message: Callable[[Path], str]


class UnexpectedOutcomeError(Exception):
    """The outcome is a traceback or a success, or a file was changed."""


def run_mkc(folder: Path, *arguments: str, exit_codes: tuple[int, ...] = (1, 2)) -> str:
    """The error message of a command; arguments that begin with @ are files of the folder."""
    there = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    given = [str(folder / item[1:]) if item.startswith("@") else item for item in arguments]
    done = CliRunner().invoke(app, given)
    if done.exit_code not in exit_codes or not isinstance(done.exception, (SystemExit, type(None))):
        raise UnexpectedOutcomeError(f"{arguments}: exit code {done.exit_code}, {done.exception!r}\n{done.output}")
    lost = [path for path, data in there.items() if not path.is_file() or path.read_bytes() != data]
    if lost:
        raise UnexpectedOutcomeError(f"{arguments}: {lost} was changed")
    return one_line(folder, done.stderr)


def one_line(folder: Path, text: str) -> str:
    """A message on a single line, without the folder of its files and without usage hints."""
    text = " ".join(text.replace(str(folder) + "/", "").replace(str(folder), ".").split())
    return re.sub(r"^Usage: .*? Error: (Invalid value( for '[^']*')?: )?", "", text).removeprefix("mkc: ")


def error_message(call: Callable[[], Any]) -> str:
    """The message of the error that a call raises."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            answer = call()
    except (ValueError, TypeError, NotFittedError, NoFitError) as error:
        return " ".join(str(error).split())
    raise UnexpectedOutcomeError(f"accepted, with the result {answer!r}")


def of_text(kind: str) -> Callable[[Path], str]:
    def message(folder: Path) -> str:
        content, _ = BAD[kind]
        (folder / "bad.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
        return run_mkc(
            folder, "calibrate", "@bad.csv", "--output", "@out", *(["--sensor", "c"] * (kind == "two sensors"))
        )

    return message


def of_file(name: str, content: bytes | str, *options: str) -> Callable[[Path], str]:
    def message(folder: Path) -> str:
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return run_mkc(folder, "calibrate", f"@{name}", "--output", "@out", *options)

    return message


def of_repaired_text(kind: str) -> Callable[[Path], str]:
    """The warning for text that is read after a repair."""

    def message(folder: Path) -> str:
        content = READABLE_FILES[kind]
        (folder / "rec.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
        recording = Recording.read(folder / "rec.csv")
        if not recording.magnetometer().isfinite().all():
            raise UnexpectedOutcomeError(f"{kind}: {recording}")
        return next(
            sentence for sentence in (*recording.warnings, *recording.notes) if EXPECTED_WARNINGS[kind] in sentence
        )

    return message


def of_command(*arguments: str) -> Callable[[Path], str]:
    """A command in a folder with a good recording, its calibration and files that are neither."""

    def message(folder: Path) -> str:
        for name, content in prepared().items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        (folder / "folder").mkdir()
        return run_mkc(folder, *arguments)

    return message


@cache
def prepared() -> dict[str, bytes]:
    """The files of that folder by their paths."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "rec.csv").write_text(PLAIN)
        (folder / "counts.csv").write_text(table("time,mag_x [LSB],mag_y [LSB],mag_z [LSB]", TIME, *(15.0 * FIELD.T)))
        (folder / "mag0_mag1.csv").write_text(
            table("time,mag0_x,mag0_y,mag0_z,mag1_x,mag1_y,mag1_z", TIME, *FIELD.T, *OTHER.T)
        )
        (folder / "none.json").write_text('{"a": 1}')
        (folder / "cut.json").write_text('{"schema": "mkc-calib')
        (folder / "file").write_text("")
        run_mkc(folder, "calibrate", "@rec.csv", "@counts.csv", "--output", "@done", exit_codes=(0,))
        return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def of_fmu(content: bytes | None) -> Callable[[Path], str]:
    def message(folder: Path) -> str:
        (folder / "rec.csv").write_text(PLAIN)
        if content is None:
            with zipfile.ZipFile(folder / "model.fmu", "w") as archive:
                archive.writestr("readme.txt", "nothing")
        else:
            (folder / "model.fmu").write_bytes(content)
        return run_mkc(folder, "diagnose", "@rec.csv", "--simulation", "@model.fmu", "--output", "@out")

    return message


DONE = "@done/rec/calibration.json"
DIAGNOSE = ("diagnose", "@rec.csv", "--simulation", "magnetometer", "--output", "@out")
COMMANDS: dict[str, tuple[str, ...]] = {
    "a recording that is not there": ("calibrate", "@other.csv", "--output", "@out"),
    "a folder": ("calibrate", "@folder", "--output", "@out"),
    "an output that is a file": ("calibrate", "@rec.csv", "--output", "@file"),
    "results that are there": ("calibrate", "@rec.csv", "--output", "@done"),
    "two recordings of one name": ("calibrate", "@rec.csv", "@folder/rec.csv", "--output", "@out"),
    "`--columns mag_x`": ("calibrate", "@rec.csv", "--output", "@out", "--columns", "mag_x"),
    "`--columns mag_x=a,mag_x=b`": ("calibrate", "@rec.csv", "--output", "@out", "--columns", "mag_x=a,mag_x=b"),
    "`--columns mag_x=a` without a column a": ("calibrate", "@rec.csv", "--output", "@out", "--columns", "mag_x=a"),
    "`--convert time=parsec`": ("calibrate", "@rec.csv", "--output", "@out", "--convert", "time=parsec"),
    "`--convert speed=km/h`": ("calibrate", "@rec.csv", "--output", "@out", "--convert", "speed=km/h"),
    "`--sensor mag7`": ("calibrate", "@mag0_mag1.csv", "--output", "@out", "--sensor", "mag7"),
    "`--name` of a file with two": ("calibrate", "@mag0_mag1.csv", "--output", "@out", "--name", "mast"),
    "`--field-strength -1`": ("calibrate", "@rec.csv", "--output", "@out", "--field-strength", "-1"),
    "`--field-strength nan`": ("calibrate", "@rec.csv", "--output", "@out", "--field-strength", "nan"),
    "`--place` without `--recorded-on`": ("calibrate", "@rec.csv", "--output", "@out", "--place", "48,11"),
    "`--export mavlink`": ("calibrate", "@rec.csv", "--output", "@out", "--export", "mavlink"),
    "`--compare-with` another JSON": ("calibrate", "@rec.csv", "--output", "@out", "--compare-with", "@none.json"),
    "a calibration that is cut": ("apply", "@cut.json", "@rec.csv", "--output", "@out.csv"),
    "a calibration that is none": ("apply", "@none.json", "@rec.csv", "--output", "@out.csv"),
    "a calibration that is not there": ("apply", "@other.json", "@rec.csv", "--output", "@out.csv"),
    "apply over its recording": ("apply", DONE, "@rec.csv", "--output", "@rec.csv", "--force"),
    "apply over another file": ("apply", DONE, "@rec.csv", "--output", "@counts.csv"),
    "apply into a log": ("apply", DONE, "@rec.csv", "--output", "@out.ulg"),
    "apply to another unit": ("apply", DONE, "@counts.csv", "--output", "@out.csv"),
    "export of counts to an autopilot": (
        "export", "@done/counts/calibration.json", "--to", "px4", "--output", "@out.params",
    ),
    "`--to mavlink`": ("export", DONE, "--to", "mavlink", "--output", "@out.params"),
    "a simulation that is not there": ("diagnose", "@rec.csv", "--simulation", "@sim.py", "--output", "@out"),
    "`--time-limit 0`": (*DIAGNOSE, "--time-limit", "0"),
    "`--time-limit soon`": (*DIAGNOSE, "--time-limit", "soon"),
    "`--quick --surrogates 99`": (*DIAGNOSE, "--quick", "--surrogates", "99"),
    "a simulation of no kind": ("diagnose", "@rec.csv", "--simulation", "@none.json", "--output", "@out"),
}  # fmt: skip

ONES = torch.ones(20, 3, dtype=torch.float64)
TALL = torch.arange(60, dtype=torch.float64).reshape(20, 3)
PYTHON: dict[str, Callable[[], Any]] = {
    "`mkc_energy(error, sigma=-1.0, d=1.0)`": lambda: functional.mkc_energy(ONES, -1.0, 1.0),
    "`mkc_energy(error, sigma=1.0, d=0.0)`": lambda: functional.mkc_energy(ONES, 1.0, 0.0),
    "`mkc_energy([1, 2], 1.0, 1.0)`": lambda: functional.mkc_energy([1, 2], 1.0, 1.0),
    "`MKCLoss(0)`": lambda: losses.MKCLoss(0),
    "`MKCLoss(2, sigma=nan)`": lambda: losses.MKCLoss(2, sigma=math.nan),
    "`MKCLoss(2)` of three channels": lambda: losses.MKCLoss(2)(ONES, ONES),
    "`MKCLoss(3)` of NaN": lambda: losses.MKCLoss(3)(ONES * math.nan, ONES),
    "`GeneralizedCrossEntropyLoss(-1.0)`": lambda: losses.GeneralizedCrossEntropyLoss(-1.0),
    "`fit_density` of 1e300": lambda: fit_density(1e300 * ONES),
    "`MKCRegression().fit(X, Y)` of other lengths": lambda: MKCRegression().fit(ONES, ONES[:7, 0]),
    "`MKCRegression().fit(X, Y)`, Y infinite": lambda: MKCRegression().fit(TALL, ONES[:, 0] / 0.0),
    "`MKCRegression().predict(X)` before it is fitted": lambda: MKCRegression().predict(ONES),
    "`EllipsoidFit().fit(points.T)`": lambda: EllipsoidFit().fit(ONES.mT),
    "`EllipsoidFit().fit(points)`, eight of them": lambda: EllipsoidFit().fit(ONES[:8]),
    "`EllipsoidFit().fit(points)`, all equal": lambda: EllipsoidFit().fit(ONES),
    "`EllipsoidFit().fit(points)` of 1e200": lambda: EllipsoidFit().fit(1e200 * TALL),
    "`fit(residual, start)`, a start of NaN": lambda: fit(
        lambda theta, data: data - theta, torch.tensor([math.nan]), data=ONES[:, :1]
    ),
    "`Parameter(-1.0, lower=0.1)`": lambda: Parameter(-1.0, lower=0.1),
    "`Recording({})`": lambda: Recording({}),
    "`Recording` of columns of other lengths": lambda: Recording({"a": ONES[:, 0], "b": ONES[:3, 0]}),
    "`Recording` of a list": lambda: Recording({"a": [1.0, 2.0]}),
    '`Recording(...)["mag_x"]` without that column': lambda: Recording({"a": ONES[:, 0]})["mag_x"],
    "`Recording.from_frame` of a dict": lambda: Recording.from_frame({"a": [1.0]}),
}


def bad_inputs() -> Iterator[BadInput]:
    """All bad inputs, in the order of the page."""
    for kind in BAD:
        yield BadInput("Text", kind, of_text(kind))
    yield BadInput("Text", "a table without a header", of_file("rec.csv", "\n".join(LINES[1:])))
    yield BadInput(
        "Text", "an accelerometer alone", of_file("rec.csv", table("time,acc_x,acc_y,acc_z", TIME, *FIELD.T))
    )
    yield BadInput(
        "Text", "columns with numbers for axes", of_file("rec.csv", table("time,m_0,m_1,m_2", TIME, *FIELD.T))
    )
    yield BadInput("Text", "eight samples", of_file("rec.csv", "\n".join(LINES[:9])))
    yield BadInput("Text", "a sensor that does not turn", of_file("rec.csv", table("mx,my,mz", *([[9.0] * 99] * 3))))
    yield BadInput(
        "Text", "an axis that is stuck", of_file("rec.csv", table("mx,my,mz", *FIELD.T[:2], [7.0] * len(TIME)))
    )
    for kind in EXPECTED_WARNINGS:
        yield BadInput("Text that is read, and the warning", kind, of_repaired_text(kind))
    for ending in LOGS:
        yield BadInput("Logs", f"text called `{ending}`", of_file(f"log{ending}", PLAIN))
    yield BadInput("Logs", "an empty log", of_file("log.ulg", b""))
    yield BadInput("Logs", "bytes of nothing", of_file("log.ulg", bytes(range(200, 256)) * 9))
    yield BadInput("Logs", "a ULog of its beginning alone", of_file("log.ulg", b"ULog\x01\x12\x35\x01" + bytes(8)))
    yield BadInput("Logs", "a ULog called `.csv`", of_file("log.csv", b"ULog\x01\x12\x35\x01" + bytes(64)))
    yield BadInput("Logs", "an archive called `.csv`", of_file("log.csv", b"\x1f\x8b\x08\x00" + bytes(64)))
    yield BadInput("Logs", "an archive", of_file("log.csv.gz", b"\x1f\x8b\x08\x00" + bytes(64)))
    yield BadInput("Logs", "a spreadsheet", of_file("log.xlsx", b"PK\x03\x04" + bytes(64)))
    yield BadInput("Logs", "a file without an ending", of_file("log", PLAIN))
    for given, arguments in COMMANDS.items():
        yield BadInput("Commands", given, of_command(*arguments))
    yield BadInput("FMUs", "text called `.fmu`", of_fmu(b"no archive"))
    yield BadInput("FMUs", "an archive without a model", of_fmu(None))
    yield BadInput("FMUs", "an archive that is cut", of_fmu(b"PK\x03\x04 cut off"))
    for given, call in PYTHON.items():
        yield BadInput("Python", given, lambda _, call=call: error_message(call))


def row(bad: BadInput, message: str) -> str:
    return f"| {cell(bad.given)} | {cell(message)} |"


def cell(text: str) -> str:
    """Text in a table, with bars and `<` escaped."""
    return text.replace("|", r"\|").replace("<", "&lt;")


def rows() -> Iterator[tuple[BadInput, str]]:
    """Each input and its message."""
    for bad in bad_inputs():
        with tempfile.TemporaryDirectory() as folder:
            yield bad, bad.message(Path(folder))


def page() -> str:
    text, group = HEAD, ""
    for bad, message in rows():
        if bad.group != group:
            text += f"{'' if not group else chr(10)}## {bad.group}\n\n| input | message |\n|---|---|\n"
            group = bad.group
        text += row(bad, message) + "\n"
    return text


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")

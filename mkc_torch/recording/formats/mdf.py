"""ASAM MDF (``.mf4``, ``.mdf``), versions 2 to 4, by asammdf.

asammdf is large (it brings pandas and canmatrix, and takes two seconds to import) and there is nothing as complete
beside it: mdfreader is no longer kept, and the readers in other languages have no Python.

Source: ASAM MDF 4.2.
"""

from __future__ import annotations

import contextlib
import io
import logging
import sys
import traceback
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mkc_torch.recording.formats.base import FileFormat, RecordingError, Topic
from mkc_torch.recording.formats.begins import begins_with, check_begins
from mkc_torch.recording.formats.damage import guarded, no_rows, with_warnings
from mkc_torch.recording.formats.topics import spread, topic_of

__all__ = ["MDF"]

_WHAT = "ASAM MDF file"
_BEGINS = b"MDF     ", b"UnFinMF "
_SYNC_UNITS = {1: "s", 2: "rad", 3: "m"}
"""What a master channel counts, by its type of synchronisation, and the unit that the specification gives it."""

_MOST_CHANNELS = 4096


def read(path: Path) -> list[Topic]:
    """The topics of a file: each group of channels is one, named by its acquisition or source, or else ``group_0``.

    Values are physical, converted as the file says, and numbers where it has words for them. Units are the channels';
    the master channel, mostly ``time`` in s, comes first. A value that the file marks as invalid is missing. Memory is
    that of all channels, eight bytes a number, and a group's bytes as they lie in the file.

    A channel whose conversion is a formula in words is left out: it would be executed.

    Raises:
        RecordingError: no MDF file, a damaged one, or one without rows.
        ImportError: asammdf is not installed.
    """
    check_begins(path, _WHAT, *_BEGINS)
    try:
        import asammdf
    except ImportError as error:
        raise ImportError('MDF files are read with asammdf; install it with `pip install "mkc-torch[mdf]"`.') from error
    topics: list[Topic] = []
    told: list[str] = []
    with guarded(path, _WHAT), _quiet(), _stream(path) as stream, _opened(path, asammdf, stream) as file:
        names = _names(file)
        for place in file.virtual_groups:
            topic, said = _topic_or_why(file, place, names[place])
            topics += [topic] if topic else []
            told += [said] if said else []
    if begins_with(path, _BEGINS[1]):
        told.append("The file was not closed by its recorder; its last rows may be missing.")
    if not topics:
        raise no_rows(path, _WHAT, told)
    return with_warnings(topics, told)


def _stream(path: Path) -> BinaryIO:
    """The file, opened here: of a path asammdf leaves it open where it fails, and copies one that was not closed.

    It writes what is missing into a file that was not closed, so that it gets the content of one in memory.
    """
    return io.BytesIO(path.read_bytes()) if begins_with(path, _BEGINS[1]) else path.open("rb")


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keeps asammdf from logging errors to the terminal, which are told here otherwise."""
    logger = logging.getLogger("asammdf")
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


def _opened(path: Path, package: Any, stream: BinaryIO) -> Any:
    """The file as asammdf has it.

    Where it is damaged, an object is left half made, whose removal fails, which Python would print; so it is removed here.
    """
    before, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        return package.MDF(stream)
    except Exception as error:  # the library raises what comes
        said = (str(error).strip().splitlines() or [type(error).__name__])[0][:120]
        traceback.clear_frames(error.__traceback__)
    finally:
        sys.unraisablehook = before
    raise RecordingError(
        f"{path}: the {_WHAT} cannot be read: it is damaged ({said}); copy it anew from where it was recorded."
    )


def _names(file: Any) -> dict[int, str]:
    """A name for each group, each once."""
    found = {}
    seen: Counter[str] = Counter()
    for place in file.virtual_groups:
        group = file.groups[place].channel_group
        source = getattr(getattr(group, "acq_source", None), "name", "")
        name = (getattr(group, "acq_name", "") or source or f"group_{place}").strip()
        seen[name] += 1
        found[place] = name if seen[name] == 1 else f"{name} ({seen[name]})"
    return found


def _topic_or_why(file: Any, place: int, name: str) -> tuple[Topic | None, str]:
    """The topic of a group; where its blocks are damaged, a sentence that says so, and the other groups stay."""
    try:
        return _topic(file, place, name), ""
    except Exception as error:  # the library raises what comes
        lines = str(error).strip().splitlines() or [type(error).__name__]
        return None, f"Group {name} cannot be read and is left out ({lines[0][:100]})."


def _topic(file: Any, place: int, name: str) -> Topic | None:
    chosen, told, formulas = [], [], []
    for group in file.virtual_groups[place].groups:
        channels = file.groups[group].channels
        if not file.groups[group].channel_group.cycles_nr:
            continue
        for index, channel in enumerate(channels[:_MOST_CHANNELS]):
            if index == file.masters_db.get(group):
                continue
            if _has_formula(channel.conversion, 0):
                formulas.append(channel.name)
            else:
                chosen.append((None, group, index))
    if not chosen:
        return None
    signals = file.select(chosen, ignore_value2text_conversions=True, validate=False)
    master, unit = _master(file, place)
    columns: dict[str, np.ndarray] = {}
    units = {master: unit}
    times = np.asarray(signals[0].timestamps)
    if master and len(times):
        columns[master] = times
    for signal in signals:
        if signal.name in columns or len(signal.samples) != len(times):
            told.append(f"Channel `{signal.name}` stands twice, or has another length, and is left out.")
            continue
        parts = _parts(signal)
        columns |= parts
        units |= dict.fromkeys(parts, str(signal.unit or ""))
    if formulas:
        names = ", ".join(f"`{one}`" for one in formulas[:8])
        told.append(f"{names}: converted by a formula in words, which is not executed, left out.")
    return topic_of(name, columns, units, told) if len(columns) > bool(master) else None


def _parts(signal: Any) -> dict[str, np.ndarray]:
    """The columns of a channel: one, or those of its array or structure."""
    samples = np.asarray(signal.samples)
    if samples.dtype.names:
        parts: dict[str, np.ndarray] = {}
        for field in samples.dtype.names:
            whole = signal.name if field == signal.name else f"{signal.name}.{field}"
            parts |= spread(whole, samples[field])
    else:
        parts = spread(signal.name, samples)
    invalid = signal.invalidation_bits
    if invalid is None or not np.any(invalid):
        return parts
    bad = np.asarray(invalid, dtype=bool)
    return {
        name: np.where(bad, np.nan, values.astype(np.float64)) if values.dtype.kind in "biuf" else values
        for name, values in parts.items()
    }


def _master(file: Any, place: int) -> tuple[str, str]:
    """The name of a group's master channel and its unit; of a group without one, rows are counted by none."""
    for group in file.virtual_groups[place].groups:
        index = file.masters_db.get(group)
        if index is not None:
            channel = file.groups[group].channels[index]
            kind: Any = getattr(channel, "sync_type", None)  # versions 2 and 3 count time alone
            return str(channel.name), str(channel.unit or "") or _SYNC_UNITS.get(kind or 1, "")
    return "", ""


def _has_formula(conversion: Any, depth: int) -> bool:
    """Whether a conversion, or one that it refers to, is a text that would be executed."""
    if conversion is None:
        return False
    formula: Any = getattr(conversion, "formula", "")
    if depth > 8 or formula:
        return True
    inner: Any = getattr(conversion, "referenced_blocks", None)
    return any(_has_formula(one, depth + 1) for one in (inner or {}).values() if not isinstance(one, str | bytes))


MDF = FileFormat((".mf4", ".mdf"), read)

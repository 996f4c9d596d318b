"""The channels of ASAM MDF files, by asammdf, in a process of its own: run there, this file imports nothing of ours.

asammdf's compiled code takes what a file says of itself on trust, and ends the process over damaged files.

The process reads paths, a line each, and answers each with a header (its length in eight bytes, then JSON) and the
bytes of the columns that it names.
"""

from __future__ import annotations

import io
import json
import os
import struct
import sys
from collections import Counter
from typing import Any

import numpy as np

__all__ = ["Group", "groups"]

Group = dict[str, Any]
"""``name``, ``columns`` (name to values, rows along the first axis), ``units``, and ``told``, sentences."""

_SYNC_UNITS = {1: "s", 2: "rad", 3: "m"}
"""What a master channel counts, by its type of synchronisation, and the unit that the specification gives it."""

_MOST_CHANNELS = 4096


def groups(path: str) -> tuple[list[Group], list[str]]:
    """The groups of channels of a file that have rows, and what is to be told of the file.

    Raises:
        Exception: as asammdf does over damaged files.
    """
    import asammdf

    found: list[Group] = []
    told: list[str] = []
    with open(path, "rb") as stream:  # noqa: PTH123 - as bytes: a path would be copied where the file was not closed
        closed = stream.read(8) != b"UnFinMF "
        stream.seek(0)
        # asammdf writes what is missing into a file that was not closed: it gets the content in memory
        with asammdf.MDF(stream if closed else io.BytesIO(stream.read())) as file:
            names = _names(file)
            for place in file.virtual_groups:
                group, said = _group_or_why(file, place, names[place])
                found += [group] if group else []
                told += [said] if said else []
    return found, told


def _names(file: Any) -> dict[int, str]:
    """A name for each group, each once."""
    found = {}
    seen: Counter[str] = Counter()
    for place in file.virtual_groups:
        group = file.groups[place].channel_group
        source: Any = getattr(group, "acq_source", None)
        name = str(getattr(group, "acq_name", "") or (source and source.name) or f"group_{place}").strip()
        seen[name] += 1
        found[place] = name if seen[name] == 1 else f"{name} ({seen[name]})"
    return found


def _group_or_why(file: Any, place: int, name: str) -> tuple[Group | None, str]:
    """A group; where its blocks are damaged, a sentence that says so, and the other groups stay."""
    try:
        return _group(file, place, name), ""
    except Exception as error:  # the library raises what comes
        lines = str(error).strip().splitlines() or [type(error).__name__]
        return None, f"Group {name} cannot be read and is left out ({lines[0][:100]})."


def _group(file: Any, place: int, name: str) -> Group | None:
    chosen, told, formulas, rows = [], [], [], 0
    for number in file.virtual_groups[place].groups:
        channels = file.groups[number].channels
        if not file.groups[number].channel_group.cycles_nr:
            continue
        rows = max(rows, int(file.groups[number].channel_group.cycles_nr))
        for index, channel in enumerate(channels[:_MOST_CHANNELS]):
            if index == file.masters_db.get(number):
                continue
            if _has_formula(channel.conversion, 0):
                formulas.append(channel.name)
            else:
                chosen.append((None, number, index))
    if formulas:
        names = ", ".join(f"`{one}`" for one in formulas[:8])
        told.append(f"{names}: converted by a formula in words, which is not executed, left out.")
    if not chosen:
        return None
    signals = file.select(chosen, ignore_value2text_conversions=True, validate=False)
    master, unit = _master(file, place)
    times = np.asarray(signals[0].timestamps)
    columns: dict[str, np.ndarray] = {master: times} if master else {}
    units = {master: unit}
    if len(times) < rows:
        told.append(
            f"The file is damaged or cut off: {rows - len(times):,} of the {rows:,} rows of {name} are missing."
        )
    for signal in signals:
        if signal.name in columns or len(signal.samples) != len(times):
            told.append(f"Channel `{signal.name}` stands twice, or has another length, and is left out.")
            continue
        parts = _parts(signal)
        columns |= parts
        units |= dict.fromkeys(parts, str(signal.unit or ""))
    return {"name": name, "columns": columns, "units": units, "told": told}


def _parts(signal: Any) -> dict[str, np.ndarray]:
    """The columns of a channel: one, or those of its structure; invalid values are NaN."""
    samples = np.asarray(signal.samples)
    parts = {signal.name: samples}
    if samples.dtype.names:
        parts = {
            signal.name if field == signal.name else f"{signal.name}.{field}": samples[field]
            for field in samples.dtype.names
        }
    invalid = signal.invalidation_bits
    if invalid is None or not np.any(invalid):
        return parts
    bad = np.asarray(invalid, dtype=bool)
    return {
        name: np.where(bad, np.nan, values.astype(np.float64)) if values.dtype.kind in "biuf" else values
        for name, values in parts.items()
    }


def _master(file: Any, place: int) -> tuple[str, str]:
    """The name of a group's master channel and its unit; of a group without one, none."""
    for number in file.virtual_groups[place].groups:
        index = file.masters_db.get(number)
        if index is not None:
            channel = file.groups[number].channels[index]
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


def _answer(path: str) -> bytes:
    try:
        found, told = groups(path)
    except Exception as error:  # the library raises what comes
        lines = str(error).strip().splitlines() or [type(error).__name__]
        return _framed({"error": lines[0][:120]}, [])
    blocks = []
    for group in found:
        described = []
        for name, values in group["columns"].items():
            plain = np.ascontiguousarray(values.astype("U") if values.dtype == object else values)
            blocks.append(plain.tobytes())
            described.append([name, plain.dtype.str, plain.shape])
        group["columns"] = described
    return _framed({"groups": found, "told": told}, blocks)


def _framed(header: dict[str, Any], blocks: list[bytes]) -> bytes:
    text = json.dumps(header).encode()
    return b"".join([struct.pack("<Q", len(text)), text, *blocks])


def _serve() -> None:
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the library prints is no answer
    for line in sys.stdin:
        answers.write(_answer(json.loads(line)))
        answers.flush()


if __name__ == "__main__":
    _serve()

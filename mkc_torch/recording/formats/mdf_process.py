"""Read the channels of ASAM MDF files by asammdf in a separate process; this module imports nothing of mkc_torch.

asammdf's compiled code does not validate a file's own statements, and crashes the process over damaged files.

The process reads paths from stdin, a line each. It replies to each with a header (its length in eight bytes, then JSON)
and the bytes of the columns that the header lists.
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

Group = dict[str, Any]
"""Keys: ``name``, ``columns`` (name to values, rows along the first axis), ``units`` and ``warnings``."""

_SYNC_UNITS = {1: "s", 2: "rad", 3: "m"}
"""Units of master channels by synchronisation type, from the specification."""

_MOST_CHANNELS = 4096


def groups(path: str) -> tuple[list[Group], list[str]]:
    """Read the channel groups of a file that have rows, and warnings about the file.

    Raises:
        Exception: any error of asammdf over a damaged file.
    """
    import asammdf

    found: list[Group] = []
    warnings: list[str] = []
    with open(path, "rb") as stream:  # noqa: PTH123 - a stream, because asammdf copies an unclosed file given by path
        closed = stream.read(8) != b"UnFinMF "
        stream.seek(0)
        # asammdf repairs an unclosed file in place: give it a copy in memory
        with asammdf.MDF(stream if closed else io.BytesIO(stream.read())) as file:
            names = _names(file)
            for place in file.virtual_groups:
                group, reason = _group_or_why(file, place, names[place])
                found += [group] if group else []
                warnings += [reason] if reason else []
    return found, warnings


def _names(file: Any) -> dict[int, str]:
    """A unique name for each group."""
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
    """Read a group; if its blocks are damaged, return None and a warning."""
    try:
        return _group(file, place, name), ""
    except Exception as error:  # the library raises arbitrary errors
        lines = str(error).strip().splitlines() or [type(error).__name__]
        return None, f"Group {name} cannot be read and is left out ({lines[0][:100]})."


def _group(file: Any, place: int, name: str) -> Group | None:
    chosen, warnings, formulas, rows = [], [], [], 0
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
        names = ", ".join(f"`{formula}`" for formula in formulas[:8])
        warnings.append(f"{names}: converted by a formula in text, which is not executed; left out.")
    if not chosen:
        return None
    signals = file.select(chosen, ignore_value2text_conversions=True, validate=False)
    master, unit = _master(file, place)
    times = np.asarray(signals[0].timestamps)
    columns: dict[str, np.ndarray] = {master: times} if master else {}
    units = {master: unit}
    if len(times) < rows:
        warnings.append(
            f"The file is damaged or cut off: {rows - len(times):,} of the {rows:,} rows of {name} are missing."
        )
    for signal in signals:
        if signal.name in columns or len(signal.samples) != len(times):
            warnings.append(f"Channel `{signal.name}` is a duplicate or has another length, and is left out.")
            continue
        parts = _parts(signal)
        columns |= parts
        units |= dict.fromkeys(parts, str(signal.unit or ""))
    return {"name": name, "columns": columns, "units": units, "warnings": warnings}


def _parts(signal: Any) -> dict[str, np.ndarray]:
    """The columns of a channel: its values, or a column for each field of a structure; invalid values are NaN."""
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
    """The name and unit of a group's master channel; empty without a master channel."""
    for number in file.virtual_groups[place].groups:
        index = file.masters_db.get(number)
        if index is not None:
            channel = file.groups[number].channels[index]
            kind: Any = getattr(channel, "sync_type", None)  # versions 2 and 3 support only time
            return str(channel.name), str(channel.unit or "") or _SYNC_UNITS.get(kind or 1, "")
    return "", ""


def _has_formula(conversion: Any, depth: int) -> bool:
    """Whether a conversion, or a conversion that it refers to, is a text formula that would be executed."""
    if conversion is None:
        return False
    formula: Any = getattr(conversion, "formula", "")
    if depth > 8 or formula:
        return True
    inner: Any = getattr(conversion, "referenced_blocks", None)
    return any(_has_formula(block, depth + 1) for block in (inner or {}).values() if not isinstance(block, str | bytes))


def _reply(path: str) -> bytes:
    try:
        found, warnings = groups(path)
    except Exception as error:  # the library raises arbitrary errors
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
    return _framed({"groups": found, "warnings": warnings}, blocks)


def _framed(header: dict[str, Any], blocks: list[bytes]) -> bytes:
    text = json.dumps(header).encode()
    return b"".join([struct.pack("<Q", len(text)), text, *blocks])


def _serve() -> None:
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # keep the library's output out of the replies
    for line in sys.stdin:
        replies.write(_reply(json.loads(line)))
        replies.flush()


if __name__ == "__main__":
    _serve()

"""Lines that the gate prints: counts, recordings that are not right, and pairs that differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


def count_lines(result: Mapping[str, Any]) -> list[str]:
    """The counts of each part, and the total CPU seconds.

    Example:
        >>> count_lines({"counts": {"real": {"right": "1/2"}}, "recordings": {"real a": {"cpu_seconds": 2.0}}})
        ['real: right 1/2', '1 recordings, 2 CPU seconds, at most 2 (real a)']
    """
    lines = [
        f"{part}: {', '.join(f'{what} {count}' for what, count in c.items())}" for part, c in result["counts"].items()
    ]
    seconds = {name: row["cpu_seconds"] or 0.0 for name, row in result["recordings"].items()}
    if seconds:
        slowest = max(seconds, key=seconds.__getitem__)
        total, most = sum(seconds.values()), seconds[slowest]
        lines.append(f"{len(seconds)} recordings, {total:.0f} CPU seconds, at most {most:.0f} ({slowest})")
    return lines


def wrong_lines(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Recordings that are not right, with the reasons, and draws that failed."""
    lines = []
    for name, row in rows.items():
        if row.get("wrong"):
            lines.append(f"  not right: {name}: {'; '.join(row['wrong'])}")
        elif row.get("failed"):
            lines.append(f"  failed: {name}: {row['failed']}")
        elif row.get("false_alarm"):
            lines.append(f"  false alarm: {name}: {', '.join(entry['effect'] for entry in row['findings'])}")
    return lines


def compared_lines(
    stored: Mapping[str, Any], found: Mapping[str, Any], differing: Mapping[str, Sequence[str]]
) -> list[str]:
    """The pairs that differ, the counts of both runs, and the CPU seconds of the recordings that both have."""
    both = [name for name in stored["recordings"] if name in found["recordings"]]
    lines = [f"compared: {len(differing)} of {len(both)} pairs differ"]
    lines += [f"  {name}: {'; '.join(changes)}" for name, changes in differing.items()]
    for part, counts in stored["counts"].items():
        for what, count in counts.items():
            now = found["counts"].get(part, {}).get(what)
            if now not in (None, count):
                lines.append(f"  {part}: {what} {count} -> {now}")
    timed = [n for n in both if all(run["recordings"][n]["cpu_seconds"] is not None for run in (stored, found))]
    old, new = (sum(run["recordings"][name]["cpu_seconds"] for name in timed) for run in (stored, found))
    return [*lines, f"  CPU seconds of the same {len(timed)} recordings: {old:.0f} -> {new:.0f}"]

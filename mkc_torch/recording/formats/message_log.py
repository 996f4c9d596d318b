"""Collect the messages of ROS bags and MCAP files into a table for each topic."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import Topic, counted
from mkc_torch.recording.formats.message_rows import LARGEST_MESSAGE, Cell, MessageRows

LOG_TIME = "log_time"
_PUBLISH_TIME = "publish_time"
_STAMP = "header.stamp"


class MessageLog:
    """Collects messages by topic; a topic of several publishers is a single table in the order of ``log_time``.

    Times are in ns. ``header.stamp`` is the sensor's own time if the message has a header; ``log_time`` is when the
    logger received the message; ``publish_time`` is when it was sent, if that differs.
    """

    def __init__(self) -> None:
        self._readers: dict[object, tuple[str, Callable[[bytes], Mapping[str, Cell]], MessageRows]] = {}
        self._rows: dict[tuple[str, str], MessageRows] = {}
        self._left_out: dict[str, str] = {}
        self._failed: Counter[str] = Counter()
        self._large: Counter[str] = Counter()

    def __contains__(self, key: object) -> bool:
        return key in self._readers

    def open(
        self, key: object, topic: str, kind: str, read: Callable[[bytes], Mapping[str, Cell]], units: Mapping[str, str]
    ) -> None:
        """Register the topic, type, reader and units of the messages under ``key``."""
        known = {**units, LOG_TIME: "ns", _PUBLISH_TIME: "ns"}
        rows = self._rows.setdefault((topic, kind), MessageRows(topic, known))
        self._readers[key] = topic, read, rows

    def leave_out(self, topic: str, why: str) -> None:
        """Note that a topic cannot be read; ``why`` completes the sentence "Topic … is left out: …"."""
        self._left_out[topic] = why

    def add(self, key: object, data: bytes, log_time: int, publish_time: int | None = None) -> None:
        """Add a message; messages of topics that were not opened are ignored."""
        if key not in self._readers:
            return
        topic, read, rows = self._readers[key]
        if len(data) > LARGEST_MESSAGE:
            self._large[topic] += 1
            return
        try:
            values = dict(read(data))
        except Exception:  # decoders raise arbitrary errors over invalid bytes
            self._failed[topic] += 1
            return
        times = {LOG_TIME: log_time}
        if publish_time is not None and publish_time != log_time:
            times[_PUBLISH_TIME] = publish_time
        rows.add({**values, **times})

    def topics(self) -> tuple[list[Topic], list[str]]:
        """Return all tables, and warnings about the file."""
        topics = []
        names = Counter(name for name, _ in self._rows)
        for (name, kind), rows in self._rows.items():
            left_out = []
            if failed := self._failed[name]:
                left_out.append(f"{counted(failed, 'message')} could not be read and {_are(failed)} left out.")
            if large := self._large[name]:
                left_out.append(f"{counted(large, 'message')} of more than 64 KiB {_are(large)} left out.")
            topic = rows.topic((_STAMP, LOG_TIME, _PUBLISH_TIME), LOG_TIME, left_out)
            if topic is not None and set(topic.table.names) - {LOG_TIME, _PUBLISH_TIME}:
                topics.append(topic if names[name] == 1 else topic._replace(name=f"{name} ({kind})"))
            elif left_out:
                self._left_out[name] = left_out[0][0].lower() + left_out[0][1:-1]
        # names in a damaged file may contain line breaks
        warnings: list[str] = [
            Note(" ".join(f"Topic {name} is left out: {why}.".split())) for name, why in self._left_out.items()
        ]
        return topics, warnings


def _are(count: int) -> str:
    return "is" if count == 1 else "are"

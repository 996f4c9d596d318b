"""Recordings: tables of named columns with units and times."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.arrays import ArrayLike, Data, is_frame
from mkc_torch._support.files import write_atomically
from mkc_torch._support.note import Note, notes_of, warnings_of
from mkc_torch.recording.conversions import DEFAULT_UNITS
from mkc_torch.recording.formats import check_ending, encoded
from mkc_torch.recording.formats.base import MissingColumnError, RecordingError, Topic, listed
from mkc_torch.recording.given_columns import EXPERIMENT, checked_columns, columns_of_frame, table_of_frame
from mkc_torch.recording.load import REQUIRED_COLUMNS, load_table, read_file
from mkc_torch.recording.missing_axes import without_values
from mkc_torch.recording.preview import TablePreview
from mkc_torch.recording.row_sensors import with_row_sensors
from mkc_torch.recording.time_order import note_if_few, time_order

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["DEFAULT_UNITS", "MissingColumnError", "Recording", "RecordingError", "write_table"]


class Recording(TablePreview):
    """A table of named columns of equal length, as a sensor or a simulator wrote it.

    A recording is immutable: each operation returns a new recording, whose ``warnings`` and ``notes`` list what was
    dropped.

    Args:
        columns: name to values: 1-D tensors or NumPy arrays of equal length >= 1, copied to the CPU as float64;
            or a DataFrame, whose columns keep their names and numbers (:meth:`from_frame` recognises and converts).
        name: name in messages and reports; for a file, the stem of its path.
        units: column to unit; these override the defaults: ``time`` s; ``mag_*`` and ``field_*`` µT;
            ``gyro_*`` rad/s; ``accel_*`` m/s²; ``position_*`` m; ``q_*`` 1; ``temperature`` °C; ``current`` A.
        warnings: what makes the data doubtful, a sentence each.
        labels: for a column of whole numbers 0, 1, …, the label of each number.
        notes: how the data were read, a sentence each.

    Raises:
        RecordingError: no columns, no samples, unequal lengths, an unusable name, or a unit of an unknown column.

    Example:
        >>> recording = Recording({"time": torch.tensor([0.0, 0.1]), "mag_x": torch.tensor([20.0, 21.0])})
        >>> recording["mag_x"], recording.units["mag_x"]
        (tensor([20., 21.], dtype=torch.float64), 'µT')
    """

    __slots__ = ("_columns", "_labels", "_name", "_sentences", "_units")

    def __init__(
        self,
        columns: Mapping[str, Data] | ArrayLike,
        *,
        name: str = "",
        units: Mapping[str, str] | None = None,
        warnings: Sequence[str] = (),
        labels: Mapping[str, Sequence[str]] | None = None,
        notes: Sequence[str] = (),
    ) -> None:
        units, labels = units or {}, labels or {}
        if is_frame(columns):
            frame = columns_of_frame(columns, {}, REQUIRED_COLUMNS, name)
            columns, labels, warnings = frame.columns, frame.labels | dict(labels), (*frame.warnings, *warnings)
        given = checked_columns(cast("Mapping[str, Data]", columns), name)
        for column in (*units, *labels):
            if column not in given:
                raise _missing(column, given, name)
        copies = {key: values.detach().to("cpu", torch.float64, copy=True) for key, values in given.items()}
        known = {key: DEFAULT_UNITS.get(key, "") for key in given}
        self._columns = copies
        self._units = known | dict(units)
        self._labels = {key: tuple(values) for key, values in labels.items()}
        self._name = name
        self._sentences = (*warnings, *map(Note, notes))

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        *,
        columns: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        sensor: str | None = None,
        recognise: bool = True,
    ) -> Recording:
        """Read a table from a file: text (``.csv``, ``.tsv``, ``.txt``), Parquet (``.parquet``), or a log.

        Separators, decimals and encodings of text are detected. A magnetometer, the sensors recorded with it and the
        time are recognised by the names of their columns, and converted if the name or the format states the unit.
        Where the time starts again, a new run begins; the column ``experiment`` numbers the runs. Empty cells, ``nan``,
        ``NA``, ``n/a`` and ``null`` become NaN. Columns of text are left out unless ``columns`` names them. Text in the
        column ``experiment`` is numbered, with the text in ``labels``. ``notes`` reports all of this, and ``warnings``
        what makes the data doubtful.

        Args:
            path: the file.
            columns: new name to the name in the file: ``{"mag_x": "mx"}``.
            units: quantity or column to the unit it is converted from: ``{"mag": "gauss", "time": "us"}``. An unknown
                unit of the magnetometer, such as counts, is only a label: nothing is converted.
            sensor: the magnetometer to read if the file holds several.
            recognise: False keeps the column names of the file and recognises only the time.

        Returns:
            The recording, with its rows in the order of the file.

        Raises:
            RecordingError: the file is not a readable table: of an unknown kind, empty, without header or rows, with
                lines of different length, columns of the same name, text among numbers, or several magnetometers.
            MissingColumnError: ``columns`` or ``units`` names a column that the file does not have.
            FileNotFoundError: there is no such file.
            ImportError: the library that reads this format is not installed.
        """
        path = Path(path)
        found = read_file(path, REQUIRED_COLUMNS, columns=columns, units=units, sensor=sensor, recognise=recognise)
        return cls(found.columns, name=path.stem, units=found.units, warnings=found.warnings, labels=found.labels)

    @classmethod
    def from_frame(
        cls,
        frame: ArrayLike,
        *,
        columns: Mapping[str, str] | None = None,
        name: str = "",
        units: Mapping[str, str] | None = None,
        sensor: str | None = None,
        recognise: bool = True,
    ) -> Recording:
        """Convert a DataFrame of pandas or polars, with the recognition, conversion and warnings of :meth:`read`.

        Missing values become NaN; time stamps become seconds from the first sample. A named index, such as ``time``,
        is a column too. Polars is needed for pandas frames too.

        Args:
            frame: the table.
            columns: new name to the name in the frame: ``{"mag_x": "mx"}``.
            name: name of the recording.
            units, sensor, recognise: as in :meth:`read`.

        Raises:
            RecordingError: a frame without rows or numbers, duplicate or missing column names, text or times where
                numbers are needed, or several magnetometers.
            MissingColumnError: ``columns`` or ``units`` names a column that the frame does not have.
            ImportError: polars is not installed.

        Example:
            >>> import pandas as pd
            >>> frame = pd.DataFrame(
            ...     {
            ...         "stamp": pd.to_datetime(["2024-05-03 10:00", "2024-05-03 10:01"]),
            ...         "mx [mG]": [200, 210],
            ...         "my [mG]": [0, 1],
            ...         "mz [mG]": [5, 5],
            ...     }
            ... )
            >>> recording = Recording.from_frame(frame)
            >>> recording.time, recording["mag_x"]
            (tensor([ 0., 60.], dtype=torch.float64), tensor([20., 21.], dtype=torch.float64))
        """
        topics = [Topic("", table_of_frame(frame, name))]
        if recognise:
            topics = with_row_sensors(topics)
        found = load_table(
            Path(name or "the frame"),
            topics,
            REQUIRED_COLUMNS,
            columns=columns,
            units=units,
            sensor=sensor,
            recognise=recognise,
            what="frame",
        )
        return cls(found.columns, name=name, units=found.units, warnings=found.warnings, labels=found.labels)

    @property
    def columns(self) -> Mapping[str, Tensor]:
        """Name to values, in the table's order; do not write into the tensors."""
        return MappingProxyType(self._columns)

    @property
    def names(self) -> tuple[str, ...]:
        """The columns' names, in the table's order."""
        return tuple(self._columns)

    @property
    def name(self) -> str:
        return self._name

    @property
    def units(self) -> Mapping[str, str]:
        """The unit of each column; empty if it is unknown."""
        return MappingProxyType(self._units)

    @property
    def labels(self) -> Mapping[str, tuple[str, ...]]:
        """For each labelled column, the labels of its numbers 0, 1, …."""
        return MappingProxyType(self._labels)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes the data doubtful, a sentence each: lost parts, gaps, samples out of order."""
        return warnings_of(self._sentences)

    @property
    def notes(self) -> tuple[str, ...]:
        """How the data were read, a sentence each: recognised names, converted units, what was skipped."""
        return notes_of(self._sentences)

    @property
    def time(self) -> Float[Tensor, " N"] | None:
        """The column ``time`` in seconds; None if there is no such column."""
        return self._columns.get("time")

    def __len__(self) -> int:
        return len(next(iter(self._columns.values())))

    def __contains__(self, name: object) -> bool:
        return name in self._columns

    def __getitem__(self, name: str) -> Float[Tensor, " N"]:
        if name not in self._columns:
            raise _missing(name, self._columns, self._name)
        return self._columns[name]

    def stack(self, *names: str) -> Float[Tensor, "N k"]:
        """The named columns side by side, as a new tensor.

        Raises:
            MissingColumnError: a column does not exist; the message lists the existing columns.

        Example:
            >>> Recording({"a": torch.zeros(4), "b": torch.ones(4)}).stack("b", "a")[0]
            tensor([1., 0.], dtype=torch.float64)
        """
        if not names:
            raise ValueError("Expected at least one column name but got none.")
        return torch.stack([self[name] for name in names], dim=-1)

    def magnetometer(self) -> Float[Tensor, "N 3"]:
        """The columns ``mag_x``, ``mag_y``, ``mag_z``."""
        return self.stack("mag_x", "mag_y", "mag_z")

    def finite(self, *names: str) -> Recording:
        """The rows in which the named columns are finite; ``warnings`` counts the dropped rows.

        Args:
            names: columns to check; all columns if empty.

        Raises:
            MissingColumnError: a column does not exist.
            RecordingError: no row remains.

        Example:
            >>> Recording({"a": torch.tensor([1.0, torch.nan, torch.inf])}).finite("a").warnings
            ('Dropped 2 of 3 samples that are not finite: `a` 1 NaN, 1 infinite.',)
        """
        names = names or self.names
        keep = self.stack(*names).isfinite().all(-1)
        if keep.all():
            return self
        counts = []
        for name in dict.fromkeys(names):
            nan, infinite = int(self[name].isnan().sum()), int(self[name].isinf().sum())
            found = [f"{count} {what}" for count, what in ((nan, "NaN"), (infinite, "infinite")) if count]
            counts += [f"`{name}` {', '.join(found)}"] if found else []
        if not keep.any():
            raise RecordingError(
                f"{self._in()}no sample has finite values in all of {listed(names)}: {'; '.join(counts)}. "
                f"{without_values([name for name in names if not bool(self[name].isfinite().any())])}"
            )
        lost = int((~keep).sum())
        dropped = f"Dropped {lost} of {len(self)} samples that are not finite: {'; '.join(counts)}."
        return self.rows(keep, note_if_few(dropped, lost, len(self)))

    def sorted_by_time(self) -> Recording:
        """The samples sorted by time, with one sample per time.

        The sort is stable; of samples with the same time the first is kept. ``warnings`` counts samples out of order,
        repeated times, samples without a finite time, and gaps longer than ten median intervals. With a column
        ``experiment``, each run is sorted by its own clock, and the runs keep the order of their first appearance.

        Raises:
            MissingColumnError: there is no column ``time``.
            RecordingError: no sample has a finite time.

        Example:
            >>> Recording({"time": torch.tensor([0.0, 0.2, 0.1, 0.1])}).sorted_by_time().time
            tensor([0.0000, 0.1000, 0.2000], dtype=torch.float64)
        """
        timed = self._with_times()
        table = timed.stack(*timed.names).numpy()
        kept, sentences = time_order(timed["time"].numpy(), timed._experiment_numbers(), table, timed._run_label)
        return timed.rows(torch.from_numpy(kept), *sentences)

    def rows(self, chosen: Tensor, *warnings: str) -> Recording:
        """The chosen rows, as a new recording.

        Args:
            chosen: boolean mask (N,), or row indices in the new order.
            warnings: sentences to add to the recording's warnings.

        Example:
            >>> Recording({"a": torch.tensor([1.0, 2.0, 3.0])}).rows(torch.tensor([2, 0]))["a"]
            tensor([3., 1.], dtype=torch.float64)
        """
        return Recording(
            {name: values[chosen] for name, values in self._columns.items()},
            name=self._name,
            units=self._units,
            warnings=(*self._sentences, *warnings),
            labels=self._labels,
        )

    def experiments(self) -> dict[str, Recording]:
        """The runs of the table by the label of the column ``experiment``, in the order of appearance.

        Without that column the only run is the whole table, under the recording's name.

        Example:
            >>> table = Recording({"experiment": torch.tensor([1, 1, 2]), "time": torch.tensor([0.0, 0.1, 0.0])})
            >>> [(label, len(part), part.names) for label, part in table.experiments().items()]
            [('1', 2, ('time',)), ('2', 1, ('time',))]
        """
        if EXPERIMENT not in self:
            return {self._name: self}
        group = torch.from_numpy(self._experiment_numbers())
        parts = {}
        for number in range(int(group.max()) + 1):
            part = self.rows(group == number)
            label = self._experiment_label(part[EXPERIMENT][0].item())
            parts[label] = Recording(
                {key: values for key, values in part.columns.items() if key != EXPERIMENT},
                name=f"{self._name}/{label}" if self._name else label,
                units={key: unit for key, unit in self._units.items() if key != EXPERIMENT},
                warnings=self._sentences,
                labels={key: values for key, values in self._labels.items() if key != EXPERIMENT},
            )
        return parts

    def _in(self) -> str:
        return f"{self._name}: " if self._name else ""

    def _with_times(self) -> Recording:
        keep = self["time"].isfinite()
        if keep.all():
            return self
        if not keep.any():
            raise RecordingError(f"{self._in()}no sample has a finite time; the column `time` must hold seconds.")
        lost = int((~keep).sum())
        return self.rows(
            keep, note_if_few(f"Dropped {lost} of {len(self)} samples without a finite time.", lost, len(self))
        )

    def _experiment_numbers(self) -> np.ndarray:
        """Run index 0, 1, … of each sample, (N,), in the order of first appearance."""
        if EXPERIMENT not in self:
            return np.zeros(len(self), dtype=np.int64)
        _, first, inverse = np.unique(self[EXPERIMENT].numpy(), return_index=True, return_inverse=True)
        return np.argsort(np.argsort(first))[inverse]

    def _experiment_label(self, value: float) -> str:
        known = self._labels.get(EXPERIMENT, ())
        if value.is_integer() and 0 <= value < len(known):
            return known[int(value)]
        return str(int(value)) if value.is_integer() else repr(value)

    def _run_label(self, group: int) -> str:
        """The label of a run by its index; empty without the column ``experiment``."""
        if EXPERIMENT not in self:
            return ""
        values = self[EXPERIMENT].numpy()[self._experiment_numbers() == group]
        return self._experiment_label(float(values[0]))


def write_table(
    path: str | os.PathLike[str],
    columns: Mapping[str, Data] | ArrayLike,
    *,
    labels: Mapping[str, Sequence[str]] | None = None,
    overwrite: bool = False,
) -> None:
    """Write columns to a file atomically; :meth:`Recording.read` returns the same float64 values.

    Args:
        path: the target; its ending selects the format: ``.csv``, ``.tsv``, ``.txt`` (a CSV) or ``.parquet``.
        columns: as in :class:`Recording`; ``recording.columns`` for a recording.
        labels: for a column of whole numbers 0, 1, …, the label of each, which is written instead;
            ``recording.labels`` for a recording.
        overwrite: replace an existing file.

    Raises:
        RecordingError: the columns are not a table, or the ending is unknown.
        FileExistsError: the file exists and ``overwrite`` is False.
    """
    path = Path(path)
    check_ending(path)
    table = Recording(columns, name=path.name)
    known = labels or {}
    encodable = {
        name: np.array(known[name])[values.long().numpy()] if name in known else values.numpy()
        for name, values in table.columns.items()
    }
    if EXPERIMENT in encodable and EXPERIMENT not in known:
        encodable[EXPERIMENT] = _whole(encodable[EXPERIMENT])
    data = encoded(path, encodable)
    write_atomically(path, data, overwrite=overwrite)


def _whole(numbers: np.ndarray) -> np.ndarray:
    """Run numbers as integers (1, not 1.0) if all of them are whole."""
    whole = np.isfinite(numbers) & (np.abs(numbers) < 2**53) & (numbers == np.round(numbers))
    return numbers.astype(np.int64) if whole.all() else numbers


def _missing(name: str, present: Iterable[str], recording: str) -> MissingColumnError:
    where, present = f"{recording}: " if recording else "", list(present)
    like = {column.casefold(): column for column in present if column not in DEFAULT_UNITS}
    nearest = next((like[key] for key in get_close_matches(name.casefold(), like, 1, 0.55)), "COLUMN")
    if name == "time" and nearest == "COLUMN" and "t" in present:
        nearest = "t"
    return MissingColumnError(
        f"{where}there is no column `{name}`; there are {listed(present)}. If it has another name, give that name, "
        f'such as `--columns {name}={nearest}` (in Python `columns={{"{name}": "{nearest}"}}`).'
    )

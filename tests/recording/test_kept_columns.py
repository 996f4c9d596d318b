"""`mkc apply` writes the columns of the file unchanged, in addition to its own columns."""

import csv
import datetime
import io

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

pytest.importorskip("polars")

import polars

from mkc_torch.recording.kept_columns import write_with_columns
from mkc_torch.recording.recording import Recording

NEW = {"field_x": torch.tensor([1.0, 2.0, float("nan")], dtype=torch.float64)}
NANOSECONDS = [1735689600000000001, 1735689600000000002, None]


@pytest.fixture
def typed_parquet(tmp_path):
    """A Parquet file with columns of every type that loggers write."""
    day = datetime.date(2026, 1, 1)
    frame = polars.DataFrame(
        {
            "stamp": polars.Series(NANOSECONDS).cast(polars.Datetime("ns", "UTC")),
            "day": [day, day, None],
            "elapsed": polars.Series([1, 2, None]).cast(polars.Duration("us")),
            "count": polars.Series([2**62 + 1, None, 3], dtype=polars.Int64),
            "short": polars.Series([0.1, None, 1e-7], dtype=polars.Float32),
            "long": [0.1 + 0.2, None, 1e22],
            "flag": [True, None, False],
            "word": ["a, b", None, '"'],
            "serial": ["007", "1.50", None],
            "kind": polars.Series(["x", "y", "x"], dtype=polars.Categorical),
            "price": polars.Series(["1.10", "2.20", None]).str.to_decimal(scale=2),
            "list": [[1, 2], [3], None],
        }
    )
    path = tmp_path / "in.parquet"
    frame.write_parquet(path)
    return path, frame


def read_csv(path):
    text = path.read_text(encoding="utf-8")
    return list(csv.reader(io.StringIO(text), delimiter="\t" if path.suffix == ".tsv" else ","))


def test_types_and_missing_values_of_parquet_are_kept(typed_parquet, tmp_path):
    source, frame = typed_parquet
    target = tmp_path / "deep" / "out.parquet"
    target.parent.mkdir()
    write_with_columns(source, target, NEW)
    written = polars.read_parquet(target)
    assert written.drop("field_x").equals(frame, null_equal=True)
    assert dict(written.drop("field_x").schema) == dict(frame.schema)
    assert written.columns[-1] == "field_x"


@pytest.mark.parametrize("ending", ["csv", "tsv"])
def test_parquet_becomes_text_with_all_its_digits(typed_parquet, tmp_path, ending):
    source, frame = typed_parquet
    target = tmp_path / f"out.{ending}"
    write_with_columns(source, target, NEW)
    header, *rows = read_csv(target)
    cells = dict(zip(header, zip(*rows, strict=True), strict=True))
    assert header == [*frame.columns, "field_x"]
    assert cells["stamp"][:2] == tuple(f"2025-01-01 00:00:00.00000000{k}+00:00" for k in (1, 2))
    assert cells["day"] == ("2026-01-01", "2026-01-01", "")
    assert cells["elapsed"] == ("PT0.000001S", "PT0.000002S", "")
    assert cells["count"] == (str(2**62 + 1), "", "3")
    assert cells["short"] == ("0.1", "", "1e-7")
    assert [float(cells["long"][k]) for k in (0, 2)] == [0.1 + 0.2, 1e22]
    assert cells["flag"] == ("true", "", "false")
    assert cells["word"] == ("a, b", "", '"')
    assert cells["serial"] == ("007", "1.50", "")
    assert cells["kind"] == ("x", "y", "x")
    assert cells["price"] == ("1.10", "2.20", "")
    assert cells["list"] == ("[1, 2]", "[3]", "")


def test_text_becomes_numbers_in_parquet_without_loss(tmp_path):
    source = tmp_path / "in.csv"
    source.write_text(
        "ns,value,serial,stamp,gone\n1735689600000000001,1.5,007,2026-01-01T00:00:00,\n"
        "1735689600000000003,n/a,8,2026-01-01T00:00:01,\n",
        encoding="utf-8",
    )
    target = tmp_path / "out.parquet"
    write_with_columns(source, target, {"field_x": torch.ones(2)})
    written = polars.read_parquet(target)
    assert written["ns"].to_list() == [1735689600000000001, 1735689600000000003]
    assert written["value"].to_list() == [1.5, None]
    assert written["serial"].to_list() == ["007", "8"]
    assert written["stamp"].to_list() == ["2026-01-01T00:00:00", "2026-01-01T00:00:01"]
    assert written["gone"].to_list() == [None, None]
    assert Recording.read(target)["value"][0] == 1.5


def test_columns_without_a_name_are_kept(tmp_path):
    """Such as the index column of pandas, or the empty column after a trailing separator."""
    source = tmp_path / "in.csv"
    source.write_text(",mag_x,\n0,1.50,\n1,2.50,\n", encoding="utf-8")
    for ending in ("csv", "parquet"):
        target = tmp_path / f"out.{ending}"
        write_with_columns(source, target, {"field_x": torch.ones(2)})
        assert Recording.read(target).names == ("mag_x", "field_x")
    header, *rows = read_csv(tmp_path / "out.csv")
    assert [name.strip() for name in header] == ["", "mag_x", "", "field_x"]
    assert rows == [["0", "1.50", "", "1.0"], ["1", "2.50", "", "1.0"]]


def test_an_existing_column_of_the_same_name_is_replaced_in_place(tmp_path):
    source = tmp_path / "in.csv"
    source.write_text("field_x,a\n9,1\n9,2\n", encoding="utf-8")
    assert write_with_columns(source, tmp_path / "out.csv", {"field_x": torch.ones(2)}) == ("field_x", "a")
    assert read_csv(tmp_path / "out.csv") == [["field_x", "a"], ["1.0", "1"], ["1.0", "2"]]


# typographic minus signs are read as minus signs, with a warning
letters = st.characters(exclude_categories=("Cs", "Cc", "Zl", "Zp"), exclude_characters="\u2212")
cell = st.text(letters, max_size=8)
first = cell.filter(lambda text: not text.strip().startswith(("#", "%", "//", ";")))  # not a comment


@settings(max_examples=40)
@example(rows=[("", "0A")])  # a unit stays in its cell
@example(rows=[("a", "b 0")])  # a blank separates no cells here
@given(rows=st.lists(st.tuples(first, cell), min_size=1, max_size=6))
def test_every_cell_of_a_csv_is_written_unchanged(tmp_path_factory, rows):
    folder = tmp_path_factory.mktemp("cells")
    source, target = folder / "in.csv", folder / "out.csv"
    with source.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [("word", "mag_x", "other"), *((a, "1.50", b) for a, b in rows)]
        )
    write_with_columns(source, target, {"field_x": torch.ones(len(rows))})
    assert read_csv(target)[1:] == [[a, "1.50", b, "1.0"] for a, b in rows]

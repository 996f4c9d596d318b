"""Arrays and data frames as tensors: numbers are kept, other data are refused by name."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from mkc_torch._support.arrays import as_tensor, as_tensors, column_names, refuse_other_columns

pd = pytest.importorskip("pandas")
pl = pytest.importorskip("polars")

NAN = float("nan")
FRAMES = [pd.DataFrame, pl.DataFrame]
each_frame = pytest.mark.parametrize("frame", FRAMES, ids=["pandas", "polars"])


def read_only(array):
    array.flags.writeable = False
    return array


def test_a_tensor_is_returned_unchanged():
    for value in (torch.ones(2), torch.ones(2).long(), torch.ones(2, dtype=torch.complex64)):
        assert as_tensor("X", value) is value


@pytest.mark.parametrize(
    ("value", "dtype"),
    [
        (np.array([1, 2]), torch.float64),
        (np.array([1, 2], dtype=np.uint8), torch.float64),
        (np.array([1.0, 2.0], dtype=np.float16), torch.float64),
        (np.array([1.0, 2.0], dtype=np.float32), torch.float32),
        (np.array([1.0, 2.0]), torch.float64),
        (np.array([1.0, 2.0], dtype=">f8"), torch.float64),
        (np.array([2.0, 1.0])[::-1], torch.float64),
        (read_only(np.array([1.0, 2.0])), torch.float64),
        (np.array([1.0, 2.0], dtype=np.longdouble), torch.float64),
        (np.ma.array([1.0, 2.0]), torch.float64),
        (pd.Series([1, 2]), torch.float64),
        (pd.Series([1, 2], dtype="Int64"), torch.float64),
        (pd.Series([1, 2], dtype="category"), torch.float64),
        (pd.Series([1.0, 2.0], dtype="float32"), torch.float32),
        (pl.Series([1, 2]), torch.float64),
        (pl.Series([1.0, 2.0], dtype=pl.Float32), torch.float32),
        (torch.nn.Parameter(torch.tensor([1.0, 2.0])).detach().numpy(), torch.float32),
    ],
)
def test_numbers_keep_their_value_and_float32_its_size(value, dtype):
    got = as_tensor("X", value)
    assert got.dtype == dtype
    assert got.tolist() == [1.0, 2.0]


def test_booleans_are_ones_and_zeros():
    assert as_tensor("X", np.array([True, False])).tolist() == [1.0, 0.0]


def test_memory_is_shared_except_of_read_only_arrays():
    array = np.zeros(2)
    as_tensor("X", array)[0] = 1.0
    assert array[0] == 1.0
    fixed = read_only(np.zeros(2))
    as_tensor("X", fixed)[0] = 1.0
    assert fixed[0] == 0.0


@each_frame
def test_a_frame_is_a_matrix_of_its_columns(frame):
    value = frame({"a": [1, 2, 3], "b": [True, False, True], "c": [0.5, NAN, 1.5]})
    want = torch.tensor([[1, 1, 0.5], [2, 0, NAN], [3, 1, 1.5]], dtype=torch.float64)
    torch.testing.assert_close(as_tensor("X", value), want, equal_nan=True)
    assert column_names(value) == ("a", "b", "c")
    assert as_tensor("X", frame({"a": np.ones(2, np.float32)})).dtype == torch.float32


def test_frames_without_text_labels_have_no_column_names():
    assert column_names(pd.DataFrame([[1, 2]])) is None
    assert column_names(pd.DataFrame(index=range(3))) is None
    assert column_names(pd.Series([1], name="a")) is None
    assert as_tensor("X", pd.DataFrame([[1, 2]], columns=["a", "a"])).tolist() == [[1.0, 2.0]]
    assert as_tensor("X", pd.DataFrame(index=range(3))).shape == (3, 0)


def test_a_compatible_frame_needs_columns_and_to_numpy_only():
    class Frame:
        columns = ("a", "b")

        def __len__(self):
            return 2

        def to_numpy(self):
            raise AssertionError("a frame is taken by columns")

        def __getitem__(self, name):
            return np.array([1, 2]) if name == "a" else np.array([3.0, 4.0])

    assert as_tensor("X", Frame()).tolist() == [[1.0, 3.0], [2.0, 4.0]]
    assert column_names(Frame()) == ("a", "b")


TIMES = np.array(["2020-01-01", "2020-01-02"], dtype="datetime64[ms]")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.array(["x", "y"]), r"argument `X` to hold real numbers but got text, 'x' say; encode it as numbers"),
        (np.array([1j]), r"argument `X` .* but got complex128; pass its real part"),
        (TIMES, r"argument `X` .* but got times; .* seconds since the first"),
        (TIMES - TIMES[0], r"argument `X` .* but got times"),
        (np.array([1.0, 2.0], dtype=object), r"numbers as Python objects; convert them, \.astype\(float\)"),
        (np.array([{}]), r"but got object of dict; convert it to numbers"),
        (pd.DataFrame({"a": [1], "b": ["x"]}), r"column `b` of argument `X` .* text, 'x' say"),
        (pd.DataFrame({"a": [1, 2], "b": ["x", None]}), r"column `b` of argument `X` .* text, 'x' say"),
        (pd.DataFrame({"a": [1, 2], "t": pd.to_datetime(TIMES)}), r"column `t` of argument `X` .* times"),
        (pd.DataFrame({"t": pd.to_datetime(TIMES, utc=True)}), r"column `t` of argument `X` .* times"),
        (pl.DataFrame({"a": [1], "b": ["x"]}), r"column `b` of argument `X` .* text, 'x' say"),
        (pl.DataFrame({"t": TIMES}), r"column `t` of argument `X` .* times"),
        (pl.DataFrame({"v": [[1.0], [2.0]]}), r"column `v` of argument `X` .* object of ndarray"),
        (pl.Series([1, 2], dtype=pl.Decimal(10, 2)), r"argument `X` .* object of Decimal"),
        (pd.Series(["x"], name="b"), r"column `b` of argument `X` .* text"),
        (pl.LazyFrame({"a": [1]}), r"argument `X` to be a tensor or an array but got LazyFrame"),
        ([1.0], r"argument `X` .* but got list; make a tensor of it, torch\.as_tensor\(X\)"),
        (1.0, r"argument `X` .* but got float"),
        (None, r"argument `X` .* but got NoneType; pass a tensor"),
    ],
)
def test_data_without_numbers_are_refused_by_name(value, message):
    with pytest.raises(TypeError, match=message):
        as_tensor("X", value)


@pytest.mark.parametrize(
    "value",
    [
        pd.DataFrame({"a": pd.array([1, None, 3], dtype="Int64")}),
        pd.DataFrame({"a": pd.array([1.0, None, 3.0], dtype="Float64")}),
        pl.DataFrame({"a": [1, None, 3]}),
        pl.DataFrame({"a": [1.0, None, 3.0]}),
        pd.Series([1, None, 3], dtype="Int64", name="a"),
    ],
)
def test_missing_values_are_counted_or_replaced(value):
    with pytest.raises(ValueError, match=r"column `a` of argument `X` to have a value everywhere.*got 1 missing of 3"):
        as_tensor("X", value)
    got = as_tensor("X", value, missing=NAN).flatten()
    torch.testing.assert_close(got, torch.tensor([1.0, NAN, 3.0], dtype=torch.float64), equal_nan=True)


def test_missing_booleans_and_masked_numbers_are_missing():
    for value in (pd.Series([True, None], dtype="boolean"), pl.Series([True, None]), np.ma.array([1, 2], mask=[0, 1])):
        with pytest.raises(ValueError, match="1 missing of 2; drop those rows, or fill them"):
            as_tensor("X", value)
        assert as_tensor("X", value, missing=-1.0).tolist() == [1.0, -1.0]


def test_arrays_take_dtype_and_device_of_the_given_tensor():
    X, Y = as_tensors(X=torch.ones(2, 1), Y=np.ones(2))
    assert X.dtype == Y.dtype == torch.float32
    X, Y = as_tensors(X=np.ones((2, 1), np.float32), Y=torch.ones(2).double())
    assert X.dtype == Y.dtype == torch.float64
    # an integer tensor does not determine the dtype; it is refused later
    X, Y = as_tensors(X=np.ones((2, 1), np.float32), Y=torch.ones(2).long())
    assert (X.dtype, Y.dtype) == (torch.float32, torch.int64)


def test_arrays_without_a_tensor_are_float32_only_if_all_are():
    X, Y = as_tensors(X=np.ones((2, 1), np.float32), Y=np.ones(2, np.float32))
    assert X.dtype == Y.dtype == torch.float32
    X, Y = as_tensors(X=np.ones((2, 1), np.float32), Y=np.ones(2, int))
    assert X.dtype == Y.dtype == torch.float64


@each_frame
def test_columns_that_differ_from_the_fit_are_refused(frame):
    value = frame({"b": [1.0], "a": [2.0]})
    refuse_other_columns("X", value, ("b", "a"))
    refuse_other_columns("X", value, None)
    refuse_other_columns("X", np.ones((1, 2)), ("a", "b"))
    with pytest.raises(ValueError, match=r"of the fit, `a`, `b`.*got `b`, `a`; take.*X\[\['a', 'b'\]\]"):
        refuse_other_columns("X", value, ("a", "b"))
    with pytest.raises(ValueError, match=r"of the fit, `a`, `c`.*got `b`, `a`; give it those of the fit"):
        refuse_other_columns("X", value, ("a", "c"))


@pytest.mark.process
def test_no_library_of_frames_is_imported():
    gone = "sys.modules['pandas'] = sys.modules['polars'] = sys.modules['sklearn'] = None"
    code = f"import sys; {gone}; import mkc_torch.linear"
    subprocess.run([sys.executable, "-c", code], check=True)

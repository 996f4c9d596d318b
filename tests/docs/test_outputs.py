"""Outputs in pages: lines that no block prints are detected."""

import pytest

from tests.docs.outputs import agree, differences, filled

PRINTED = ["offset     11.969 ± 0.017", "noise      0.473 µT", "", "rejected   5.1 %"]


def test_shown_lines_that_agree_with_the_output_have_no_differences():
    assert list(differences(PRINTED, PRINTED)) == []
    assert list(differences([PRINTED[0].replace("11.969", "11.968"), "…", PRINTED[3]], PRINTED)) == []
    assert list(differences(["…", "noise      0.47…", "…"], PRINTED)) == []


@pytest.mark.parametrize(
    "shown",
    [
        [],
        PRINTED[:2],  # the end is not shown
        PRINTED[1:],  # nor the beginning
        [PRINTED[0].replace("11.969", "12.969"), *PRINTED[1:]],
        [PRINTED[0].replace("offset", "centre"), *PRINTED[1:]],
        ["…", PRINTED[3], PRINTED[0], "…"],  # in another order
    ],
)
def test_incomplete_changed_or_reordered_lines_differ(shown):
    assert list(differences(shown, PRINTED))


def test_a_number_of_another_sign_or_size_differs():
    assert agree("bias −0.5 rad", "bias −0.5 rad")
    assert not agree("bias −0.5 rad", "bias 0.5 rad")
    assert not agree("p = 0.01", "p = 0.02")


def test_filled_replaces_shown_lines_by_printed_lines():
    assert filled([], PRINTED) == PRINTED
    assert filled(["…", "noise  9 µT", "…"], PRINTED) == ["…", "noise      0.473 µT", "…"]
    two_lines = ["noise  9 µT,", "       white", "rejected   1"]
    assert filled(["noise", "       old", "…"], two_lines) == ["noise  9 µT,", "       white", "…"]
    assert filled(["offset", "rejected", "…"], PRINTED) == [PRINTED[0], "…", PRINTED[3], "…"]
    with pytest.raises(ValueError, match="begins like 'bias 3'"):
        filled(["…", "bias 3"], PRINTED)

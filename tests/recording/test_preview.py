"""A recording in a notebook."""

import numpy as np

from mkc_torch.recording import Recording


def test_a_recording_in_a_notebook_is_escaped_and_counts_missing_values():
    table = Recording({"a<b": np.array([1.0, np.nan, -3.0])}, name="<i>", units={"a<b": "µT"}, warnings=("x & y",))
    page = table._repr_html_()
    for word in ("&lt;i&gt;: 3 samples", "a&lt;b", "x &amp; y", "−3", ">1</td>"):
        assert word in page
    assert "<i>" not in page
    many = Recording({f"c{i}": np.zeros(2) for i in range(200)})._repr_html_()
    assert "And 170 more columns." in many
    assert many.count("<tr") == 31

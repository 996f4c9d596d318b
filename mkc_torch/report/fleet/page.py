"""The page of several recordings as self-contained HTML."""

from __future__ import annotations

from markupsafe import Markup

from mkc_torch.report.fleet import picture, sentences
from mkc_torch.report.fleet.content import Fleet, Quantity
from mkc_torch.report.rendering import render


def fleet_report(fleet: Fleet) -> str:
    """Return the page of several diagnosed recordings: conclusions, the matrix of findings, and their sizes.

    Args:
        fleet: of :func:`mkc_torch.report.fleet.fleet_of`.

    Returns:
        HTML with inline figures.

    Example:
        >>> from mkc_torch.report.fleet import fleet_of
        >>> fleet_report(fleet_of({})).startswith("<!doctype html>")
        True
    """
    cells = [_cells(fleet, quantity) for quantity in fleet.quantities]
    outputs = list(dict.fromkeys(name for each in fleet.recordings for name in each.residuals))
    return render(
        "fleet.html.j2",
        fleet=fleet,
        s=sentences,
        conclusions=sentences.conclusions(fleet),
        cells=cells,
        outputs=outputs,
        picture=Markup(picture.sizes_of(fleet)),
    )


def _cells(fleet: Fleet, quantity: Quantity) -> list[tuple[str, bool]]:
    """Text of each recording's cell, and whether the recording departs."""
    far = {each.unit for each in quantity.departing}
    texts = {size.recording: sentences.written(size, quantity) for size in quantity.sizes}
    return [(texts.get(number, ""), number in far) for number in range(len(fleet.recordings))]

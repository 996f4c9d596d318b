"""The file of a model that a ``corrected.py`` names by a relative path."""

from __future__ import annotations

from pathlib import Path


def model_file(path: str | Path, file: str | None) -> Path:
    """Return where a model's file is.

    Args:
        path: of the file.
        file: ``__file__`` of the calling file, to whose folder the path is relative; if the model has moved, it is
            searched next to the calling file, then in the current folder. None for the current folder.

    Example:
        >>> model_file("arm.xml", None).as_posix()
        'arm.xml'
    """
    place = Path(path)
    if file is None:
        return place
    folder = Path(file).resolve().parent
    places = [folder / path, folder / place.name, Path.cwd() / place.name]
    return next((found for found in places if found.is_file()), places[0])

"""``mkc doctor``: the installed packages, and the features of each missing extra."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from typing import NamedTuple

import typer

from mkc_torch.cli.loading import loading


class Extra(NamedTuple):
    """An extra of the installation: its features, and the packages that it installs."""

    name: str
    brings: str
    packages: tuple[str, ...]


EXTRAS = (
    Extra(
        "cli",
        "the command mkc, tables and reports",
        ("typer", "rich", "polars", "matplotlib", "jinja2", "jsonschema", "threadpoolctl"),
    ),
    Extra("fast", "diagnoses of differential equations in compiled code", ("numba",)),
    Extra("lightning", "the callback for Lightning", ("lightning",)),
    Extra("sklearn", "estimators in pipelines of scikit-learn", ("scikit-learn",)),
    Extra("fmu", "simulations in FMUs", ("fmpy",)),
    Extra("mujoco", "models of MuJoCo as simulations", ("mujoco",)),
    Extra("parquet", "streamed fits of Parquet files", ("pyarrow",)),
    Extra("wmm", "the Earth's field at a place, for --place", ("ahrs",)),
    Extra("ulog", "logs of PX4", ("pyulog", "polars")),
    Extra("dataflash", "logs of ArduPilot", ("polars",)),
    Extra("mcap", "MCAP files", ("mcap", "mcap-protobuf-support", "rosbags", "polars")),
    Extra("rosbag", "bags of ROS 1 and 2", ("mcap", "mcap-protobuf-support", "rosbags", "polars")),
    Extra("mat", "MATLAB files", ("scipy", "h5py", "polars")),
    Extra("hdf5", "HDF5 files", ("h5py", "polars")),
    Extra("mdf", "ASAM MDF files", ("asammdf", "polars")),
)
"""The extras of pyproject.toml that add abilities; a test compares the packages."""


def doctor() -> None:
    """Show what is installed: Python, torch and its devices, and each extra with what it brings."""
    with loading():
        import torch

        from mkc_torch import __version__
    typer.echo(f"mkc_torch  {__version__}, Python {platform.python_version()}, {platform.system()}")
    threads = torch.get_num_threads()
    typer.echo(f"torch      {torch.__version__}, {threads} thread{'' if threads == 1 else 's'}, {_devices()}")
    for extra in EXTRAS:
        missing = [package for package in extra.packages if not _installed(package)]
        state = "installed" if not missing else f"missing {', '.join(missing)}"
        typer.echo(f"{extra.name:<10} {state}; {extra.brings}")
        if missing:
            typer.echo(f'{"":<10} pip install "mkc-torch[{extra.name}]"')


def _devices() -> str:
    """Return the GPUs that torch can use."""
    import torch

    found = [torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count())]
    found += ["Apple GPU"] if torch.backends.mps.is_available() else []
    return ", ".join(found) or "no GPU"


def _installed(package: str) -> bool:
    try:
        version(package)
    except PackageNotFoundError:
        return False
    return True

"""What other packages bring: how those of an extra are installed (`install`), and their entry points.

`load_offered`: an entry point of another package in (command, device, actuator, back end, task, bench),
as its value, or an error that names the package. What the value must be is checked by those that use it.
"""

from __future__ import annotations

import importlib
from importlib.metadata import EntryPoint
from typing import Any

from pans.base.errors import UsageError

# What `pip` installs for each extra of pyproject.toml: the packages themselves, since this one may be on no index, where its name is free.
INSTALLS = {
    "train": "'torch==2.13.0' onnx pillow",
    "sweep": "optuna",
    "plot": "matplotlib scikit-learn jinja2",
    "ui": "bokeh matplotlib jinja2",
    "sklearn": "'torch==2.13.0' onnx pillow scikit-learn",
    "frames": "pandas xarray",
    "export": "h5py",
    "parquet": "pyarrow",
    "dask": "dask distributed",
    "postgres": "optuna 'psycopg[binary]'",
    "metrics": "prometheus-client",
    "usb": "libusb-package",
    "ophyd": "'ophyd-async>=0.21,<0.22' bluesky",
    "alp": "ALP4lib",
    "tagger": "Swabian-TimeTagger",
    "compiler": "ziglang",
}


def install(extra: str) -> str:
    """Return the command that installs what an extra, or several with commas between, needs.

    >>> install("export")
    'pip install h5py'
    """
    packages = dict.fromkeys(word for one in extra.split(",") for word in INSTALLS[one].split(" "))
    return f"pip install {' '.join(packages)}"


def load_offered(point: EntryPoint) -> Any:
    """Return the value of an entry point; UsageError that says which package offers it and why it cannot be loaded."""
    try:
        return point.load()
    except (ImportError, AttributeError) as error:
        raise UsageError(
            f"{point.name!r} of {point.group} cannot be loaded: {point.value}: {error}",
            remedy=f"repair or uninstall {package_of(point)}, which offers it",
        ) from error


def package_of(point: EntryPoint) -> str:
    """Return the name of the installed package that offers `point`."""
    return point.dist.name if point.dist is not None else f"the package of {point.value.partition(':')[0]}"


def missing_extra(what: str, package: str, extra: str) -> UsageError:
    """Return the error for a package that `what` needs and that is not installed."""
    return UsageError(f"{what} needs the package {package}, which is not installed", remedy=install(extra))


def needed(module: str, what: str = "a page", extra: str = "plot") -> Any:
    """Return the `module` of an extra; UsageError that says `what` needs it where it is not installed."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise missing_extra(what, module.partition(".")[0], extra) from error

"""Results as a notebook and pandas show them (`Result`); pictures as small PNG files (extra `plot`), without a screen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any

from pans.base.console import html_card, needed
from pans.base.files import whole_file

DPI = 90
_IN_WORDS = (
    *((name, 100, ".1f") for name in ("accuracy", "balanced_accuracy", "majority_share")),
    *((name, 1, ".3f") for name in ("ssim", "mse", "bits")),
    *((name, 1, ".2f") for name in ("clicks", "photons", "illumination", "exposures")),
    ("objects", 1, "d"),
)


class Result:
    """What dataclasses of figures have besides: a table in a notebook, and a frame of pandas."""

    __slots__ = ()

    def rows(self) -> dict[str, dict[str, Any]]:
        """Return the figures of each row by their names; shares are from 0 to 1."""
        found: dict[str, Any] = asdict(self)  # type: ignore[call-overload]
        plain = {name: value for name, value in found.items() if not isinstance(value, Mapping)}
        return {"sensor": plain | _plain(found.get("by_class"))}

    def to_frame(self) -> Any:
        """Return `rows` as a pandas.DataFrame; UsageError where pandas is not installed."""
        return needed("pandas", "to_frame", "frames").DataFrame.from_dict(self.rows(), orient="index")

    def _repr_html_(self) -> str:
        return "".join(html_card(f"{name} (SIMULATED)", _in_words(row)) for name, row in self.rows().items())


def _plain(figures: Mapping[str, Any] | None) -> dict[str, Any]:
    return {name: value for name, value in (figures or {}).items() if not isinstance(value, Mapping)}


def _in_words(row: Mapping[str, Any]) -> dict[str, str]:
    """The figures that a person looks for, with their standard errors over the objects: shares in percent, light per decision."""
    found = {}
    for name, factor, form in _IN_WORDS:
        value = row.get(f"{name}_mean", row.get(name))
        if value is not None:
            error = row.get(f"{name}_se_objects", row.get(f"{name}_se"))
            words = f"{factor * value:{form}}" + (f" ± {factor * error:{form}}" if error is not None else "")
            found[name.replace("_", " ")] = words + (" %" if factor == 100 else "")
    if "trials" in row:
        found["decisions"] = f"{row['trials']} per object" if row["trials"] else "exact expectation"
    return found


def use_files_alone() -> None:
    """Choose the back end of matplotlib that needs no screen."""
    import matplotlib

    matplotlib.use("Agg")


def new_figure(width: float = 10.0, height: float = 4.0, panels: int = 2, rows: int = 1) -> tuple[Any, Any]:
    use_files_alone()
    from matplotlib import pyplot

    return pyplot.subplots(rows, panels, figsize=(width, height), layout="constrained")


def drawn(figure: Any) -> Any:
    """Return `figure` as a Pillow image of its pixels, RGB."""
    from matplotlib import pyplot
    from PIL import Image

    png = BytesIO()
    figure.savefig(png, dpi=DPI, format="png")
    pyplot.close(figure)
    return Image.open(png).convert("RGB")


def save_figure(figure: Any, path: Path, *, force: bool = True) -> None:
    """Write `figure` to `path`, a PNG of 256 colours, whole or not at all; without `force`, UsageError if `path` exists."""
    from PIL import Image

    with whole_file(path, force=force) as beside:
        # the usual palette leaves out colours of few pixels, such as those of points
        drawn(figure).quantize(256, Image.Quantize.MAXCOVERAGE).save(beside, format="png", optimize=True)

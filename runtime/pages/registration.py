"""A page about one registration: the target as stated and as it is seen, the light of all patterns, and what the model leaves."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pans.runtime.grey_png import png_bytes
from pans.runtime.outputs import write_file
from pans.runtime.registration.estimate import Estimate, pattern_residuals
from pans.runtime.registration.measure import Registration
from pans.runtime.registration.parameters import DARK, N_GEOMETRY, PARAMETERS, flat_basis

from .charts import Axis, Chart, Curve, Mark, number
from .page import Page, Picture
from .pixels import heat_png

FAR = 5.0  # standard errors at the ends of the residuals' axis


def write_registration_page(
    path: Path, measurement: Registration, found: Estimate, *, simulated: bool, force: bool = False
) -> None:
    """Write the page to `path`, whole or not at all; UsageError if it exists, unless `force`."""
    page = Page("Registration", simulated=simulated)
    _numbers(page, found)
    _target(page, measurement, found)
    _residuals(page, measurement, found)
    write_file(path, page.html(), force=force)


def _numbers(page: Page, found: Estimate) -> None:
    page.heading("Where the target stands")
    rows = [
        (one.name, f"{value:+.4f} {one.unit}", f"{error:.2g}", f"{low:+.4f} to {high:+.4f}")
        for one, value, error, (low, high) in zip(
            PARAMETERS, found.values.tolist(), found.errors.tolist(), found.intervals().tolist()
        )
    ]
    page.table(rows, head=("", "estimate", "standard error", "95 % interval"))
    page.text(
        f"{found.clicks} clicks in {found.exposures} exposures. Chi-square {found.chi2:.0f} over {found.degrees} degrees of freedom, "
        f"p = {found.p_value:.2g}."
    )


def _target(page: Page, measurement: Registration, found: Estimate) -> None:
    bench = measurement.bench
    shape = bench.shape
    seen = bench.appearance(found.values[:N_GEOMETRY])
    flat = 1.0 + found.values[7:DARK] @ flat_basis(shape)
    stated = bench.target.reshape(shape)
    field = flat.reshape(shape)
    page.heading("The target")
    page.pictures(
        [
            Picture(png_bytes(np.rint(255 * stated).astype(np.uint8)), "as stated", ["on the pattern grid"]),
            Picture(
                png_bytes(np.rint(255 * np.clip(seen, 0, 1).reshape(shape)).astype(np.uint8)),
                "as seen",
                ["moved, turned, blurred"],
            ),
            Picture(heat_png(seen.reshape(shape) - stated, -1.0, 1.0), "seen - stated", ["light to dark: -1 to 1"]),
            Picture(
                heat_png(field, float(field.min()), float(field.max())),
                "flat field",
                [f"{field.min():.3f} to {field.max():.3f}"],
            ),
        ]
    )


def _residuals(page: Page, measurement: Registration, found: Estimate) -> None:
    assert measurement.observed is not None
    expected, share, deviation = pattern_residuals(measurement.bench, measurement.observed, found.values)
    top = float(max(expected.max(), share.max(), 1e-3))
    page.heading("What the model leaves")
    page.figure(
        Chart(
            label="share of exposures that clicked against the share that the model expects, a dot for each pattern",
            x=Axis("expected share of clicks", 0.0, top),
            y=Axis("measured share of clicks", 0.0, top),
            curves=(Curve(expected, share, "patterns", dots=True), Curve([0.0, top], [0.0, top], "equal", "b")),
        ),
        "Every pattern's share of clicks.",
    )
    places = np.arange(len(deviation))
    page.figure(
        Chart(
            label="residual of every pattern in standard errors, most within plus or minus two",
            x=Axis("pattern", 0.0, float(max(len(deviation) - 1, 1)), text=number),
            y=Axis("residual (standard errors)", -FAR, FAR),
            curves=(Curve(places, np.clip(deviation, -FAR, FAR), dots=True),),
            marks=(Mark(2.0, "+2"), Mark(-2.0, "-2")),
        ),
        "Measured less expected clicks over their standard error, in the order of the patterns: first scattered, then telling ones.",
    )

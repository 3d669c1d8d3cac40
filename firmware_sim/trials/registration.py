"""Many simulated optical tables against their truths: does a registration find them, and do its 95 % intervals cover?

Owns the truths and an image formation of its own (SIMULATED): the target is drawn 16 times finer than the grid, turned, moved and magnified
point by point, blurred by Fourier transform and averaged over pixels, so that no line of the estimator's optics is used. Clicks
are drawn exposure by exposure by the simulator's kernels and counted by the runtime's core. It fails when, at 100 000 clicks, a
shift is off by more than 0.05 px, a rotation by more than 0.1 degrees, or the intervals cover less than 94 % or more than 96 %.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.firmware_sim.options import option
from pans.runtime.core.calibration import Design
from pans.runtime.imaging import Imaging
from pans.runtime.instrument.profile import Profile, load_profile, shipped_profiles
from pans.runtime.registration.estimate import Library
from pans.runtime.registration.measure import Registration, bench_of
from pans.runtime.registration.parameters import FLAT, PARAMETERS, vector_of
from pans.runtime.registration.target import built_in_target

from . import Report, Trial, rows_report
from .calibration import instrument, simulate

COVER = (0.94, 0.96)
POOLED = ("right_px", "down_px", "rotation_deg", "scale", "psf_px", "black")  # over which the bar pools coverage
WITHIN = {"right_px": 0.05, "down_px": 0.05, "rotation_deg": 0.1}
FINER, MARGIN = 16, 8  # points per pixel and side; pixels around the grid, into which nothing blurs
SECONDS = 10.0
F64 = NDArray[np.float64]


class Outcome(NamedTuple):
    """One table: truths, estimates and interval ends of all parameters, and the clicks that were used."""

    truth: F64
    found: F64
    ends: F64
    clicks: int
    p_value: float


def rendered(image: F64, truth: Imaging, finer: int = FINER) -> F64:
    """Return the image (rows, columns) as every pixel of a grid of its size meets it, from points `finer` times closer than pixels."""
    rows, columns = image.shape
    y = (np.arange((rows + 2 * MARGIN) * finer) + 0.5) / finer - 0.5 - MARGIN
    x = (np.arange((columns + 2 * MARGIN) * finer) + 0.5) / finer - 0.5 - MARGIN
    down, right = np.meshgrid(y - (rows - 1) / 2 - truth.down_px, x - (columns - 1) / 2 - truth.right_px, indexing="ij")
    position = (
        (right - 1j * down) * np.exp(-1j * math.radians(truth.rotation_deg)) / truth.scale
    )  # upwards is positive here
    column = np.floor(position.real + (columns - 1) / 2 + 0.5).astype(int)
    row = np.floor(-position.imag + (rows - 1) / 2 + 0.5).astype(int)
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    fine = np.where(inside, image[row.clip(0, rows - 1), column.clip(0, columns - 1)], 0.0)
    waves = np.add.outer(np.fft.fftfreq(len(y), 1 / finer) ** 2, np.fft.rfftfreq(len(x), 1 / finer) ** 2)
    fine = np.fft.irfft2(np.fft.rfft2(fine) * np.exp(-2 * math.pi**2 * truth.psf_px**2 * waves), fine.shape)
    fine = fine.reshape(rows + 2 * MARGIN, finer, columns + 2 * MARGIN, finer).mean(axis=(1, 3))
    return np.asarray(fine[MARGIN:-MARGIN, MARGIN:-MARGIN])


def field(coefficients: F64, shape: tuple[int, int]) -> F64:
    """Return a flat field (rows, columns) of mean 1 with slopes and curvatures across the grid."""
    y, x = (np.linspace(-1, 1, size) for size in shape)
    across, down = np.meshgrid(x, y)
    terms = [across, down, 1.5 * across**2, across * down, 1.5 * down**2]
    bent = sum(c * term for c, term in zip(coefficients, terms))
    return np.asarray(1 + bent - np.mean(bent))


def any_table(rng: np.random.Generator) -> tuple[Imaging, F64]:
    """Return one of many tables: within 2 px, 3 degrees and 3 %, blurred by 0.4 to 1.2 px, with a flat field within 5 % in each term."""
    draw = rng.uniform
    coefficients = draw(-0.05, 0.05, len(FLAT))
    return Imaging(
        right_px=draw(-2, 2), down_px=draw(-2, 2), rotation_deg=draw(-3, 3), scale=draw(0.97, 1.03),
        psf_px=draw(0.4, 1.2), black=draw(0, 0.01), gain=1.0,
    ), coefficients  # fmt: skip


def register_one(nominal: Profile, library: Library | None, clicks: float, seed: int) -> Outcome:
    """Simulate one table and measure it with about `clicks` clicks."""
    rng = np.random.default_rng([seed, 8])
    lamp, target = instrument(nominal, rng), built_in_target()
    truth, coefficients = any_table(rng)
    gain = lamp.projector.peak_photoelectrons_hz / nominal.projector.peak_photoelectrons_hz
    measurement = Registration(nominal, target, SECONDS, seed)
    measurement.prepare(library)
    bench = measurement.bench
    met = rendered(bench.target.reshape(bench.shape), truth) * field(coefficients, bench.shape)

    def light(design: Design) -> F64:
        lit = design.bundle.pattern_levels @ met.reshape(-1)
        dark = (bench.levels - 1) * met.sum()
        return np.asarray(gain * bench.photons_per_level * (truth.black * dark + (1 - truth.black) * lit))

    first = measurement.first()
    share = 1 - math.exp(-float(light(first).mean()))
    first = replace(first, n_cycles=max(1, round(0.12 * clicks / (share * len(first.drives)))))
    known = measurement.take(first, simulate(lamp, first, 2 * seed, light(first)))
    second = measurement.second(known)
    share = float(np.mean(1 - np.exp(-light(second))))
    second = replace(second, n_cycles=max(1, round((clicks - known.clicks) / (share * len(second.drives)))))
    found = measurement.take(second, simulate(lamp, second, 2 * seed + 1, light(second)), known)
    values = vector_of(replace(truth, gain=gain), coefficients)[: len(PARAMETERS)]
    return Outcome(values, found.values[: len(PARAMETERS)], found.intervals(), found.clicks, found.p_value)


@dataclass(frozen=True, slots=True)
class Settings:
    """How many tables, how many clicks each."""

    trials: int = option(200, "simulated tables (default 200)")
    clicks: float = option(100_000.0, "clicks for each (default 100000)", type=float)
    profile: str = option("dmd-spad", "hardware profile (default dmd-spad)", choices=shipped_profiles())
    seed: int = option(1, "of all tables and clicks (default 1)")


def run(settings: Settings) -> Report:
    """Measure all tables and compare with their truths."""
    profile = load_profile(settings.profile)
    library = Library(bench_of(profile, built_in_target()))
    seeds = range(settings.seed * 1_000_003, settings.seed * 1_000_003 + settings.trials)
    outcomes = [register_one(profile, library, settings.clicks, seed) for seed in seeds]
    rows = rows_of(outcomes)
    pooled = float(np.mean([row["covered"] for row in rows if row["name"] in POOLED]))
    n = settings.trials * len(POOLED)
    fine = COVER[0] <= pooled <= COVER[1] and all(row["worst"] <= WITHIN.get(row["name"], math.inf) for row in rows)
    more = {
        "covered": pooled,
        "covered_error": math.sqrt(0.95 * 0.05 / n),
        "intervals": n,
        "clicks_mean": float(np.mean([one.clicks for one in outcomes])),
        "refused_as_misfits": sum(one.p_value < 1e-4 for one in outcomes),
    }
    return rows_report(rows, fine, **more, trials=settings.trials, seed=settings.seed, simulated=True)


def rows_of(outcomes: list[Outcome]) -> list[dict[str, Any]]:
    """Return a row for each parameter: errors of the estimates, median half width of the intervals, share that covers."""
    truth, found, ends = (np.array([one[index] for one in outcomes]) for index in range(3))
    covered = (ends[:, :, 0] <= truth) & (truth <= ends[:, :, 1])
    return [
        {
            "name": one.name,
            "rms": float(np.sqrt(np.mean((found - truth)[:, index] ** 2))),
            "worst": float(np.abs(found - truth)[:, index].max()),
            "bias": float((found - truth)[:, index].mean()),
            "half_width": float(np.median(ends[:, index, 1] - ends[:, index, 0]) / 2),
            "covered": float(covered[:, index].mean()),
        }
        for index, one in enumerate(PARAMETERS)
    ]


TRIAL = Trial(Settings, run)

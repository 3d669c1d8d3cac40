"""Pictures of what a bundle does (`pans evaluate --pictures DIR`): confusion, a t-SNE map, patterns, reliability, dose and optics.

All are SIMULATED, and say so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.files import likeness, make_folder
from pans.bundle.backends import PictureDecider, make_decider
from pans.bundle.sensor import Bundle
from pans_trainer.figures import new_figure, save_figure
from pans_trainer.tasks.registry import Objects

from .accuracy import Light
from .walks import Walks, calibration_bins, confusion_of, measured_walks

MAPPED_OBJECTS = 600
SHOWN_PICTURES = 8
PATTERNS_MAX = 64
LEAST_SHARE = 1e-4  # of the decisions, for a point of the reliability diagram: exact expectations have bins of 1e-10
PERPLEXITY = 30.0  # the default of van der Maaten and Hinton's code (2008)

F64 = NDArray[np.float64]
UNIT = "photoelectrons per exposure\nand unit transmission"
MARKERS = ("o", "s", "^", "D", "v", "P")
Points = Sequence[Mapping[str, Any]]
AXES = {
    "shift_px": "shift to the right and down (pixels)",
    "rotation_deg": "rotation (degrees)",
    "psf_px": "blur, standard deviation (pixels)",
    "black": "light of a dark pixel / full pixel",
}
DOSE_AXES = {
    "illumination of an object (photoelectrons, mean)": "illumination",
    "photoelectrons detected (mean)": "photons_mean",
}


def write_pictures(
    folder: Path, bundle: Bundle, light: Light, objects: Objects, *, shots: int, seed: int, force: bool = False
) -> list[Path]:
    """Write the pictures that this bundle has into `folder` and return their paths."""
    make_folder(folder)
    matrix = np.abs(bundle.analyser.matrix) if bundle.analyser is not None else bundle.patterns()
    unit = UNIT if bundle.analyser is None else "modulus of W"
    written = [folder / "patterns.png"]
    _patterns(written[0], matrix.reshape(-1, *bundle.image_shape).astype(np.float64), unit, force)
    rng = np.random.default_rng(seed)
    counts = light.counts(shots, rng)
    if bundle.picture_shape is not None:
        return [*written, _given_back(folder / "pictures.png", bundle, counts, objects.images, shots, force)]
    written.append(_confusion(folder / "confusion.png", bundle, counts, objects.labels, shots, force))
    if len(objects) > 100:
        written.append(_map(folder / "tsne.png", bundle, light, counts / shots, objects.labels, force))
    return written


def write_walk_pictures(folder: Path, bundle: Bundle, walks: Walks, *, force: bool = False) -> list[Path]:
    """Write patterns, confusion and reliability of an automaton, in exact expectation, into `folder` and return their paths."""
    make_folder(folder)
    pictures = bundle.patterns().reshape(-1, *bundle.image_shape)
    counted = [one for one in calibration_bins(walks) if one.share >= LEAST_SHARE]
    bins = [(one.probability, one.accuracy, one.share) for one in counted]
    table, measured = confusion_of(walks), measured_walks(walks)
    right, error = 100 * (measured.accuracy_mean or 0.0), 100 * (measured.expected_calibration_error or 0.0)
    written = [folder / "patterns.png", folder / "reliability.png"]
    _patterns(written[0], pictures, UNIT, force)
    title = f"{bundle.name}: expected calibration error {error:.2f} points (SIMULATED)"
    _reliability(written[1], bins, title, force)
    title = f"{bundle.name}: {right:.1f} % right, exact (SIMULATED)"
    return [*written, _shown_confusion(folder / "confusion.png", bundle, table, title, force)]


def _patterns(path: Path, pictures: F64, unit: str, force: bool) -> None:
    """Patterns (d_f, height, width) on one scale, at most PATTERNS_MAX of them; `unit` names what a pixel's value is."""
    shown = pictures[:PATTERNS_MAX]
    columns = min(8, len(shown))
    rows = math.ceil(len(shown) / columns)
    flatness = max(0.35, min(1.0, shown.shape[1] / shown.shape[2]))
    figure, axes = new_figure(1.15 * columns + 1.0, 1.3 * rows * flatness + 0.5, columns, rows)
    high = float(shown.max())
    for number, axis in enumerate(np.ravel(axes)):
        axis.set_axis_off()
        if number < len(shown):
            image = axis.imshow(shown[number], interpolation="nearest", cmap="magma", vmin=0.0, vmax=high)
            axis.set_title(str(number), fontsize=7, pad=2)
    figure.colorbar(image, ax=axes, label=unit, shrink=0.8)
    save_figure(figure, path, force=force)


def _reliability(path: Path, bins: Sequence[tuple[float, float, float]], title: str, force: bool) -> None:
    """Accuracy against the probability that was stated, and how many decisions stated it: (probability, accuracy, share) per bin."""
    figure, (upper, lower) = new_figure(5.0, 5.4, 1, 2)
    upper.get_gridspec().set_height_ratios([3, 1])
    probability, accuracy, share = np.array(bins).reshape(-1, 3).T
    upper.plot([0, 1], [0, 1], color="0.6", lw=1, label="as sure as right")
    upper.plot(probability, accuracy, "o-", color="C0", ms=4, label="decisions")
    upper.set(xlim=(0, 1), ylim=(0, 1), ylabel="accuracy")
    upper.set_title(title, fontsize=9)
    upper.legend(fontsize=8)
    lower.bar(probability, share, width=0.04, color="C0")
    lower.set(xlim=(0, 1), xlabel="probability of the decision", ylabel="share")
    save_figure(figure, path, force=force)


def _confusion(
    path: Path, bundle: Bundle, counts: NDArray[np.int64], labels: NDArray[np.int64], shots: int, force: bool
) -> Path:
    """One sampled decision per object, truth against decision."""
    table = np.zeros((bundle.n_classes, bundle.n_classes), np.int64)
    np.add.at(table, (labels, make_decider(bundle, shots=shots).decide_batch(counts, shots)), 1)
    right = float(np.trace(table) / max(table.sum(), 1))
    title = f"{bundle.name}: {100 * right:.1f} % right, K = {shots} (SIMULATED)"
    return _shown_confusion(path, bundle, table, title, force)


def _shown_confusion(path: Path, bundle: Bundle, table: NDArray[Any], title: str, force: bool) -> Path:
    size = min(9.0, 3.0 + 0.42 * bundle.n_classes)
    figure, axis = new_figure(width=size + 1.2, height=size, panels=1)
    share = table / np.maximum(table.sum(axis=1, keepdims=True), 1e-300)
    shown = axis.imshow(share, cmap="Blues", vmin=0, vmax=1)
    if bundle.n_classes <= 20:
        for (row, column), value in np.ndenumerate(share):
            if value >= 0.005:
                ink = "white" if value > 0.55 else "black"
                axis.text(column, row, f"{100 * value:.0f}", ha="center", va="center", fontsize=8, color=ink)
    places = range(bundle.n_classes)
    axis.set_xticks(places, bundle.classes, rotation=60, ha="right")
    axis.set_yticks(places, bundle.classes)
    axis.set(xlabel="decision", ylabel="truth", title=title)
    figure.colorbar(shown, ax=axis, label="share of the truth's decisions (numbers: %)", shrink=0.8)
    save_figure(figure, path, force=force)
    return path


def _map(
    path: Path, bundle: Bundle, light: Light, means: NDArray[np.float64], labels: NDArray[np.int64], force: bool
) -> Path:
    """t-SNE of what the detector would see on average, and of the clicks that it did see."""
    n = min(MAPPED_OBJECTS, len(labels))
    perplexity = min(30.0, (n - 1) / 4)
    figure, axes = new_figure(width=11.0, height=5.0)
    for axis, features, title in (
        (axes[0], light.probability[:n], "click probabilities"),
        (axes[1], means[:n], "clicks, one decision per object"),
    ):
        place = tsne(features, perplexity=perplexity)
        for label in range(bundle.n_classes):
            chosen = labels[:n] == label
            name = bundle.classes[label] if bundle.n_classes <= 20 else None
            axis.scatter(place[chosen, 0], place[chosen, 1], s=9, color=f"C{label}" if label < 10 else None, label=name)
        axis.set(title=title, xticks=[], yticks=[])
    if bundle.n_classes <= 20:
        axes[1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    said = f"{bundle.name}: t-SNE of {n} objects, {bundle.n_features} features (SIMULATED)"
    figure.suptitle(f"{said}; distances mean no more than near or far", fontsize=9)
    save_figure(figure, path, force=force)
    return path


def _given_back(
    path: Path, bundle: Bundle, counts: NDArray[np.int64], images: NDArray[np.uint8], shots: int, force: bool
) -> Path:
    """The first objects above, what came back below."""
    chosen = slice(0, min(SHOWN_PICTURES, len(images)))
    pictures = PictureDecider(bundle).pictures(counts[chosen], shots)
    alike = likeness(pictures, images[chosen])
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(
        2, len(pictures), figsize=(1.35 * len(pictures), 3.3), layout="constrained", squeeze=False
    )
    for column, (truth, picture) in enumerate(zip(images[chosen], pictures)):
        axes[0, column].imshow(truth, cmap="gray", vmin=0, vmax=255)
        axes[1, column].imshow(picture, cmap="gray", vmin=0, vmax=1)
        axes[1, column].set_title(f"SSIM {alike.ssim[column]:.2f}\n{int(counts[column].sum())} clicks", fontsize=8)
        for axis in axes[:, column]:
            axis.set_axis_off()
    figure.suptitle(f"{bundle.name}: true above, given back below, K = {shots} (SIMULATED)", fontsize=9)
    save_figure(figure, path, force=force)
    return path


def tsne(features: NDArray[np.floating], *, perplexity: float = PERPLEXITY, seed: int = 0) -> F64:
    """Return positions, float64 (n, 2), of `features` (n, d); more than three times the perplexity, and hardly above 2000.

    The map starts from the principal components, so that it does not depend on where random points fall; a little noise on top
    lets equal features part.
    """
    from sklearn.manifold import TSNE

    centred = features.astype(np.float64) - features.mean(axis=0, dtype=np.float64)
    axes = np.linalg.svd(centred, full_matrices=False)[2][:2]
    start = np.zeros((len(features), 2))
    start[:, : len(axes)] = centred @ axes.T
    start *= 1e-4 / max(float(start.std()), 1e-12)  # the size that scikit-learn gives its own starts
    start += np.random.default_rng(seed).normal(0, 1e-5, start.shape)
    placed = TSNE(perplexity=perplexity, init=start, method="exact", random_state=seed).fit_transform(centred)
    return np.asarray(placed, np.float64)


def draw_dose(folder: Path, curves: Mapping[str, Points], *, force: bool = False) -> Path:
    """Write dose.png into `folder` and return its path: accuracy against illumination, and against the photons that come back.

    A curve by name of each bundle or sample; bars are the error from trials and objects together.
    """
    return _curves(folder / "dose.png", [(label, key, curves) for label, key in DOSE_AXES.items()], force)


def draw_optics(folder: Path, bundles: Mapping[str, Mapping[str, Points]], *, force: bool = False) -> Path:
    """Write optics.png into `folder` and return its path: accuracy against each misalignment, the curves of every bundle by name."""
    panels = [(label, "value", {name: of[key] for name, of in bundles.items()}) for key, label in AXES.items()]
    return _curves(folder / "optics.png", panels, force)


def _curves(path: Path, panels: Sequence[tuple[str, str, Mapping[str, Points]]], force: bool) -> Path:
    """Accuracy over points in panels: label of the axis, key of a point, and curves by name."""
    from matplotlib import rc_context

    make_folder(path.parent)
    rows = -(-len(panels) // 2)
    with rc_context({"font.size": 14}):
        figure, axes = new_figure(width=8.9, height=3.6 * rows + 0.6, rows=rows)
    for axis, (label, key, curves) in zip(axes.flat, panels):
        for number, (name, points) in enumerate(curves.items()):
            shown = [[point[key] for point in points], [100 * (point["accuracy_mean"] or 0.0) for point in points]]
            errors = [(point["accuracy_se_objects"] or 0.0, point.get("accuracy_se_trials", 0.0)) for point in points]
            bars = [100 * math.hypot(*both) for both in errors]
            marker = MARKERS[number % len(MARKERS)]
            axis.errorbar(*shown, yerr=bars, label=name, marker=marker, markersize=5, linewidth=1.5, capsize=2)
        axis.set(ylim=(0, 100))
        axis.set_xlabel(label, fontsize=14)
        axis.grid(alpha=0.3)
    figure.supylabel("accuracy (%), SIMULATED", fontsize=14)
    figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, fontsize=14)
    save_figure(figure, path, force=force)
    return path

"""What a sensor for a user's own images achieves on images that it has not seen, beside a camera: `SensorResults`. All SIMULATED.

Decisions are chances of every class, not draws. Standard errors are over the images: within each class, with the spread of all classes as
one more image of it, so that few images that happen to agree do not look certain.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.console import one_line
from pans.base.numbers import wilson_interval
from pans.bundle.sensor import Bundle
from pans_trainer.baselines.common import Trials
from pans_trainer.figures import Result
from pans_trainer.tasks.registry import Objects, Task

PAIRS = 6  # of confused classes that are named and shown
LIGHT = ("clicks", "photons", "illumination")
LEAST_CONFUSED = 0.02  # of the images of a class that are taken for another one
CLASSES_SHOWN, IMAGES_SHOWN = 40, 16  # of a sheet: rows, images in each
TILE_PX, GAP_PX, TITLE_PX = 64, 2, 14

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CameraResults(Result):
    """An ideal camera, decided on by the exact posterior, on the same images; gains are the sensor's figure minus the camera's.

    Shares from 0 to 1; `_se` are standard errors over the images, those of gains paired: image by image.
    """

    accuracy: float
    accuracy_se: float
    accuracy_gain: float
    accuracy_gain_se: float
    balanced_accuracy: float
    balanced_accuracy_se: float
    balanced_accuracy_gain: float
    balanced_accuracy_gain_se: float
    clicks: float
    photons: float
    illumination: float


@dataclass(frozen=True, slots=True, eq=False)
class SensorResults(Result):
    """What a trained sensor decides on held-out images; shares from 0 to 1, `_se` standard errors over the images.

    `confusion` float64 (classes, classes) counts held-out images by true class (row) and decided class, in expectation.
    `clicks`, `photons` and `illumination` (photoelectrons that a clear pixel would give, summed over pixels and patterns) are
    means per decision.
    """

    classes: tuple[str, ...]
    accuracy: float
    accuracy_se: float
    balanced_accuracy: float  # mean of the recalls
    balanced_accuracy_se: float
    majority_class: str
    majority: float  # the accuracy of always naming it
    recall: dict[str, float]
    recall_interval: dict[str, tuple[float, float]]  # 95 %, Wilson's
    images: dict[str, int]  # held out, by class
    clicks: float
    photons: float
    illumination: float
    camera_at_equal_photons: CameraResults | None  # None where a decision takes no light
    camera_at_equal_illumination: CameraResults | None
    confusion: F64
    folds: int  # sensors, each judged on images that it has not seen; 1: one, on the held-out images
    folds_missing: int  # sensors that were to be judged too when the training was interrupted
    seconds: float  # of the training and the comparison
    bundle: Path | None
    sha256: str = ""
    simulated: bool = True
    sensor: Bundle | None = field(default=None, repr=False)  # what is in the file `bundle`
    judged: tuple[Judged, ...] = field(default=(), repr=False)  # image by image

    def as_json(self) -> dict[str, Any]:
        """Return the results as plain values of JSON, keyed by the names of the fields, without `sensor` and `judged`."""
        plain = {one.name: getattr(self, one.name) for one in fields(self) if one.name not in ("sensor", "judged")}
        for name in ("camera_at_equal_photons", "camera_at_equal_illumination"):
            camera = plain[name]
            plain[name] = camera and {one.name: getattr(camera, one.name) for one in fields(camera)}
        plain["recall_interval"] = {name: list(ends) for name, ends in self.recall_interval.items()}
        plain |= {"classes": list(self.classes), "confusion": self.confusion.tolist(), "confused": self.confused()}
        return plain | {"bundle": None if self.bundle is None else str(self.bundle)}

    def rows(self) -> dict[str, dict[str, Any]]:
        """Return the figures of the sensor and of the cameras, by their names; shares are from 0 to 1."""
        cameras = {
            "camera at equal photons": self.camera_at_equal_photons,
            "camera at equal illumination": self.camera_at_equal_illumination,
        }
        found = {"sensor": self, **{name: camera for name, camera in cameras.items() if camera is not None}}
        names = [f"{name}{error}" for name in ("accuracy", "balanced_accuracy") for error in ("", "_se")]
        return {
            row: {name: getattr(one, name) for name in (*names, "clicks", "photons", "illumination")}
            for row, one in found.items()
        }

    def confused(self) -> list[dict[str, Any]]:
        """Return the pairs of classes that are confused most: `true`, `decided`, and the `share` of the images of `true`."""
        shares = self.confusion / np.maximum(1, self.confusion.sum(axis=1, keepdims=True))
        np.fill_diagonal(shares, 0.0)
        order = np.argsort(-shares, axis=None)[:PAIRS]
        pairs = [tuple(int(i) for i in np.unravel_index(place, shares.shape)) for place in order]
        named = self.classes
        return [
            {"true": named[true], "decided": named[found], "share": float(shares[true, found])}
            for true, found in pairs
            if shares[true, found] >= LEAST_CONFUSED
        ]

    def lines(self) -> list[str]:
        """Return the results as a short table, in lines."""
        cameras = {
            "equal photons": self.camera_at_equal_photons,
            "equal illumination": self.camera_at_equal_illumination,
        }
        known = {f"camera, {name}": camera for name, camera in cameras.items() if camera is not None}
        total, how = sum(self.images.values()), "held-out images"
        if self.folds > 1:
            how = f"images, each judged by one of {self.folds} sensors that had not seen it (classes are small)"
        if self.folds_missing:
            how += f"; interrupted, {self.folds_missing} more sensors are missing"
        rows = [
            ("", "sensor", list(known)),
            ("balanced accuracy, %", _with_error(self, "balanced_accuracy"), _each(known, "balanced_accuracy")),
            ("  the sensor's gain", "", _each(known, "balanced_accuracy_gain", "+")),
            ("accuracy, %", _with_error(self, "accuracy"), _each(known, "accuracy")),
            ("  the sensor's gain", "", _each(known, "accuracy_gain", "+")),
            *((name, _light(self, name), [_light(one, name) for one in known.values()]) for name in LIGHT),
        ]
        lines = [f"SIMULATED, {total} {how}; ± standard error over the images"]
        lines += [f"  {title:<22}{own:>14}" + "".join(f"{cell:>29}" for cell in cells) for title, own, cells in rows]
        chance = f"accuracy {100 * self.majority:.1f} %, balanced {100 / len(self.classes):.1f} %"
        lines.append(f"  always naming {one_line(self.majority_class, 40)!r}: {chance}")
        lines.append("  recall by class, % (95 % interval), images")
        for name, share in self.recall.items():
            low, high = self.recall_interval[name]
            lines.append(
                f"    {one_line(name, 40):<20} {100 * share:5.1f} ({100 * low:.0f} to {100 * high:.0f}), {self.images[name]}"
            )
        pairs = [
            f"{one_line(one['true'], 40)} taken for {one_line(one['decided'], 40)} {100 * one['share']:.0f} %"
            for one in self.confused()
        ]
        return [*lines, *([f"  confused: {', '.join(pairs)}"] if pairs else [])]


def _with_error(one: Any, name: str, sign: str = "") -> str:
    return f"{100 * getattr(one, name):{sign}.1f} ± {100 * getattr(one, f'{name}_se'):.1f}"


def _each(cameras: Mapping[str, CameraResults], name: str, sign: str = "") -> list[str]:
    return [_with_error(camera, name, sign) for camera in cameras.values()]


def _light(one: Any, name: str) -> str:
    return f"{getattr(one, name):.2f}"


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What one sensor and cameras with as much light decide on held-out objects; arrays by object.

    `shares` (n, classes) are the chances of every decision; `clicks`, `photons`, `illumination` (n,) what one takes. A camera is None
    where there is no light to compare with.
    """

    objects: Objects
    shares: F64
    clicks: F64
    photons: F64
    illumination: F64
    cameras: Sequence[Trials | None]  # at equal photons, at equal illumination


def results_of(
    parts: Sequence[Judged],
    classes: tuple[str, ...],
    *,
    seconds: float,
    bundle: Path | None,
    sha256: str,
    sensor: Bundle | None = None,
    missing: int = 0,
) -> SensorResults:
    """Return the results of all images that the `parts` judged, of which so many are `missing`."""
    labels = np.concatenate([part.objects.labels for part in parts])
    shares = np.concatenate([part.shares for part in parts])
    confusion = np.zeros((len(classes), len(classes)))
    np.add.at(confusion, labels, shares)
    counts = np.bincount(labels, minlength=len(classes))
    right = shares[np.arange(len(labels)), labels]
    recall = np.diagonal(confusion) / np.maximum(1, counts)
    largest = int(counts.argmax())
    accuracy, mean_recall = _mean(right), balanced(right, labels)
    cameras = [_camera(parts, number, right, labels) for number in range(2)]
    return SensorResults(
        classes=classes,
        accuracy=accuracy[0],
        accuracy_se=accuracy[1],
        balanced_accuracy=mean_recall[0],
        balanced_accuracy_se=mean_recall[1],
        majority_class=classes[largest],
        majority=float(counts[largest] / len(labels)),
        recall=dict(zip(classes, recall.tolist())),
        recall_interval={name: wilson_interval(float(r * n), int(n)) for name, r, n in zip(classes, recall, counts)},
        images=dict(zip(classes, counts.tolist())),
        clicks=float(np.concatenate([part.clicks for part in parts]).mean()),
        photons=float(np.concatenate([part.photons for part in parts]).mean()),
        illumination=float(np.concatenate([part.illumination for part in parts]).mean()),
        camera_at_equal_photons=cameras[0],
        camera_at_equal_illumination=cameras[1],
        confusion=confusion,
        folds=len(parts),
        folds_missing=missing,
        seconds=seconds,
        bundle=bundle,
        sha256=sha256,
        sensor=sensor,
        judged=tuple(parts),
    )


def _camera(parts: Sequence[Judged], number: int, right: F64, labels: NDArray[np.int64]) -> CameraResults | None:
    found = [camera for part in parts if (camera := part.cameras[number]) is not None]
    if len(found) < len(parts):
        return None
    own = np.concatenate([camera.right.mean(axis=0) for camera in found])
    sizes = np.array([camera.right.shape[1] for camera in found])
    figures: dict[str, float] = {}
    for name, figure in (("accuracy", _mean), ("balanced_accuracy", lambda values: balanced(values, labels))):
        figures[name], figures[f"{name}_se"] = figure(own)
        figures[f"{name}_gain"], figures[f"{name}_gain_se"] = figure(right - own)
    return CameraResults(
        **figures,
        clicks=float(np.concatenate([camera.clicks for camera in found]).mean()),
        photons=float(np.concatenate([camera.photons for camera in found]).mean()),
        illumination=float(np.average([camera.illumination for camera in found], weights=sizes)),
    )


def _mean(values: F64) -> tuple[float, float]:
    """Mean and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else 1.0


def balanced(values: F64, labels: NDArray[np.int64]) -> tuple[float, float]:
    """Return the mean over the classes of the mean of `values` (n,) within each, and its standard error; `labels` (n,)."""
    groups = [values[labels == label] for label in np.unique(labels)]
    squares = [float(((group - group.mean()) ** 2).sum()) for group in groups]
    spread = sum(squares) / max(1, len(values) - len(groups))
    errors = [(square + spread) / len(group) ** 2 for square, group in zip(squares, groups)]
    return float(np.mean([group.mean() for group in groups])), math.sqrt(sum(errors)) / len(groups)


# ---- pictures ----


def seen_sheet(task: Task) -> bytes:
    """Return a PNG of what the sensor sees: some training images of each class, one row each."""
    labels = task.train.labels
    rows = []
    for label, name in list(enumerate(task.classes))[:CLASSES_SHOWN]:
        members = np.flatnonzero(labels == label)
        some = members[np.linspace(0, len(members) - 1, min(IMAGES_SHOWN, len(members))).astype(int)]
        rows.append((f"{one_line(name, 60)}: {len(members)} to train on", task.train.images[some]))
    return _sheet(rows)


def confused_sheet(results: SensorResults) -> bytes | None:
    """Return a PNG of the images behind the most confused pairs of classes, one row each, the surest mistakes first; None without any."""
    rows, parts = [], results.judged
    if not parts or not results.confused():
        return None
    shares = np.concatenate([part.shares for part in parts])
    labels, images = (np.concatenate([getattr(part.objects, name) for part in parts]) for name in ("labels", "images"))
    for pair in results.confused():
        true, found = results.classes.index(pair["true"]), results.classes.index(pair["decided"])
        members = np.flatnonzero(labels == true)
        worst = members[np.argsort(-shares[members, found], kind="stable")[:IMAGES_SHOWN]]
        words = f"{one_line(pair['true'], 30)} taken for {one_line(pair['decided'], 30)}: {100 * pair['share']:.0f} % of {len(members)}"
        rows.append((words, images[worst]))
    return _sheet(rows)


def _sheet(rows: Iterable[tuple[str, NDArray[np.uint8]]]) -> bytes:
    """A PNG of rows of images (n, height, width), each under its title; small images are enlarged by whole pixels."""
    from PIL import Image, ImageDraw

    rows = list(rows)
    height, width = rows[0][1].shape[1:]
    scale = max(1, round(TILE_PX / max(height, width)))
    step_x, step_y = width * scale + GAP_PX, height * scale + TITLE_PX + 3 * GAP_PX
    whole = Image.new("L", (IMAGES_SHOWN * step_x + GAP_PX, len(rows) * step_y + GAP_PX), 255)
    pen = ImageDraw.Draw(whole)
    for number, (title, images) in enumerate(rows):
        top = number * step_y + GAP_PX
        pen.text((GAP_PX, top), title, fill=0)
        for place, image in enumerate(images):
            tile = Image.fromarray(image).resize((width * scale, height * scale), Image.Resampling.NEAREST)
            whole.paste(tile, (place * step_x + GAP_PX, top + TITLE_PX))
    data = io.BytesIO()
    whole.save(data, "PNG")
    return data.getvalue()

"""The paper's look at direct imaging: single frames at falling photon levels, and t-SNE maps of them.

Owns the page `direct-frames`: which frames are drawn, the maps and what is said of them. Light and detection are baselines.py's, the
decision is baseline_bayes.py's, the curves beside it those of `fig-2e`. SIMULATED; FashionMNIST, perfect photon counters.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.trainer.baselines.bayes import log_joint
from pans.trainer.baselines.common import Measurement, Trials, detect, measure
from pans.trainer.evaluate.tsne import PERPLEXITY, tsne
from pans.trainer.tasks.registry import Objects, Task, load_task

from . import figures_baselines
from .baseline_curves import CLEAN, POSTERIOR, TASK, curve_rows
from .cache import kept
from .page import Asked

SHOWN = {1e6: 1, 1e3: 3, 1e2: 3, 1e1: 3}  # photons: frames drawn of each object
MAPPED = (1e6, 1e2, 1e1)
OBJECTS = 600  # frames on a map, one of each of the first test images
NEIGHBOURS = 10
FLOOR = 5e-3  # of full transmission, by which the posterior lifts every pixel


def frames_page(asked: Asked) -> dict[str, Any]:
    """Return the page `direct-frames`: one row per photon level."""
    task = load_task(TASK, asked.data_dir)
    maps = [found for photons in MAPPED if (found := _map(asked, task, photons)) is not None]
    curves = {curve.way: curve_rows(replace(asked, collect=True), curve) for curve in (CLEAN, POSTERIOR)}
    rows = [_row(photons, maps, curves) for photons in SHOWN]
    pictures = {"": partial(figures_baselines.frames, classes=task.classes, shown=drawn_frames(task))}
    if maps:
        pictures["-map"] = partial(figures_baselines.frame_maps, classes=task.classes, maps=maps)
    return {"rows": rows, "markdown": markdown(rows), "pictures": pictures}


def drawn_frames(task: Task, seed: int = 0) -> dict[float, NDArray[np.float32]]:
    """Return photons -> counts, float32 (classes, draws, height, width), of the first test image of each class."""
    firsts = np.array([int(np.flatnonzero(task.test.labels == label)[0]) for label in range(len(task.classes))])
    measurement = measure(task, None)
    frames = {}
    for photons, draws in SHOWN.items():
        light = measurement.photoelectrons(measurement.test[firsts], photons)
        rng = np.random.default_rng([seed, int(photons)])
        drawn = np.stack([detect(light, "counting", rng) for _ in range(draws)], axis=1)
        frames[photons] = drawn.reshape(len(firsts), draws, *task.image_shape)
    return frames


def _map(asked: Asked, task: Task, photons: float) -> dict[str, Any] | None:
    def make() -> dict[str, Any]:
        found = mapped(task, photons)
        asked.report(f"map of frames at {photons:g} photons: neighbours agree for {100 * found['neighbours']:.1f} %")
        return found

    path = asked.cache / f"direct-frames-{photons:g}.json"
    return kept(path, {"objects": OBJECTS, "photons": photons, "floor": FLOOR}, make, collect=asked.collect)


def mapped(task: Task, photons: float, seed: int = 0) -> dict[str, Any]:
    """Return a t-SNE map of one frame of each of the first test images, and what the frames and the map decide."""
    part = replace(task, test=Objects(task.test.images[:OBJECTS], task.test.labels[:OBJECTS]))
    measurement = measure(part, None)
    light = measurement.photoelectrons(measurement.test, photons)
    frames = detect(light, "counting", np.random.default_rng([seed, 5]))
    place = tsne(frames, seed=seed)
    labels = part.test.labels
    return {
        "photons_asked": photons,
        "map": np.round(place, 2).tolist(),
        "labels": labels.tolist(),
        "neighbours": neighbours_agree(place, labels),
        "posterior": _judged(measurement, light, frames, photons),
    }


def _judged(measurement: Measurement, light: Any, frames: Any, photons: float) -> dict[str, Any]:
    """The exact posterior's decisions on these very frames."""
    decided = log_joint(measurement, frames, photons, "counting", floor=FLOOR).argmax(axis=1)
    right = (decided == measurement.test_labels)[None, :]
    clicks, given = (frames > 0).sum(axis=1).astype(np.float64), light.sum(axis=1, dtype=np.float64)
    return asdict(Trials(right, clicks, given, measurement.illumination(photons)).measured())


def neighbours_agree(place: NDArray[np.floating], labels: NDArray[np.int64], count: int = NEIGHBOURS) -> float:
    """Return the share of points (n, 2) whose class most of their `count` nearest others have (a tie goes to the lower class)."""
    square = ((place[:, None, :] - place[None, :, :]) ** 2).sum(axis=2)
    np.fill_diagonal(square, np.inf)
    near = labels[np.argsort(square, axis=1, kind="stable")[:, :count]]
    votes = np.stack([(near == label).sum(axis=1) for label in range(int(labels.max()) + 1)], axis=1)
    return float((votes.argmax(axis=1) == labels).mean())


def _row(photons: float, maps: list[dict[str, Any]], curves: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    row: dict[str, Any] = {"photons_asked": photons}
    for found in maps:
        if found["photons_asked"] == photons:
            row |= {"neighbours": found["neighbours"], "on_the_map": found["posterior"]}
    for name, way in zip(("network", "posterior"), curves):
        at = next((each for each in curves[way] if each["photons_asked"] == photons), None)
        if at is not None:
            row[name] = at
    return row


def markdown(rows: list[dict[str, Any]]) -> str:
    """Return the page."""
    lines = [
        "# Direct imaging: frames and what is left in them",
        "",
        "SIMULATED, FashionMNIST, perfect photon counters, shot noise alone, seed 0. Command: `pans reproduce direct-frames`; "
        "the accuracies of "
        "all test images are the curves of `pans reproduce fig-2e`. Photons are the mean over the test images: bright objects give more.",
        "",
        "![frames](direct-frames.png)",
        "",
        "The first test image of each class, one frame at 1e6 photons and three draws each at 1000, 100 and 10, each scaled "
        "to its own brightest pixel.",
        "",
        "![maps](direct-frames-map.png)",
        "",
        f"t-SNE (exact, perplexity {PERPLEXITY:g}) of the counts of {OBJECTS} frames, one of each of the first test images; "
        "the paper maps three "
        f"frames of each of all 10 000. `neighbours`: points whose class most of their {NEIGHBOURS} nearest on the map have.",
        "",
        "| photons | clicks | illumination | neighbours on the map % | posterior, these frames % | objects | posterior, all "
        "10 000 % | trials | objects "
        "| first 200 % | network of clean frames, all 10 000 % | first 200 % |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        *(_line(row) for row in rows),
        "",
        "Empty cells: not mapped, not measured yet, or (posterior at 1e6) not measured at all, since there it is a nearest "
        "neighbour. `trials` is "
        "the spread of one trial, `objects` the error from having few images (first 200: about 3 points).",
        "",
        *_says(rows),
        "",
    ]
    return "\n".join(lines)


def _line(row: dict[str, Any]) -> str:
    def percent(key: str, inner: str = "accuracy_mean", digits: int = 1, first: bool = False) -> str:
        if key not in row:
            return ""
        measured = row[key]["first_200"] if first else row[key]
        return f"{100 * measured[inner]:.{digits}f}"

    lit = row.get("posterior") or row.get("network") or row.get("on_the_map")
    light = f"{lit['clicks_mean']:.1f} | {lit['illumination']:.0f}" if lit else " | "
    near = f"{100 * row['neighbours']:.1f}" if "neighbours" in row else ""
    cells = [near, percent("on_the_map"), percent("on_the_map", "accuracy_se_objects"), percent("posterior")]
    cells += [percent("posterior", "accuracy_std", 2), percent("posterior", "accuracy_se_objects", 2)]
    cells += [percent("posterior", first=True), percent("network"), percent("network", first=True)]
    return f"| {row['photons_asked']:g} | {light} | {' | '.join(cells)} |"


def _says(rows: list[dict[str, Any]]) -> list[str]:
    lines = []
    few = next((row for row in rows if row["photons_asked"] == 1e1 and "on_the_map" in row), None)
    some = next((row for row in rows if row["photons_asked"] == 1e2 and "on_the_map" in row), None)
    if few and some:
        lines += [
            "- What the paper shows is seen here too: at 10 photons a frame is a few dots, and on the map the classes lie in one another "
            f"({100 * few['neighbours']:.0f} % agree with their neighbours; by chance 10 %).",
            '- What it concludes does not hold. It says that there is "simply no consistent pattern that a classifier could learn to '
            'exploit", that the information has been destroyed. From **the very frames of the map** the exact posterior over '
            "the training "
            f"objects decides {100 * few['on_the_map']['accuracy_mean']:.0f} % right at 10 photons and "
            f"{100 * some['on_the_map']['accuracy_mean']:.0f} % at 100, where the map shows {100 * some['neighbours']:.0f} %. "
            "A map made of distances between counts sees much less of a frame than its likelihood does.",
        ]
    return lines

"""Readouts of frames and of patterns on FashionMNIST: information (paper, Fig. 2C), maps (Fig. 2F), frames of direct imaging.

Frames are counted by perfect pixels and decided by the exact posterior over all training images; patterns are those of the shipped
bundle with all light scaled, behind a detector without dark counts or read noise. Nothing is trained here.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pans.base import SHIPPED
from pans.bundle.sensor import Bundle, load_bundle
from pans.instrument.click_law import ClickLaw, click_probability
from pans.instrument.profile import load_profile
from pans_trainer.baselines import strings
from pans_trainer.baselines.bayes import log_joint
from pans_trainer.baselines.common import Measurement, detect, measure
from pans_trainer.evaluate.accuracy import light_of, row_of
from pans_trainer.evaluate.information import (
    fisher,
    fisher_of_frames,
    posterior_information,
    word_information,
    word_joint,
)
from pans_trainer.evaluate.pictures import tsne
from pans_trainer.export.automaton import measure_walks
from pans_trainer.tasks import barcode
from pans_trainer.tasks.registry import Objects, Task, load_task

from . import plots
from .active import PROFILE
from .curves import CLEAN, EXACT, curve_rows
from .page import FIRST_OBJECTS, UNITS, Asked, Draw, Made, Row, Rows, against, sampling_error
from .trained import neighbours_agree
from .ways import Point, points, trained_automaton

PHOTONS = (1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4, 1e5)  # of the page fig-2c
POSTERIOR_MAX = 1e3  # beyond it the mixture of the training objects is a nearest neighbour and knows nothing new
FLOOR = 5e-3  # of full transmission, by which the posterior lifts every pixel
FRAMES = 1000  # test objects whose frames are read out, and that are mapped on the page fig-2f
FISHER_OBJECTS = 6000
MAP_PHOTONS = (10.0, 30.0)  # of the page fig-2f
SHOWN = {1e6: 1, 1e3: 3, 1e2: 3, 1e1: 3}  # photons: frames drawn of each object, on the page direct-frames
MAPPED = (1e6, 1e2, 1e1)
MAPPED_FRAMES = 600
WAYS = ("frames", "ten patterns", "automaton")

F64 = NDArray[np.float64]


def shipped_bundle(name: str = "fashion10") -> Bundle:
    """Return a bundle that comes with the package, by default the one of ten patterns for FashionMNIST."""
    return load_bundle(SHIPPED / f"{name}.pans")[0]


def shipped_light(task: Task) -> tuple[F64, F64]:
    """Return photoelectrons (n, d_f) of the training and of the test objects through the shipped patterns."""
    bundle = shipped_bundle()
    profile = load_profile(str(bundle.provenance["profile"]))
    train, test = (light_of(bundle, profile, part.images).photoelectrons for part in (task.train, task.test))
    return train, test


# ---- information (Fig. 2C) ----


def information_page(asked: Asked) -> Made:
    """Return one row per way and photon level; accuracies of ours beside frames of as many photons, with binomial errors.

    Frames are also measured at the photons and at the illumination of the automaton.
    """
    task = load_task(shipped_bundle().task, asked.data_dir)
    ours = [*_information_of_words(task), _information_of_walks(task)]
    measurement = measure(replace(task, test=task.test.first(FRAMES)), None)
    of_walks = ours[-1]["photons"], ours[-1]["illumination"] / measurement.illumination(1.0)
    frames = _information_of_frames(measurement, sorted({*PHOTONS, *of_walks}))
    there = {row["photons"]: row for row in frames if "value" in row}
    for row in ours:
        other = there.get(row["photons"])
        if other is not None:
            errors = [sampling_error(one["value"], one["objects"]) for one in (row, other)]
            row |= against(row["value"], other["value"], *errors)
    for row in frames + ours:
        if "bits" in row:
            row |= {f"bits_per_{unit}": row["bits"] / row[light] for light, unit in UNITS.items()}
    return Made(frames + ours)


def _information_of_walks(task: Task) -> Row:
    """The shipped automaton behind the ideal detector."""
    found = measure_walks(shipped_bundle("fashion-adaptive"), task.test, load_profile(PROFILE))
    row: Row = {"table": "information", "way": WAYS[2], "photons": found.photons_mean, "objects": found.objects}
    row |= {"illumination": found.illumination, "clicks": found.clicks_mean}
    return row | {"bits": found.bits, "bits_se": found.bits_se, "value": 100 * (found.accuracy_mean or 0.0)}


def _information_of_frames(measurement: Measurement, levels: list[float]) -> Rows:
    light = measurement.photoelectrons(measurement.train[:FISHER_OBJECTS], 1.0).astype(np.float64)
    ratios = fisher_of_frames(light, measurement.train_labels[:FISHER_OBJECTS], levels)
    rows = []
    for photons, ratio in zip(levels, ratios):
        row: Row = {"table": "information", "way": WAYS[0], "photons": photons, "objects": FRAMES}
        row |= {"trace": ratio.trace, "discriminant": ratio.discriminant}
        row |= {"illumination": measurement.illumination(photons)}
        if photons <= POSTERIOR_MAX:
            lit = measurement.photoelectrons(measurement.test, photons)
            readouts = detect(lit, "counting", np.random.default_rng([0, 4]))
            joint = log_joint(measurement, readouts, photons, "counting", floor=FLOOR)
            known = posterior_information(joint, measurement.test_labels)
            right = 100 * float((joint.argmax(axis=1) == measurement.test_labels).mean())
            clicks = float((readouts > 0).sum(axis=1).mean())
            row |= {"bits": known.lower_bits, "bits_se": known.lower_bits_se, "value": right, "clicks": clicks}
        rows.append(row)
    return rows


def _information_of_words(task: Task) -> Rows:
    law, (train, test), illumination = ClickLaw(), shipped_light(task), shipped_bundle().illumination()
    rows = []
    for photons in PHOTONS:
        eta, classes = photons / float(test.sum(axis=1).mean()), len(task.classes)
        known = word_information(eta * train, task.train.labels, eta * test, task.test.labels, classes, law=law)
        p = click_probability(law, eta * test)
        ratio = fisher(p, p * (1 - p), task.test.labels)
        row: Row = {"table": "information", "way": WAYS[1], "photons": photons, "objects": len(test)}
        row |= {"trace": ratio.trace, "discriminant": ratio.discriminant, "illumination": eta * illumination}
        right = 100 * known.accuracy
        rows.append(row | {"bits": known.bits, "value": right, "clicks": known.clicks})
    return rows


# ---- what no scheme is above ----


def bound_page(asked: Asked) -> Made:
    """Return automata on all 1024 strings, each with a camera at its photons and at its illumination, beside bounds of any scheme."""
    bars, labels = barcode.all_strings()
    objects = Objects((bars * np.uint8(255))[:, None, :], labels)
    rows: Rows = []
    for point in points(asked.name):

        def figures(point: Point = point) -> Row:
            bundle = load_bundle(trained_automaton(asked, point, 0))[0]
            found = row_of(measure_walks(bundle, objects, load_profile(PROFILE)))
            return found | {
                "value": 100 * found["accuracy_mean"],
                "clicks": found["clicks_mean"],
                "photons": found["photons_mean"],
            }

        found = asked.kept(f"{point.stem}-all", point.made_with(0), figures)
        if found is not None:
            del found["made_with"]
            cameras = strings.at_photons(found["photons"]), strings.imaged(found["illumination"] / barcode.N_BARS)
            ways = point.way, "camera, photons", "camera, illumination"
            rows += [
                {"table": "bound", "way": way, "level": point.level} | one for way, one in zip(ways, (found, *cameras))
            ]
    for light, unit in UNITS.items() if rows else ():
        for row, most in zip(rows, strings.bounds([row[light] for row in rows], light)):
            row |= {f"{light}_{key}": value for key, value in most.items()}
            row[f"bits_per_{unit}"] = row["bits"] / row[light]
    return Made(rows)


# ---- maps of single readouts (Fig. 2F) ----


def maps_page(asked: Asked) -> Made:
    """Return one row per level and way, clicks beside the frames of as many photons."""
    task = load_task(shipped_bundle().task, asked.data_dir)
    part = replace(task, test=task.test.first(FRAMES))
    panels: Rows = []
    for photons in MAP_PHOTONS:
        for way, make in zip(WAYS, (_map_of_frames, _map_of_words)):
            made_with = {"objects": FRAMES, "photons": photons, "floor": FLOOR}
            name = f"fig-2f-{'frames' if way == WAYS[0] else 'words'}-{photons:g}"
            found = asked.kept(name, made_with, partial(make, part, photons))
            if found is not None:
                panels.append({"table": "maps", "way": way, "asked": photons, **found})
    for row in panels:
        other = next((each for each in panels if (each["way"], each["asked"]) == (WAYS[0], row["asked"])), row)
        if other is not row:
            row |= against(row["value"], other["value"], row["error_objects"], other["error_objects"])
    pictures: dict[str, Draw] = {}
    if panels:
        pictures = {"": partial(plots.readout_maps, panels=panels, classes=task.classes)}
    return Made(panels, pictures)


def _map_of_frames(task: Task, photons: float) -> Row:
    measurement = measure(task, None)
    lit = measurement.photoelectrons(measurement.test, photons)
    readouts = detect(lit, "counting", np.random.default_rng([0, 5]))
    decided = log_joint(measurement, readouts, photons, "counting", floor=FLOOR).argmax(axis=1)
    light = {"photons": float(lit.sum(axis=1).mean()), "illumination": measurement.illumination(photons)}
    return mapped(readouts.astype(np.float64), decided, task) | light


def _map_of_words(task: Task, photons: float) -> Row:
    law, (train, test) = ClickLaw(), shipped_light(task)
    eta = photons / float(test.sum(axis=1).mean())
    words = np.random.default_rng([0, 6]).random(test.shape) < click_probability(law, eta * test)
    known = word_joint(click_probability(law, eta * train), task.train.labels, len(task.classes))
    decided = known[words @ (1 << np.arange(words.shape[1]))].argmax(axis=1)
    light = {"photons": eta * float(test.sum(axis=1).mean()), "illumination": eta * shipped_bundle().illumination()}
    return mapped(words.astype(np.float64), decided, task) | light


def mapped(readouts: F64, decided: NDArray[np.integer], task: Task, seed: int = 0) -> Row:
    """Return the t-SNE map of one readout of each test object, how well neighbours tell the class, and the accuracy of `decided`."""
    places, labels = tsne(readouts, seed=seed), task.test.labels
    right = 100.0 * (decided == labels)
    return {
        "map": places.round(2).tolist(),
        "labels": labels.tolist(),
        "features": readouts.shape[1],
        "neighbours": 100 * neighbours_agree(places, labels),
        "by_readouts": 100 * neighbours_agree(readouts, labels),
        "value": float(right.mean()),
        "error_objects": float(right.std(ddof=1)) / len(right) ** 0.5,
        "first_200": float(right[:FIRST_OBJECTS].mean()),
        "clicks": float((readouts > 0).sum(axis=1).mean()),
    }


# ---- frames of direct imaging ----


def frames_page(asked: Asked) -> Made:
    """Return one row per photon level: frames on a map, the posterior's decisions on them, and both curves of direct imaging there."""
    task = load_task(shipped_bundle().task, asked.data_dir)
    whole, part = measure(task, None), replace(task, test=task.test.first(MAPPED_FRAMES))
    maps = {}
    for photons in MAPPED:
        made_with = {"objects": MAPPED_FRAMES, "photons": photons, "floor": FLOOR, "flat": True}
        found = asked.kept(f"direct-frames-{photons:g}", made_with, partial(_map_of_frames, part, photons))
        if found is not None:
            maps[photons] = found
    curves = curve_rows(replace(asked, collect=True), "fig-2e")
    rows = []
    for photons in SHOWN:
        row: Row = {"table": "frames", "photons": photons, "illumination": whole.illumination(photons)}
        if photons in maps:
            row |= {f"map_{key}": maps[photons][key] for key in ("neighbours", "value", "error_objects", "clicks")}
        for name, way in (("network", CLEAN), ("posterior", EXACT)):
            at = next((each for each in curves if (each["way"], each["level"]) == (way, photons)), {})
            keys = ("value", "spread_trials", "error_objects", "first_200", "clicks")
            row |= {f"{name}_{key}": at[key] for key in keys if key in at}
        known = [f"{of}_clicks" for of in ("posterior", "network", "map") if f"{of}_clicks" in row]
        row["clicks"] = row[known[0]] if known else None
        rows.append(row)
    pictures: dict[str, Draw] = {"": partial(plots.frames, classes=task.classes, shown=drawn_frames(task))}
    if maps:
        panels = [{"way": "frames", "asked": photons, **found} for photons, found in maps.items()]
        pictures["-map"] = partial(plots.readout_maps, panels=panels, classes=task.classes)
    return Made(rows, pictures)


def drawn_frames(task: Task, seed: int = 0) -> dict[float, NDArray[np.float32]]:
    """Return photons -> counts, float32 (classes, draws, height, width), of the first test image of each class."""
    firsts = np.array([int(np.flatnonzero(task.test.labels == label)[0]) for label in range(len(task.classes))])
    measurement = measure(task, None)
    frames = {}
    for photons, draws in SHOWN.items():
        lit = measurement.photoelectrons(measurement.test[firsts], photons)
        rng = np.random.default_rng([seed, int(photons)])
        drawn = np.stack([detect(lit, "counting", rng) for _ in range(draws)], axis=1)
        frames[photons] = drawn.reshape(len(firsts), draws, *task.image_shape)
    return frames

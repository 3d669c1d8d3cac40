"""Direct imaging photon by photon: posterior against plain loops, stopping against all sequences of photons, thresholds, command."""

from __future__ import annotations

import itertools
import json
import math

import numpy as np
import pytest
from trainings import kept_task

from pans.runtime.cli import EXIT_USAGE, main
from pans.trainer.baselines import stopping
from pans.trainer.baselines.common import measure
from pans.trainer.baselines.stopping import Course, arrivals, follow, mixture, threshold_for
from pans.trainer.tasks.registry import Objects, Task

FLOOR = 0.02


def task_of(
    train: np.ndarray, labels: list[int], test: np.ndarray | None = None, wanted: list[int] | None = None
) -> Task:
    trained = Objects(train.astype(np.uint8), np.array(labels))
    tested = trained if test is None else Objects(test.astype(np.uint8), np.array(wanted))
    return Task("drawn", ("a", "b", "c"), trained, tested, "0" * 64, "made here")


@pytest.fixture(scope="module")
def drawn() -> Task:
    rng = np.random.default_rng(0)
    train, test = rng.integers(0, 256, (11, 2, 3)), rng.integers(0, 256, (9, 2, 3))
    return task_of(train, [2, 0, 0, 2, 0, 2, 1, 0, 1, 2, 0], test, [0, 1, 2, 0, 1, 2, 0, 1, 2])


def posterior_in_loops(task: Task, scale: float, pixels: list[int], time: float) -> list[float]:
    """P(class | photons at `pixels` until `time`) by products of plain numbers; `scale` is photons per unit transmission and time."""
    of_class = [0.0, 0.0, 0.0]
    for image, label in zip(task.train.images.reshape(len(task.train), -1).tolist(), task.train.labels.tolist()):
        rates = [scale * (value / 255 + FLOOR) for value in image]
        of_class[label] += math.exp(-sum(rates) * time) * math.prod(rates[pixel] for pixel in pixels)
    return [value / math.fsum(of_class) for value in of_class]


@pytest.mark.uncompiled("source", "object")
@pytest.mark.parametrize("brightness", ["source", "object"])
def test_the_posterior_after_each_photon_is_that_of_plain_loops(drawn: Task, brightness: str) -> None:
    measurement = measure(drawn, None, "source")
    if brightness == "object":  # every training object gives as much: pixels alone tell
        drawn = task_of(np.stack([np.roll(drawn.train.images[0], k) for k in range(6)]), [0, 1, 2, 0, 1, 2])
        measurement = measure(drawn, None, "object")
    heard = arrivals(measurement, measurement.test, np.random.default_rng(1), most=12)
    course = follow(mixture(measurement, FLOOR), heard)
    grey = drawn.test.images.reshape(len(drawn.test), -1) / 255
    scale = 1 / grey.sum(axis=1).mean() if brightness == "source" else 1 / (grey[0] + FLOOR).sum()
    for i, k in itertools.product(range(len(heard.pixels)), range(12)):
        wanted = posterior_in_loops(drawn, scale, heard.pixels[i, : k + 1].tolist(), float(heard.times[i, k]))
        assert course.doubt[i, k] == pytest.approx(1 - max(wanted), abs=2e-5) or course.doubt[i, k] < stopping.SURE
        assert wanted[course.labels[i, k]] == pytest.approx(max(wanted), abs=2e-5) or course.doubt[i, k] < stopping.SURE


def test_photons_fall_where_the_light_is_and_take_their_time(drawn: Task) -> None:
    measurement = measure(drawn, None)
    n, rates = 20_000, measurement.photoelectrons(measurement.test[:1], 1.0)[0].astype(np.float64)
    heard = arrivals(measurement, measurement.test[:1].repeat(n, axis=0), np.random.default_rng(3), most=3)
    for k in range(3):
        counts = np.bincount(heard.pixels[:, k], minlength=6)
        share = rates / rates.sum()
        assert (np.abs(counts - n * share) < 5 * np.sqrt(n * share * (1 - share)) + 1e-9).all()
        mean = (k + 1) / rates.sum()  # of a gamma law, whose spread is mean / sqrt(k + 1)
        assert abs(heard.times[:, k].mean() - mean) < 5 * mean / math.sqrt((k + 1) * n)


def test_stopping_is_the_sum_over_all_sequences_of_photons() -> None:
    """Two objects of equal light on two pixels: the times tell nothing, and 2**8 sequences are all that can happen."""
    pair, most, doubt = np.array([[[204, 51]], [[51, 204]]]), 8, 0.12
    n = 20_000
    task = task_of(pair, [0, 1], pair.repeat(n, axis=0), [0] * n + [1] * n)
    measurement = measure(task, None, "object")
    high = (204 / 255 + FLOOR) / (1 + 2 * FLOOR)  # of the posterior, whose floor lifts every transmission
    accuracy = photons = 0.0
    for sequence in itertools.product((0, 1), repeat=most):
        chance = math.prod(0.8 if pixel == 0 else 0.2 for pixel in sequence)  # object 0 is there
        ahead, k = 0, 0
        while k < most:
            ahead, k = ahead + (1 if sequence[k] == 0 else -1), k + 1
            if 1 / (1 + (high / (1 - high)) ** abs(ahead)) <= doubt:
                break
        accuracy += chance * (1.0 if ahead > 0 else 0.0)  # a tie goes to the lower label: see below
        photons += chance * k
    heard = arrivals(measurement, measurement.test[:n], np.random.default_rng(4), most)
    course = follow(mixture(measurement, FLOOR), heard)
    labels, stops = stopping._decided(course, doubt)
    assert stops.mean() == pytest.approx(photons, abs=5 * stops.std() / math.sqrt(n))
    last = course.doubt[np.arange(n), stops - 1]
    right = ((labels == 0) & (last < 0.49)).mean()
    assert right == pytest.approx(accuracy, abs=5 * math.sqrt(accuracy * (1 - accuracy) / n))
    assert (np.abs(last - 0.5) < 1e-3).any()  # even number of photons at the end: one class is then named by rounding


def test_a_threshold_takes_the_mean_photons_it_was_asked_for() -> None:
    doubt = np.array([[0.9, 0.5, 0.2, 0.1], [0.6, 0.3, 0.05, 0.0005], [0.8, 0.7, 0.7, 0.6]], np.float32)
    course = Course(np.zeros((3, 4), np.int16), doubt)
    assert course.stops(0.3).tolist() == [3, 2, 4]
    assert course.stops(1.0).tolist() == [1, 1, 1]
    for photons, wanted in ((1.0, 1.0), (2.9, 8 / 3), (3.0, 3.0), (3.4, 10 / 3)):
        assert course.stops(threshold_for(course, photons)).mean() == pytest.approx(wanted)
    with pytest.raises(ValueError, match="photons is 5, allowed when stopping: 1 to 4"):
        threshold_for(course, 5.0)


def test_the_command_stops_when_sure(tmp_path, capsys) -> None:
    rng = np.random.default_rng(8)
    labels = rng.integers(0, 2, 600)
    images = rng.integers(0, 60, (600, 4, 4)) + 190 * (np.arange(4)[None, None] // 2 == labels[:, None, None])
    path = kept_task(tmp_path / "halves.npz", task_of(images[:400], labels[:400], images[400:], labels[400:]))
    words = ["baseline", "direct", "--method", "stopping", "--task", str(path), "--json", "--photons"]
    assert main([*words, "1.5", "2.5"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["photons_asked"] for row in rows] == [1.5, 2.5]
    for row in rows:
        assert row["photons_mean"] == pytest.approx(row["photons_asked"], rel=0.15)
        assert row["clicks_mean"] == row["photons_mean"]
    assert rows[0]["accuracy_mean"] < rows[1]["accuracy_mean"]
    assert rows[0]["confidence"] < rows[1]["confidence"]
    assert main([*words, "1000"]) == EXIT_USAGE
    assert "none can be reached by stopping" in capsys.readouterr().err
    assert main([*words, "2", "--dark", "0.1"]) == EXIT_USAGE
    assert "without dark counts" in capsys.readouterr().err

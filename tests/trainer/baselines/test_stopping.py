"""Direct imaging that stops: the posterior against plain loops, stopping against an exact sum, the network where the truth is known."""

import math
from functools import partial

import numpy as np
import pytest
from trainings import kept_task

from pans_trainer.baselines.common import measure, silent
from pans_trainer.baselines.networks import SHORTEST, exposure_net, log_chances
from pans_trainer.baselines.stopping import (
    GRID,
    SURE,
    Arrivals,
    Course,
    Rule,
    arrivals,
    best_rule,
    decided,
    of_network,
    of_posterior,
)
from pans_trainer.tasks.registry import Objects, Task

FLOOR = 0.02


def task_of(
    train: np.ndarray, labels: np.ndarray, test: np.ndarray | None = None, wanted: np.ndarray | None = None
) -> Task:
    trained = Objects(train.astype(np.uint8), np.array(labels))
    tested = trained if test is None else Objects(test.astype(np.uint8), np.array(wanted))
    return Task("drawn", ("a", "b", "c"), trained, tested, "0" * 64, "made here")


@pytest.fixture(scope="module")
def drawn() -> Task:
    rng = np.random.default_rng(0)
    train, test = rng.integers(0, 256, (11, 2, 3)), rng.integers(0, 256, (9, 2, 3))
    return task_of(train, [2, 0, 0, 2, 0, 2, 1, 0, 1, 2, 0], test, [0, 1, 2, 0, 1, 2, 0, 1, 2])


def pixels_until(heard: Arrivals, i: int, k: int) -> list[int]:
    first = int(heard.photons[:i, -1].sum())
    return heard.pixels[first : first + int(heard.photons[i, k])].tolist()


def posterior_in_loops(task: Task, scale: float, pixels: list[int], time: float) -> list[float]:
    """P(class | photons at `pixels` until `time`) by products of plain numbers; `scale` is photons per unit transmission and time."""
    of_class = [0.0, 0.0, 0.0]
    for image, label in zip(task.train.images.reshape(len(task.train), -1).tolist(), task.train.labels.tolist()):
        rates = [scale * (value / 255 + FLOOR) for value in image]
        of_class[label] += math.exp(-sum(rates) * time) * math.prod(rates[pixel] for pixel in pixels)
    return [value / math.fsum(of_class) for value in of_class]


@pytest.mark.uncompiled("source", "object")
@pytest.mark.parametrize("brightness", ["source", "object"])
def test_the_posterior_at_each_reading_is_that_of_plain_loops(drawn: Task, brightness: str) -> None:
    if brightness == "object":  # every training object gives as much: pixels alone tell
        drawn = task_of(np.stack([np.roll(drawn.train.images[0], k) for k in range(6)]), [0, 1, 2, 0, 1, 2])
    measurement = measure(drawn, None, brightness)
    heard = arrivals(measurement, measurement.test, np.random.default_rng(1))
    course = of_posterior(measurement, FLOOR, len(drawn.train))(heard, silent)
    grey = drawn.test.images.reshape(len(drawn.test), -1) / 255
    scale = 1 / grey.sum(axis=1).mean() if brightness == "source" else 1 / (grey[0] + FLOOR).sum()
    compared = 0
    for i, k in np.argwhere(course.doubt[:, :40] > SURE).tolist():
        wanted = posterior_in_loops(drawn, scale, pixels_until(heard, i, k), GRID[k])
        assert course.doubt[i, k] == pytest.approx(1 - max(wanted), abs=5e-5)
        assert wanted[course.labels[i, k]] == pytest.approx(max(wanted), abs=5e-5)
        compared += 1
    assert compared > 100


def test_photons_fall_where_the_light_is_and_take_their_time(drawn: Task) -> None:
    measurement = measure(drawn, None)
    n, rates = 4000, measurement.photoelectrons(measurement.test[:1], 1.0)[0].astype(np.float64)
    heard = arrivals(measurement, measurement.test[:1].repeat(n, axis=0), np.random.default_rng(3))
    seen = np.zeros((n, 6))
    for k, (pixels, who) in enumerate(heard.between(slice(0, n))):
        np.add.at(seen, (who, pixels), 1)
        np.testing.assert_array_equal(seen.sum(axis=1), heard.photons[:, k])
        if k in (5, 30):  # a Poisson number in each pixel
            mean = rates * GRID[k]
            assert (np.abs(seen.mean(axis=0) - mean) < 5 * np.sqrt(mean / n)).all()
            assert (np.abs(seen.var(axis=0) - mean) < 5 * np.sqrt((mean + 2 * mean**2) / n)).all()


def test_stopping_is_the_exact_sum_over_differences_of_two_counts() -> None:
    """Two objects of equal light on two pixels: the posterior knows the difference of the counts alone."""
    pair, n, rule = np.array([[[204, 51]], [[51, 204]]]), 2500, Rule(0.03, 0.5)
    measurement = measure(task_of(pair, [0, 1], pair.repeat(n, axis=0), [0] * n + [1] * n), None)
    heard = arrivals(measurement, measurement.test, np.random.default_rng(5))
    course = of_posterior(measurement, FLOOR, 2)(heard, silent)
    sent = measurement.sent(measurement.test, 1.0)[:, None] * GRID
    found, confidence = decided(measurement, [course], [heard.photons], sent, rule)
    ratio = math.log((204 / 255 + FLOOR) / (51 / 255 + FLOOR))
    alive, right, time, doubt, before, most = {0: 1.0}, 0.0, 0.0, 0.0, 0.0, 80
    for k, exposure in enumerate(GRID[: course.last + 1]):
        rates, before = ((exposure - before) * 0.8, (exposure - before) * 0.2), exposure
        laws = [[math.exp(-rate) * rate**j / math.factorial(j) for j in range(most)] for rate in rates]
        ahead = np.convolve(laws[0], laws[1][::-1])  # of the true object; index 0 is 1 - most
        after: dict[int, float] = {}
        for difference, chance in alive.items():
            for j, step in enumerate(ahead.tolist()):
                if chance * step > 1e-15:
                    after[difference + j + 1 - most] = after.get(difference + j + 1 - most, 0.0) + chance * step
        alive = {}
        for difference, chance in after.items():
            left = 1 / (1 + math.exp(ratio * abs(difference)))
            if left <= 0.03 * math.sqrt(exposure / 40) or k == course.last:
                right += chance * ((difference > 0) + 0.5 * (difference == 0))
                time, doubt = time + chance * exposure, doubt + chance * left
            else:
                alive[difference] = chance
    of_pair = 5 / math.sqrt(2 * n)
    assert abs(found.right.mean() - right) < of_pair * math.sqrt(right * (1 - right))
    assert abs(found.photons.mean() - time) < of_pair * found.photons.std()  # Wald: one photon per unit of exposure
    assert found.illumination == pytest.approx(time * measurement.illumination(1.0), rel=of_pair)
    assert confidence == pytest.approx(1 - doubt, abs=of_pair * 0.05)


def test_a_rule_meets_its_level_from_below() -> None:
    rng = np.random.default_rng(2)
    doubt = np.exp(-GRID * rng.uniform(0.05, 0.5, (400, 1))).astype(np.float32)
    course = Course((doubt < 0.1).astype(np.int16), doubt, len(GRID) - 1)
    spent = np.broadcast_to(GRID, doubt.shape)
    for level in (3.0, 10.0, 20.0):
        found = best_rule(course, spent, level, np.ones(400, np.int64))
        mean = GRID[found[1].stops(course)].mean()
        assert 0.9 * level < mean <= level
    assert best_rule(course, spent, 0.5, np.ones(400, np.int64)) is None
    assert best_rule(course, spent, 500.0, np.ones(400, np.int64)) is None


def test_the_network_knows_what_the_truth_allows_and_is_calibrated() -> None:
    """Three objects are all there is: the posterior that knows them is the truth."""
    rng = np.random.default_rng(8)
    objects, labels, wanted = rng.integers(30, 220, (3, 6, 6)), rng.integers(0, 3, 2048), rng.integers(0, 3, 600)
    measurement = measure(task_of(objects[labels], labels, objects[wanted], wanted), None)
    net = exposure_net(measurement, 2048, "drawn", seed=0, epochs=20)
    rates = objects.reshape(3, 36) / objects[wanted].sum(axis=(1, 2)).mean()
    for exposure in (6.0, 25.0, 100.0):
        counts = rng.poisson(exposure * rates[wanted])
        log_truth = counts @ np.log(rates).T - exposure * rates.sum(axis=1)
        log_truth -= np.logaddexp.reduce(log_truth, axis=1, keepdims=True)
        found = log_chances(net, counts.astype(np.float32), exposure)
        divergence = (np.exp(log_truth) * (log_truth - found)).sum(axis=1).mean()
        assert 0 <= divergence < 0.05  # of up to 1.1 nats
    heard = arrivals(measurement, measurement.test, rng)
    course = of_network(partial(log_chances, net), 36, SHORTEST)(heard, silent)
    sent = measurement.sent(measurement.test, 1.0)[:, None] * GRID
    done, confidence = decided(measurement, [course], [heard.photons], sent, Rule(0.1, 0.0))
    found_right = done.measured()
    assert 0.9 < found_right.accuracy_mean < 1
    assert confidence == pytest.approx(found_right.accuracy_mean, abs=4 * found_right.accuracy_se_objects)


def test_the_command_stops_when_sure(tmp_path, pans) -> None:
    rng = np.random.default_rng(8)
    labels = rng.integers(0, 2, 600)
    images = rng.integers(0, 60, (600, 4, 4)) + 190 * (np.arange(4)[None, None] // 2 == labels[:, None, None])
    path = kept_task(tmp_path / "halves.npz", task_of(images[:400], labels[:400], images[400:], labels[400:]))
    words = ["baseline", "direct", "--method", "stopping", "--task", str(path), "--epochs", "2", "--json"]
    rows = pans(*words, "--photons", "1.5", "2.5", "--illumination", "6")["rows"]
    assert [row["photons_asked"] for row in rows] == [1.5, 2.5, None]
    assert [row["illumination_asked"] for row in rows] == [None, None, 6]
    for row in rows:
        asked, found = (row["photons_asked"], row["photons_mean"]) if row["photons_asked"] else (6, row["illumination"])
        assert found == pytest.approx(asked, rel=0.3)
        assert row["clicks_mean"] == row["photons_mean"]
        assert row["source"] in ("network", "posterior")
        assert row["accuracy_held_back"] == pytest.approx(row["accuracy_mean"], abs=0.15)  # of 80 objects, and of 200
    assert rows[0]["accuracy_mean"] < rows[1]["accuracy_mean"]
    assert rows[0]["confidence"] < rows[1]["confidence"]
    assert "none can be reached by stopping" in pans.refuses(*words, "--photons", "1000")
    assert "without dark counts" in pans.refuses(*words, "--photons", "2", "--dark", "0.1")

"""Confusion matrices of one shot, all FashionMNIST and MNIST rows (paper, appendix on the experiment): `confusion`.

Owns the matrices, the page and what it says of the paper's words. A row of a matrix is a true class, its numbers are the shares of that
class's decisions. SIMULATED; exact where all click words can be enumerated.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.instrument.profile import load_profile
from pans.trainer.evaluate.accuracy import decision_shares, light_of, sampled_shares
from pans.trainer.paper_tables import ACTIVE, FIRST_OBJECTS
from pans.trainer.tasks.registry import Objects, load_task

from . import figures_rows
from .active import PROFILE
from .page import Asked
from .sweeps import TRIALS, TRIALS_OF_ALL, enumerable, parts_of
from .trained_rows import (
    SPREADS_SAY,
    TrainedRow,
    measured_on,
    profile_says,
    rows_say,
    seconds_say,
    table_head,
    trained_rows,
)

FIRST = f"first_{FIRST_OBJECTS}"
WORST = 3  # confusions that the page names
UPPER_BODY, FOOTWEAR, TROUSER = (0, 2, 4, 6), (5, 7, 9), 1  # classes of FashionMNIST
GIVEN_UP = 0.05
EASY_DIGITS = (1, 4)  # the paper's

F64 = NDArray[np.float64]


def confusion_page(asked: Asked) -> dict[str, Any]:
    """Return one row per table and d_f (`matrix` of the first 200 and of all), and the page."""
    rows, pictures, lines = [], {}, _head()
    for table in ACTIVE:
        trained, mine = trained_rows(asked, table), []
        parts = []
        for row in trained:
            facts = {"trials": [TRIALS[FIRST_OBJECTS], TRIALS_OF_ALL]}
            made = measured_on(asked, row, facts, partial(_matrices, row, asked.data_dir))
            if made is None:
                asked.report(f"confusion: {table}, d_f = {row.features} is not measured yet: pans reproduce confusion")
                continue
            parts.append(made)
            measured = {part: row.figures[part]["1"] | {"matrix": made[part]} for part in (FIRST, "all")}
            mine.append({"table": table, "features": row.features, "classes": made["classes"], **measured})
        there = [row for row in trained if any(row.features == found["features"] for found in mine)]
        picture = f"![confusion matrices, {table}](confusion-{table}.png)"
        lines += [
            f"## {table}",
            "",
            picture,
            "",
            *rows_say(table, there),
            seconds_say(parts),
            "",
            *_table(mine),
            "",
            *_SAYS[table](mine),
            "",
        ]
        pictures[f"-{table}"] = partial(figures_rows.confusions, rows=mine, table=table)
        rows += mine
    return {"rows": rows, "markdown": "\n".join(lines), "pictures": pictures}


def _matrices(row: TrainedRow, data_dir: str | None) -> dict[str, Any]:
    task, profile = load_task(row.table, data_dir), load_profile(PROFILE)
    found: dict[str, Any] = {"classes": list(task.classes)}
    for part, objects in parts_of(task.test).items():
        light = light_of(row.bundle, profile, objects.images)
        if enumerable(row.bundle, len(objects)):
            shares = decision_shares(row.bundle, light)
        else:
            shares = sampled_shares(row.bundle, light, trials=TRIALS.get(len(objects), TRIALS_OF_ALL), seed=1)
        found[part] = confusion(shares, objects).round(5).tolist()
    return found


def confusion(shares: F64, objects: Objects) -> F64:
    """Return the matrix (classes, classes), rows summing to 1, from P(decided | object) (n, classes); 0 for a class without objects."""
    matrix = np.zeros((shares.shape[1], shares.shape[1]))
    np.add.at(matrix, objects.labels, shares)
    return matrix / np.maximum(np.bincount(objects.labels, minlength=len(matrix)), 1)[:, None]


# ---- the page ----


def _head() -> list[str]:
    return [
        "# Confusion matrices, single shot",
        "",
        f"{profile_says()} Command: `pans reproduce confusion`; nothing is trained, seed 1 of the trials. The paper shows the matrices "
        f"of its experiment (first {FIRST_OBJECTS} test images, 30 trials, K = 1, FashionMNIST d_f = 4 to 32, MNIST d_f = 4 to 64), "
        f"without numbers in the text. Ours are of all 10 000 test images (pictures, tables) and of the first {FIRST_OBJECTS} (JSON), "
        f"K = 1: exact expectations over all click words where these can be enumerated, else {TRIALS_OF_ALL} trials "
        f"({TRIALS[FIRST_OBJECTS]} of the first {FIRST_OBJECTS}). Rows are true classes, columns decisions. {SPREADS_SAY}",
        "",
    ]


def _table(mine: list[dict[str, Any]]) -> list[str]:
    parts = (f"first {FIRST_OBJECTS}", "trials", "objects", "all", "trials", "objects")
    lines = table_head(
        "d_f",
        *parts,
        "clicks",
        "photons",
        "illumination",
        "best class",
        "poorest class",
        "most frequent confusions, true → decided",
    )
    for row in mine:
        cells = [str(row["features"])]
        for part in (FIRST, "all"):
            cells += [f"{100 * row[part][key]:.2f}" for key in ("accuracy_mean", "accuracy_std", "accuracy_se_objects")]
        whole, classes = row["all"], row["classes"]
        cells += [f"{whole['clicks_mean']:.2f}", f"{whole['photons_mean']:.1f}", f"{whole['illumination']:.0f}"]
        right = _right(row)
        for place in (int(right.argmax()), int(right.argmin())):
            cells.append(f"{classes[place]} {100 * right[place]:.0f}")
        cells.append(", ".join(f"{classes[i]} → {classes[j]} {100 * share:.0f}" for i, j, share in _confused(row)))
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _matrix(row: dict[str, Any]) -> F64:
    return np.array(row["all"]["matrix"])


def _right(row: dict[str, Any]) -> F64:
    return _matrix(row).diagonal()


def _confused(row: dict[str, Any]) -> list[tuple[int, int, float]]:
    wrong = _matrix(row) * (1 - np.eye(len(row["classes"])))
    places = np.argsort(-wrong, axis=None)[:WORST]
    return [(int(place) // len(wrong), int(place) % len(wrong), float(wrong.flat[place])) for place in places]


def _fashion_says(mine: list[dict[str, Any]]) -> list[str]:
    """The paper: trousers throughout, footwear moderately confused, upper-body garments hardest."""
    if not mine:
        return []
    lines = ["The paper's words on its matrices, held against ours (all images):", ""]
    lines += table_head(
        "d_f",
        "Trouser right %, its rank",
        "wrong footwear that stays footwear %",
        "upper body right %",
        "the rest right %",
    )
    trousers, hardest = [], []
    for row in mine:
        right, matrix = _right(row), _matrix(row)
        others = np.setdiff1d(np.arange(len(right)), UPPER_BODY)
        rank = 1 + int((right > right[TROUSER]).sum())
        among = matrix[np.ix_(FOOTWEAR, FOOTWEAR)].sum() - right[list(FOOTWEAR)].sum()
        share = among / max(float((1 - right[list(FOOTWEAR)]).sum()), 1e-9)
        upper, rest = right[list(UPPER_BODY)].mean(), right[others].mean()
        trousers += [(rank, float(right[TROUSER]))]
        hardest += [bool(set(np.argsort(right)[: len(UPPER_BODY)]) == set(UPPER_BODY))]
        lines.append(
            f"| {row['features']} | {100 * right[TROUSER]:.1f}, {rank} | {100 * share:.0f} | {100 * upper:.1f} | {100 * rest:.1f} |"
        )
    return [
        *lines,
        "",
        f"- *Trouser consistently high*: it is right in {100 * min(value for _, value in trousers):.0f} to "
        f"{100 * max(value for _, value in trousers):.0f} %, and the best class in {sum(rank == 1 for rank, _ in trousers)} of "
        f"{len(mine)} rows.",
        "- *Upper-body garments the most challenging*: T-shirt/top, Pullover, Coat and Shirt are the four poorest classes in "
        f"{sum(hardest)} of {len(mine)} rows.",
        *_given_up(mine),
    ]


def _digits_say(mine: list[dict[str, Any]]) -> list[str]:
    """The paper: 1 and 4 are easy with few patterns; the matrices become diagonal."""
    if not mine:
        return []
    lines = ["The paper's words on its matrices, held against ours (all images):", ""]
    lines += table_head(
        "d_f", *(f"digit {digit} right %, its rank of 10" for digit in EASY_DIGITS), "largest off the diagonal %"
    )
    for row in mine:
        right = _right(row)
        cells = [f"{100 * right[digit]:.1f}, {1 + int((right > right[digit]).sum())}" for digit in EASY_DIGITS]
        lines.append(f"| {row['features']} | {' | '.join(cells)} | {100 * _confused(row)[0][2]:.1f} |")
    few = _right(mine[0])
    ranks = [1 + int((few > few[digit]).sum()) for digit in EASY_DIGITS]
    easy = [str(digit) for digit, rank in zip(EASY_DIGITS, ranks) if rank <= 3]
    return [
        *lines,
        "",
        f"- *Digits 1 and 4 achieve high accuracy even at low d_f*: at d_f = {mine[0]['features']} they rank {ranks[0]} and {ranks[1]} of "
        f"10 with ours; among the best three: {', '.join(easy) or 'neither'}.",
        *_given_up(mine),
    ]


def _given_up(mine: list[dict[str, Any]]) -> list[str]:
    """Classes that a row hardly ever decides for."""
    rare = {
        row["features"]: [name for name, right in zip(row["classes"], _right(row)) if right < GIVEN_UP] for row in mine
    }
    words = [f"{', '.join(names)} at d_f = {features}" for features, names in rare.items() if names]
    percent = f"{100 * GIVEN_UP:g} %"
    return [
        f"- Few patterns give whole classes up (right below {percent}): {'; '.join(words)}."
        if words
        else f"- No class is right below {percent} in any row."
    ]


_SAYS = {"fashion-mnist": _fashion_says, "mnist": _digits_say}

"""How a training went: figures of every epoch, and what the patterns looked like on the way (`pans train --history DIR`).

Owns the file `history.json` and its pictures (extra `plot`); never trains. Patterns of earlier epochs are read from the checkpoints as they
pass by, so that nothing is kept that a training does not write anyway. SIMULATED figures, of the training objects.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.container import replace_file
from pans.trainer.figures import new_figure, save_figure
from pans.trainer.options import Options

from .checkpoint import read_checkpoint
from .loop import EpochReport

STEPS_SHOWN = 8
PATTERNS_SHOWN = 8
QUANTITIES = (("loss", "loss"), ("clicks", "clicks per decision"), ("photons", "photons per decision"))


class History:
    """Takes the report of every epoch; `write` leaves the file and the pictures."""

    def __init__(self, checkpoint: Path, options: Options, data_sha256: str) -> None:
        self.epochs: list[EpochReport] = []
        self.patterns: dict[int, NDArray[np.float32]] = {}  # of the first restart, after that many epochs
        self._checkpoint, self._options, self._data_sha256 = checkpoint, options, data_sha256
        last = max(1, options.epochs - 1)
        self._wanted = {round(math.exp(math.log(last) * i / (STEPS_SHOWN - 1))) for i in range(STEPS_SHOWN)}

    def take(self, report: EpochReport) -> None:
        """Note one epoch. The checkpoint on disk is that of the epoch before."""
        self.epochs.append(report)
        before = report.epoch - 1
        if report.restart == 0 and before in self._wanted and self._checkpoint.is_file():
            state = read_checkpoint(self._checkpoint, self._options, self._data_sha256)["run"]
            if state["epoch"] == before:
                self.patterns[before] = _shown(state["encoder"]["weight"].numpy(), self._options.encoder)

    def write(self, folder: Path, last: NDArray[np.floating] | None, image_shape: tuple[int, int]) -> list[Path]:
        """Write history.json, curves.png and evolution.png; `last` (d_f, pixels) are the patterns in the end."""
        folder.mkdir(parents=True, exist_ok=True)
        if last is not None:
            self.patterns[self._options.epochs] = np.asarray(last, np.float32)
        facts = {
            "simulated": True,
            "epochs": [asdict(epoch) for epoch in self.epochs],
            "patterns_at": sorted(self.patterns),
        }
        replace_file(folder / "history.json", (json.dumps(facts, indent=1) + "\n").encode())
        draw_curves(folder / "curves.png", {"": self.epochs})
        written = [folder / "history.json", folder / "curves.png"]
        if self.patterns:
            draw_evolution(folder / "evolution.png", self.patterns, image_shape)
            written.append(folder / "evolution.png")
        return written


def draw_curves(path: Path, runs: dict[str, list[EpochReport]]) -> None:
    """Draw loss, clicks and photons over the epochs, one line per run and restart; `runs` is name -> its reports."""
    figure, axes = new_figure(width=12.0, height=3.6, panels=len(QUANTITIES))
    for axis, (name, label) in zip(axes, QUANTITIES):
        for number, (run, reports) in enumerate(runs.items()):
            for restart in sorted({report.restart for report in reports}):
                of_one = [report for report in reports if report.restart == restart]
                values = [getattr(report, name) for report in of_one]
                words = run if restart == 0 else None
                # starts and restarts run through the same epochs again: the order is that of the training
                axis.plot(
                    range(1, len(values) + 1),
                    values,
                    color=f"C{number % 10}",
                    alpha=0.9 if restart == 0 else 0.4,
                    label=words,
                )
        axis.set(xlabel="epochs trained", ylabel=label)
        axis.grid(alpha=0.3)
    if any(runs):
        axes[-1].legend(fontsize=8)
    stages: dict[str, int] = {}
    for index, report in enumerate(next(iter(runs.values()), [])):
        stages.setdefault(report.stage, index)
    for stage, begin in stages.items():
        axes[0].axvline(begin, color="0.7", lw=0.8)
        axes[0].annotate(stage, (begin, 1.0), xycoords=("data", "axes fraction"), fontsize=7, rotation=90, va="top")
    figure.suptitle("SIMULATED, training objects", fontsize=9)
    save_figure(figure, path)


def draw_evolution(path: Path, patterns: dict[int, NDArray[np.float32]], image_shape: tuple[int, int]) -> None:
    """Draw the first patterns (rows) after some epochs (columns), each picture up to its own brightest pixel."""
    from matplotlib import pyplot

    epochs = sorted(patterns)
    rows = min(PATTERNS_SHOWN, len(patterns[epochs[0]]))
    size = (1.15 * len(epochs) + 0.4, 1.15 * rows + 0.6)
    figure, axes = pyplot.subplots(rows, len(epochs), figsize=size, layout="constrained", squeeze=False)
    for column, epoch in enumerate(epochs):
        for row in range(rows):
            axis: Any = axes[row, column]
            axis.imshow(patterns[epoch][row].reshape(image_shape), cmap="magma", vmin=0)
            axis.set(xticks=[], yticks=[])
            if row == 0:
                axis.set_title(f"{epoch}", fontsize=8)
            if column == 0:
                axis.set_ylabel(f"pattern {row}", fontsize=8)
    figure.suptitle("patterns after so many epochs, each up to its own brightest pixel (SIMULATED)", fontsize=9)
    save_figure(figure, path)


def _shown(weight: NDArray[np.float32], encoder: str) -> NDArray[np.float32]:
    """Intensities of active patterns and incoherent optics, the modulus of a coherent W."""
    if encoder != "coherent":
        return np.asarray(weight**2, np.float32)
    return np.asarray(np.sqrt((weight**2).sum(axis=0)), np.float32)

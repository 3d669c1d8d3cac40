"""A whole `pans tune`: the search on the device, its checkpoint, the comparison at the end, the bundle and the report.

Owns the checkpoint file and the JSON keys; how a trial runs is trial.py's, which is tried next search.py's. Whatever ends a search, the
best patterns so far make a whole bundle.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle import Bundle, parse_bundle
from pans.runtime.bundle.facts import check_bundle
from pans.runtime.bundle.format import bundle_bytes
from pans.runtime.cli import say
from pans.runtime.container import parse_json_object, read_file
from pans.runtime.errors import DamagedFileError, UsageError
from pans.runtime.outputs import write_file

from .choosing import Estimate
from .evidence import F64
from .moves import STILL, Move, moved
from .search import CLEARLY, Budget, Cost, Measure, Search, Step, held_out_of, paired
from .trial import Bench, Trial, demand_labelled
from .words import estimate_json, light_words, percent_words

FORMAT = "pans-tune 1"
CHECKPOINT_MAX_BYTES = 1 << 28


@dataclass(frozen=True, slots=True)
class Tuned:
    """What a tuning came to: the bundle to write, and its report without the file's name."""

    bundle: Bundle
    report: dict[str, Any]


@dataclass(slots=True)
class Tuning:
    """One tuning on one device; `facts` are those that a checkpoint must share to be gone on from."""

    bench: Bench
    names: tuple[str, ...]
    budget: Budget
    checkpoint: Path
    facts: dict[str, Any]
    simulated: bool = False

    def run(self, *, resume: bool) -> Tuned:
        """Search, compare and return; an interrupt ends the search only, and is told in the report (`interrupted`)."""
        search = Search(self.names, self.bench.n_objects, self.budget, self._measure_of(), self._keep)
        if resume:
            search.journal = self._read()
            say(f"pans: {len(search.journal)} trials from {self.checkpoint}")
        interrupted, compared = False, None
        try:
            search.run()
            compared = self._compared(search)
        except KeyboardInterrupt:
            interrupted = True
        best = search.best
        if compared is not None and compared["all_objects"]["log_loss_gain"]["value"] <= 0:
            best = STILL
        return self._tuned(search, best, compared, interrupted=interrupted)

    def _measure_of(self) -> Measure:
        held_out = held_out_of(self.bench.n_objects)

        def measure(move: Move, number: int) -> tuple[F64, Cost]:
            trial = self.bench.run(moved(self.bench.bundle, move), number)
            self.simulated = trial.simulated
            demand_labelled(trial, held_out)
            mean = float(np.nanmean(trial.loss[~held_out]))
            say(
                f"pans: trial {number}: {move.words()}: log loss {mean:.4f}, accuracy {100 * np.nanmean(trial.right):.1f} %"
            )
            return trial.loss, cost_of(trial)

        return measure

    def _keep(self, journal: list[Step]) -> None:
        payload = {"format": FORMAT, **self.facts, "trials": [step.as_json() for step in journal]}
        write_file(self.checkpoint, json.dumps(payload).encode(), force=True)

    def _read(self) -> list[Step]:
        """Return the trials of the checkpoint; UsageError where it is of another tuning."""
        where = str(self.checkpoint)
        found = parse_json_object(read_file(self.checkpoint, CHECKPOINT_MAX_BYTES), where)
        if found.get("format") != FORMAT or not isinstance(found.get("trials"), list):
            raise DamagedFileError(f"{where}: no checkpoint of pans tune ({FORMAT})")
        for name, value in self.facts.items():
            if found.get(name) != value:
                raise UsageError(
                    f"{where}: its {name} is {ascii(found.get(name))[:60]}, here {ascii(value)[:60]}",
                    remedy="resume with the options of the first call; budgets alone may differ",
                )
        return [Step.of(row) for row in found["trials"]]

    def _compared(self, search: Search) -> dict[str, Any] | None:
        """Measure old and new once more, on fresh clicks; None where nothing has changed."""
        if search.best == STILL:
            return None
        number = len(search.journal)
        old = self.bench.run(self.bench.bundle, number)
        new = self.bench.run(moved(self.bench.bundle, search.best), number + 1)
        held = search.held_out
        return {
            "held_out": _comparison(old, new, held),
            "all_objects": _comparison(old, new, np.ones_like(held)),
            "old": _light(old),
            "new": _light(new),
            "cost": asdict(cost_of(old).plus(cost_of(new))),
        }

    def _tuned(self, search: Search, best: Move, compared: dict[str, Any] | None, *, interrupted: bool) -> Tuned:
        spent = search.spent if compared is None else search.spent.plus(Cost(**compared["cost"]))
        report = {
            "changed": best != STILL,
            "move": asdict(best),
            "steps": search.steps,
            "accepted": search.accepted,
            "test": f"paired difference of log loss above {CLEARLY} standard errors",
            "resolution": search.resolution if math.isfinite(search.resolution) else None,
            "trials": len(search.journal),
            "ended": "interrupted" if interrupted else search.ended,
            "interrupted": interrupted,
            "objects": self.bench.n_objects,
            "comparison": compared,
            "spent": {"photons_or_clicks": spent.photons, "instrument_minutes": spent.seconds / 60},
            "simulated": self.simulated,
        }
        old = self.bench.bundle
        told = {**report, "from_bundle_sha256": self.facts["bundle_sha256"], "device": self.facts["device"]}
        if best != STILL and old.expected is not None:
            told["expected_of_the_old_patterns"] = dict(old.expected)
        made = replace(moved(old, best), provenance={**old.provenance, "tune": told})
        check_bundle(made)
        return Tuned(parse_bundle(bundle_bytes(made), "the tuned bundle"), report)


def cost_of(trial: Trial) -> Cost:
    """Return what a trial took; clicks stand for photons where the instrument does not know them."""
    each = trial.photons if math.isfinite(trial.photons) else trial.clicks
    return Cost(each * trial.decisions, trial.seconds)


def _comparison(old: Trial, new: Trial, chosen: NDArray[np.bool_]) -> dict[str, Any]:
    both = chosen & np.isfinite(old.loss) & np.isfinite(new.loss)
    gain, error = paired(old.loss, new.loss, chosen)
    return {
        "objects": int(both.sum()),
        "accuracy_old": estimate_json(Estimate.of(old.right[both])),
        "accuracy_new": estimate_json(Estimate.of(new.right[both])),
        "accuracy_gain": estimate_json(Estimate.of((new.right - old.right)[both])),
        "log_loss_old": estimate_json(Estimate.of(old.loss[both])),
        "log_loss_new": estimate_json(Estimate.of(new.loss[both])),
        "log_loss_gain": estimate_json(Estimate(gain, error)),
    }


def _light(trial: Trial) -> dict[str, Any]:
    photons = trial.photons if math.isfinite(trial.photons) else None
    return {"clicks_mean": trial.clicks, "photons_mean": photons, "illumination": trial.illumination}


def words_of(report: Mapping[str, Any]) -> str:
    """Return the report in words."""
    kind = "SIMULATED: " if report["simulated"] else ""
    move = Move(**report["move"])
    spent = report["spent"]
    lines = [
        f"{kind}{report['trials']} trials of {report['objects']} objects, {report['accepted']} steps taken: {move.words()}",
        f"ended: {report['ended']}; {spent['photons_or_clicks']:.4g} photons and "
        f"{spent['instrument_minutes']:.3g} minutes of the instrument",
    ]
    if report["resolution"] is not None:
        lines.append(f"with these objects a step is seen from a gain of {report['resolution']:.2g} in log loss on")
    compared = report["comparison"]
    if compared is None:
        lines.append("not compared: the old patterns stay" if not report["changed"] else "not compared: interrupted")
    else:
        for name in ("old", "new"):
            here = compared["held_out"][f"accuracy_{name}"]
            lines.append(
                f"  {name}  held out {percent_words(here)}, all objects {percent_words(compared['all_objects'][f'accuracy_{name}'])} "
                f"{light_words(compared[name])}"
            )
        if not report["changed"]:
            lines.append("the old patterns stay: the new ones are not better on fresh clicks")
    return "\n".join([*lines, f"{report['bundle']}  SHA-256 {report['sha256'][:16]}"])

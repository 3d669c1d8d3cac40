"""What a file of this project holds, as a JSON-able dict for `pans info`, units in the keys; a damaged recording as far as it goes."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pans.base.numbers import decision_figures
from pans.bundle.automaton import Automaton, exposures_to_leaf
from pans.bundle.backends import NO_LABEL
from pans.bundle.sensor import Analyser, Bundle, amplification, load_bundle
from pans.calibrate.registration import load_registration
from pans.decide import is_decided, is_judged
from pans.instrument.calibration_file import load_calibration, now_utc
from pans.instrument.profile import Profile, load_profile
from pans.record.reading import Recording, earlier_parts, first_decision, handshakes, open_recording, together

from .verify import file_kind

MOST_USED = 5  # patterns of an automaton that are named


def file_facts(path: str | Path) -> dict[str, Any]:
    """Return what `path` holds, its `kind` among it; UsageError or DamagedFileError if nothing can be read."""
    kind = file_kind(path)
    if kind == "bundle":
        bundle, sha256 = load_bundle(path)
        return {"kind": kind, "path": str(path), "sha256": sha256, **_bundle_facts(bundle)}
    if kind == "recording":
        return {"kind": kind, "path": str(path), **_recording_facts(open_recording(path, salvage=True))}
    if kind in ("calibration", "registration"):
        calibration = load_calibration(path) if kind == "calibration" else load_registration(path)
        found = {"kind": kind, "path": str(path), "sha256": calibration.sha256, "age_h": calibration.age_h(now_utc())}
        return found | {key: value for key, value in calibration.values.items() if key != "sha256"}
    return {"kind": kind, "path": str(path), **_profile_facts(load_profile(str(path)))}


def _bundle_facts(bundle: Bundle) -> dict[str, Any]:
    parts = {"table": bundle.table, "onnx": bundle.head_onnx, "automaton": bundle.automaton}
    return {
        "name": bundle.name,
        "task": bundle.task,
        "classes": list(bundle.classes),
        "encoder": bundle.encoder,
        "sensor": None if bundle.analyser is None else _sensor_facts(bundle.analyser),
        "picture_shape_px": None if bundle.picture_shape is None else list(bundle.picture_shape),
        "patterns": bundle.n_patterns,
        "image_shape_px": list(bundle.image_shape),
        "levels": bundle.levels,
        "photons_per_level": bundle.photons_per_level,
        "illumination": bundle.illumination(),
        "photon_number_max": bundle.largest,
        "back_ends": [name for name, part in parts.items() if part is not None],
        "head_bytes": 0 if bundle.head_onnx is None else len(bundle.head_onnx),
        "table_rows": 0 if bundle.table is None else len(bundle.table),
        "golden_vectors": len(bundle.golden_means),
        "automaton": None if bundle.automaton is None else _automaton_facts(bundle, bundle.automaton),
        "expected": None if bundle.expected is None else dict(bundle.expected),
        "provenance": dict(bundle.provenance),
    }


def _automaton_facts(bundle: Bundle, automaton: Automaton) -> dict[str, Any]:
    """What an automaton is: its size, the exposures of its walks, how patterns are shared, how sure its leaves are."""
    used = np.bincount(automaton.pattern)
    most = np.argsort(-used, kind="stable")[:MOST_USED]
    leaves = automaton.posteriors[automaton.n_states :]
    return {
        "states": automaton.n_states,
        "leaves": automaton.n_leaves,
        "outcomes": automaton.n_outcomes,
        "channels": automaton.channels,
        "exposures_longest": automaton.n_slots,
        "exposures_shortest": int(exposures_to_leaf(automaton)[0]),
        "states_per_slot_most": int(np.bincount(automaton.depth).max()),
        "dwell_steps": automaton.dwell_steps,
        "dark_states": int(np.count_nonzero(bundle.state_light() == 0)),
        "patterns_shown": int(np.count_nonzero(used)),
        "states_of_most_used_patterns": {str(i): int(used[i]) for i in most if used[i]},
        "leaf_probability_median": float(np.median(leaves.max(axis=1))),
    }


def _sensor_facts(analyser: Analyser) -> dict[str, Any]:
    return {
        "light": analyser.light,
        "optics": analyser.optics,
        "complex": bool(np.iscomplexobj(analyser.matrix)),
        "full_scale_photoelectrons": analyser.full_scale_photoelectrons,
        "exposure_us": analyser.exposure_us,
        "largest_singular_value": amplification("coherent", analyser.matrix) ** 0.5,
        "largest_column_sum": float(np.abs(analyser.matrix).sum(axis=0).max()),
        "amplification": amplification(analyser.kind, analyser.matrix),
        "fingerprint": analyser.fingerprint,
    }


def _recording_facts(recording: Recording) -> dict[str, Any]:
    bundle = recording.bundle() if recording.bundle_place else None
    n_classes = NO_LABEL if bundle is None else len(bundle.classes)
    sums = Counter[str]()  # photons stay 0: a recording does not have them
    for rows in together(recording.iter_decisions()):
        judged, every = is_judged(rows, n_classes), np.ones(len(rows), np.bool_)
        sums["right"] += int(np.count_nonzero(judged & (rows["label"] == rows["truth"])))
        for name, some in {"decisions": every, "decided": is_decided(rows), "judged": judged}.items():
            sums[name] += int(np.count_nonzero(some))
            sums[f"{name}_clicks"] += int(rows["clicks"][some].sum(dtype=np.int64))
    figures = decision_figures(sums)
    header = dict(recording.header)
    if isinstance(profile := header.pop("profile", None), dict):
        header["profile"] = {key: value for key, value in profile.items() if key != "toml"}
    return {
        "complete": recording.complete,
        "damage": recording.damage,
        "earlier_parts": earlier_parts(recording),
        "size_bytes": recording.size,
        "readable_bytes": recording.end_offset,
        "simulated": recording.simulated,
        "blocks": {kind.name.lower(): count for kind, count in recording.kinds.items()},
        "first_decision": first_decision(recording),
        "decisions": recording.n_decisions,
        "decided": figures.decided,
        "judged": figures.judged,
        "abstained": figures.abstained,
        "decisions_sha256": recording.decisions_sha256,
        "clicks_mean": figures.clicks_mean,
        "accuracy": figures.accuracy,
        "figures_of": {name: figures.figures_of[name] for name in ("accuracy", "clicks_mean")},
        "messages": sum(1 for _ in recording.messages()),
        "answers": sum(1 for _ in recording.answers()),
        "handshakes": handshakes(recording),
        "events": dict(Counter(str(event.get("kind", "?")) for event in recording.events())),
        "header": header,
        "summary": dict(recording.summary),
        "bundle": None if bundle is None else bundle.name,
    }


def _profile_facts(profile: Profile) -> dict[str, Any]:
    facts = asdict(profile)
    del facts["text"], facts["folder"]
    modulator = facts["object_modulator"]
    if modulator is not None and math.isinf(modulator["contrast"]):
        modulator["contrast"] = "inf"  # JSON has no infinity
    return {**facts, "sha256": profile.sha256}


# ---- what the device answered ----

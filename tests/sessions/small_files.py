"""Small files of every kind, made by the ordinary commands, and what an accepted file must be good for.

`use_file` uses a file: a bundle to decide and to run, a recording to be replayed, the others to be planned with. PlanError is an answer
("this hardware cannot do it"); anything else that is raised is a fault of the check that accepted the file. `blocks_of` and `sealed`
take a recording apart and put it together with right checksums.
"""

import hashlib
import json
import math
import struct
import tempfile
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from thirds import write_thirds

from pans.base.errors import DamagedFileError, PlanError, UsageError
from pans.base.files.container import block_ends, canonical_json, file_prologue
from pans.bundle.backends.choose import make_decider
from pans.bundle.sensor import Bundle
from pans.bundle.sensor.analyser import Analyser
from pans.bundle.sensor.bundle import BackEnd, load_bundle, make_bundle, write_bundle
from pans.decide.flow.settings import flow_limits, read_flow
from pans.decide.plan.plan import build_plan
from pans.instrument.calibration_file import load_calibration, now_utc, save_calibration
from pans.instrument.profile import Profile, load_profile
from pans.record.reading import read_recording
from pans.record.reading.decision_log import LogReader
from pans.record.reading.format import FORMAT_VERSION, MAGIC, Kind
from pans.record.reading.sent_plan import never_armed, recorded_plan
from pans.record.replay import replay
from pans.report.files.facts import file_facts
from pans_sim.scene.scene_file import open_scene
from pans_sim.testing import small_automaton_bundle, small_setup

RUN_EVERY = 20  # accepted bundles: one in that many, told by its bytes, is run through the whole loop
RUN_PROFILES = ("ideal", "oled-qcmos", "dmd-spad")  # the last follows automata of 1-bit patterns
DECISIONS = 3
FLOW_S = 0.01
_BLOCK = struct.Struct("<IIB3xI")


def record_run(
    folder: Path, bundle: Path | None = None, profile: str = "ideal", more: str = "", **options: Any
) -> Path:
    """Return the recording of a small run in virtual time, written in `folder`; `more` stands behind the device's URL."""
    if bundle is None:
        bundle = folder / "small.pans"
        write_bundle(small_setup()[1], bundle)
    return _record(folder, bundle, profile, f"scene=uniform{more}", **{"decisions": DECISIONS} | options)


def record_passive(folder: Path) -> Path:
    """Return the recording of a small run behind passive optics, written in `folder`."""
    write_bundle(passive_bundle(), folder / "passive.pans")
    return record_run(folder, folder / "passive.pans", more=f"&optics={folder / 'passive.pans'}")


def record_flow(folder: Path, more: str = "", **options: Any) -> Path:
    """Return the recording of a small run of cells in flow, written in `folder`; `more` stands behind the device's URL."""
    write_thirds(folder)
    flow = {"flow": folder / "flow.toml", "seconds": FLOW_S} | options
    return _record(folder, folder / "thirds.pans", "flow-snspd", f"scene={folder / 'cells.toml'}{more}", **flow)


def passive_bundle() -> Bundle:
    """Return a bundle of small passive optics with a table."""
    rng = np.random.default_rng(1)
    optics = Analyser("coherent", rng.normal(size=(3, 4)).astype(np.complex64), "field", "none", 10.0, 100.0)
    return make_bundle(
        name="passive",
        task="small",
        classes=("a", "b"),
        image_shape=(2, 2),
        optics=optics,
        back_end=BackEnd(table=rng.normal(size=(8, 2))),
        provenance={"seed": 1, "losses": [0.5, 0.25]},
    )


def _record(folder: Path, bundle: Path, profile: str, device: str, **more: Any) -> Path:
    from pans.app.run.one_run import run_once
    from pans.live.options import RunOptions

    options = RunOptions(
        bundle=bundle,
        device=f"sim:{profile}?{device}&seed=1&pace=fast",
        profile=profile,
        record=folder / "run.pansrec",
        realtime=False,
        command="tests",
        display=False,
        **more,
    )
    run_once(options)
    return folder / "run.pansrec"


def record_automaton(folder: Path) -> Path:
    """Return the recording of a small run of an automaton that the device follows, written in `folder`."""
    write_bundle(small_automaton_bundle(), folder / "automaton.pans")
    return record_run(folder, folder / "automaton.pans", "dmd-spad")


def small_calibration(folder: Path) -> bytes:
    """Return a calibration of the profile `ideal`, as `pans calibrate` writes it."""
    profile = load_profile("ideal")
    row = {"dark_per_exposure": 0.001, "dark_ci": [0.0, 0.004], "dark_clicks": 4, "dark_exposures": 4000}
    values = {
        "made_utc": now_utc().isoformat(),
        "profile": {"name": profile.name, "sha256": profile.sha256},
        "device": {"name": "sim:ideal", "serial": "SIM-1", "firmware": "1", "simulated": True},
        "exposure_us": 100.0,
        **{"photons_per_level": 0.02, "photons_per_level_ci": [0.019, 0.021]},
        **{"dark_per_exposure": 0.001, "dark_ci": [0.0, 0.004]},
        **{"peak_photoelectrons_hz": 4e3, "peak_photoelectrons_hz_ci": [3.8e3, None]},
        "counts": {"clicks": 3141, "exposures": 4751},
        "channels": [row, row],
    }
    save_calibration(folder / "calibration.json", values)
    return (folder / "calibration.json").read_bytes()


def use_file(kind: str, path: Path) -> None:
    """Use an accepted file for what it is for; whatever this raises is a finding."""
    _USES[kind](path)


def _use_bundle(path: Path) -> None:
    bundle, _ = load_bundle(path)
    for shots in (1, 3):
        with suppress(UsageError):  # a table alone answers single shots only
            decider = make_decider(bundle, shots=shots)
            counts = np.random.default_rng(1).integers(0, shots * bundle.largest + 1, (4, bundle.n_features))
            decider.decide(counts[0], shots)
            if not np.isfinite(decider.scores_batch(counts, shots)).all() and bundle.table is not None and shots == 1:
                raise ValueError("scores that are not finite from a checked table")
    file_facts(path)
    if bundle.automaton is not None:
        for confidence in (0.5, 1.0):
            make_decider(bundle, confidence=confidence)
    if not (math.isfinite(bundle.illumination()) and np.isfinite(bundle.patterns()).all()):
        raise ValueError("a light that is not finite")
    planned = [profile for profile in map(load_profile, RUN_PROFILES) if _plannable(profile, bundle)]
    if planned and zlib.crc32(path.read_bytes()) % RUN_EVERY == 0:
        with tempfile.TemporaryDirectory() as folder:
            record_run(Path(folder), path, planned[0].name)


def _plannable(profile: Profile, bundle: Bundle) -> bool:
    try:
        build_plan(profile, bundle)
    except PlanError:
        return False
    return bundle.analyser is None


def _use_recording(path: Path) -> None:
    recording = read_recording(path)
    if recording.bundle_place:
        if not never_armed(recording):
            recorded_plan(recording)
        replay(recording, recording.bundle())


def _use_calibration(path: Path) -> None:
    calibration, profile = load_calibration(path), load_profile("ideal")
    calibration.age_h(now_utc())
    for channels in (1, 4):
        chance, low, high = calibration.dark_probability(profile, 250.0, channels)
        if not (
            np.isfinite([chance, low, high]).all() and (low >= 0).all() and (low <= high).all() and (high <= 1).all()
        ):
            raise ValueError(f"dark probabilities {chance}, {low}, {high}")
        calibration.dark_clicks(channels)
    with suppress(PlanError):
        build_plan(calibration.applied_to(profile), small_setup()[1])
    json.dumps(calibration.values, allow_nan=False)


def _use_profile(path: Path) -> None:
    with suppress(PlanError):
        build_plan(load_profile(path), small_setup()[1])


def _use_scene(path: Path) -> None:
    open_scene(path)


def _use_flow(path: Path) -> None:
    flow_limits(read_flow(str(path)), small_setup("parallel")[2], 1e-6)


_USES = {
    "bundle": _use_bundle,
    "recording": _use_recording,
    "calibration": _use_calibration,
    "profile": _use_profile,
    "scene": _use_scene,
    "flow": _use_flow,
}


def blocks_of(data: bytes) -> list[tuple[int, bytes]]:
    """Return the blocks of a recording: kind and payload."""
    found, position = [], 16
    while position < len(data):
        length, _, kind, _ = _BLOCK.unpack_from(data, position)
        position += _BLOCK.size
        found.append((kind, data[position : position + length]))
        position += length + 4
    return found


def sealed(blocks: list[tuple[int, bytes]]) -> bytes:
    """Return a recording of these blocks: chain, index, END and the bundle's digest fit."""
    bundle = next((payload for kind, payload in blocks if kind == Kind.BUNDLE), None)
    log, decisions, readable = LogReader(), 0, True
    out, chain = file_prologue(MAGIC, FORMAT_VERSION)
    pieces = [out]
    for index, (kind, payload) in enumerate(blocks):
        if kind == Kind.HEADER and bundle is not None:
            payload = _with(payload, {"bundle_sha256": hashlib.sha256(bundle).hexdigest()})
        elif kind == Kind.DECISIONS and readable:
            try:
                decisions += len(log.rows(payload, ""))
            except DamagedFileError:
                readable = False
        elif kind == Kind.END:
            facts = {"blocks": index, "decisions": decisions, "decisions_sha256": log.hexdigest()}
            payload = _with(payload, facts)
        head, tail, chain = block_ends(kind, index, chain, payload)
        pieces += [head, payload, tail]
    return b"".join(pieces)


def _with(payload: bytes, facts: dict[str, Any]) -> bytes:
    """The JSON text with some keys as they must be; as it is where it cannot be read."""
    try:
        value = json.loads(payload)
        return canonical_json({**value, **facts})
    except (ValueError, TypeError, RecursionError):
        return payload

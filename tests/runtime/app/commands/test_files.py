"""`pans verify`, `pans info`, `pans bundle`: exit codes, JSON keys, and reasons a person can act on."""

import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from automata import automaton_bundle, diamond, early_leaf
from bundles import made_bundle
from commands import Pans, fixed_run
from heads import affine_head

from pans.app.main import main
from pans.bundle.automaton import Automaton
from pans.bundle.sensor import Bundle, bundle_bytes, with_expected
from pans.bundle.sensor.bundle import load_bundle, write_bundle
from pans.decide.decision import DECISION_DTYPE
from pans.instrument.profile import load_profile, shipped_profiles
from pans.record.reading.format import TIMING_RUN_DTYPE
from pans.record.recorder import Recorder


def toy_bundle(**changes: Any) -> Bundle:
    facts: dict[str, Any] = {
        "classes": ("a", "b"),
        "image_shape": (1, 2),
        "levels": 4,
        "pattern_levels": [[0, 3], [1, 2]],
        "photons_per_level": 0.5,
        "table": [[1, 0], [0, 1], [1, 0], [0, 1]],
        "provenance": {"made_by": "test"},
    }
    return made_bundle(**facts | changes)


def decision(index: int, **changes: Any) -> tuple[Any, ...]:
    row = {
        **{"index": index, "tick": 10 * index, "exposure_index": index, "object": index, "shot": 0, "clicks": 1},
        **{"label": 1, "truth": 1, "flags": 0, "probability": 0.75, "counts_crc": 0, "exposures": 0},
    }
    return tuple((row | changes).values())


def record(path: Path, decisions: list[tuple[Any, ...]], *, close: bool = True, **changes: Any) -> Path:
    profile = load_profile("oled-qcmos")
    inner = {"name": profile.name, "sha256": profile.sha256, "toml": profile.text}
    header = {"simulated": True, "profile": inner, **changes}
    with Recorder(path, header, bundle=bundle_bytes(toy_bundle())) as recorder:
        recorder.add_decisions(np.array(decisions, DECISION_DTYPE))
        recorder.add_timing_runs(np.array([(row[0], 5, 10, 20, 30, 1) for row in decisions], TIMING_RUN_DTYPE))
        recorder.add_message(1, b"m")
        recorder.add_event({"kind": "gap"})
        if close:
            recorder.close({"accuracy": 1.0})
    return path


def test_whole_files_are_fine(tmp_path: Path, pans: Pans) -> None:
    write_bundle(toy_bundle(), tmp_path / "a.pans")
    assert main([*fixed_run(3), "--record", str(tmp_path / "a.pansrec")]) == 0
    pans.said()
    profile = tmp_path / "mine.toml"
    profile.write_text(load_profile("ideal").text)
    paths = [tmp_path / "a.pans", tmp_path / "a.pansrec", profile, "oled-qcmos"]
    found = pans("verify", *paths)
    assert (found["ok"], found["alerts"], found["violations"]) == (True, [], [])
    assert [file["kind"] for file in found["files"]] == ["bundle", "recording", "profile", "profile"]
    assert main(["verify", *map(str, paths)]) == 0
    assert pans.said().out.count("ok ") == 4


def test_an_incomplete_recording_is_a_violation_not_damage(tmp_path: Path, pans: Pans) -> None:
    path = record(tmp_path / "a.pansrec", [decision(0)], close=False)
    found = pans("verify", path, code=1)
    assert (found["ok"], found["files"][0]["damaged"], found["files"][0]["cut"]) == (False, False, True)
    assert "incomplete" in (message := found["violations"][0]["message"])
    assert "1 decisions" in message
    assert main(["verify", str(path)]) == 1
    assert (said := pans.said().out).startswith("CUT ")
    assert "as far as it goes" in said
    odd = record(tmp_path / "b.pansrec", [decision(0), decision(2)], close=False)
    assert main(["verify", str(odd)]) == 1
    assert "do not rely on this file" in pans.said().out


def test_one_damaged_file_does_not_hide_the_others(tmp_path: Path, pans: Pans) -> None:
    (tmp_path / "bad.pans").write_bytes(b"PANSBNDL")
    (tmp_path / "odd.txt").write_bytes(b"hello")
    write_bundle(toy_bundle(), tmp_path / "good.pans")
    found = pans("verify", *(tmp_path / n for n in ("bad.pans", "odd.txt", "good.pans")), code=2)
    assert [file["ok"] for file in found["files"]] == [False, False, True]
    assert main(["verify", str(tmp_path / "none.pans")]) == 2


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ([decision(0), decision(2)], "decision 1 is not numbered"),
        ([decision(0, label=2)], "beyond the 2 classes"),
        ([decision(0, label=0xFFFF)], "beyond the 2 classes"),
        ([decision(0, flags=8)], "abstained, but has a label"),
        ([decision(0, flags=1)], "despite a gap"),
        ([decision(0, flags=1 << 20)], "flags that this version does not know"),
        ([decision(0, probability=1.5)], "probability"),
        ([decision(0, probability=float("nan"))], "probability"),
        # of the toy; an abstention itself is fine
        ([decision(0, flags=9, label=0xFFFF, probability=0.0)], "cannot be rebuilt"),
    ],
)
def test_decisions_that_cannot_be_true(rows: list[tuple[Any, ...]], reason: str, tmp_path: Path, pans: Pans) -> None:
    found = pans("verify", record(tmp_path / "a.pansrec", rows), code=1)
    assert reason in found["violations"][0]["message"]


def test_timings_must_belong_and_be_in_order(tmp_path: Path, pans: Pans) -> None:
    path = tmp_path / "a.pansrec"
    with Recorder(path, {}) as recorder:
        recorder.add_timing_runs(np.array([(3, 0, 20, 10, 30, 1)], TIMING_RUN_DTYPE))
        recorder.add_message(5, b"")
        recorder.add_message(4, b"")
        recorder.close({})
    found = pans("verify", path, code=1)
    messages = " ".join(item["message"] for item in found["violations"])
    assert "belongs to decision 3" in messages
    assert "decided before it arrived" in messages
    alerts = " ".join(item["message"] for item in found["alerts"])
    assert "holds no bundle" in alerts
    assert "holds no hardware profile" in alerts
    assert "go back at 1" in alerts


def test_a_profile_that_was_changed_inside_a_recording(tmp_path: Path, pans: Pans) -> None:
    profile = {"sha256": "0" * 64, "toml": load_profile("ideal").text}
    found = pans("verify", record(tmp_path / "a.pansrec", [], profile=profile), code=1)
    assert "SHA-256 that stands beside" in found["violations"][0]["message"]


def test_signs_of_a_bad_export_are_alerts(tmp_path: Path, pans: Pans) -> None:
    odd = toy_bundle(pattern_levels=[[0, 0], [1, 2]], table=[[1, 0]] * 4)
    write_bundle(odd, tmp_path / "a.pans")
    found = pans("verify", tmp_path / "a.pans", code=1)
    assert found["violations"] == []
    messages = " ".join(item["message"] for item in found["alerts"])
    for sign in ("level 2 of 3", "1 of 2 patterns are dark", "never decided by any click word: b"):
        assert sign in messages


def test_info_of_every_kind(tmp_path: Path, pans: Pans) -> None:
    digest = write_bundle(toy_bundle(), tmp_path / "a.pans")
    found = pans("info", tmp_path / "a.pans")
    assert (found["kind"], found["sha256"], found["illumination"]) == ("bundle", digest, 3.0)
    assert (found["back_ends"], found["classes"], found["patterns"]) == (["table"], ["a", "b"], 2)
    rows = [decision(0), decision(1, truth=0), decision(2, flags=9, label=0xFFFF), decision(3, truth=2, label=2)]
    record(tmp_path / "a.pansrec", rows)  # the last is of a class that the bundle does not have: not judged
    found = pans("info", tmp_path / "a.pansrec")
    assert (found["kind"], found["complete"], found["simulated"], found["bundle"]) == ("recording", True, True, "toy")
    assert (found["decisions"], found["abstained"], found["accuracy"]) == (4, 1, 1 / 2)
    assert found["events"] == {"gap": 1}
    assert "toml" not in found["header"]["profile"]
    assert main(["info", str(tmp_path / "a.pansrec")]) == 0
    assert "SIMULATED" in pans.said().out
    for name in shipped_profiles():
        found = pans("info", name)
        assert (found["kind"], found["name"]) == ("profile", name)
    perfect = tmp_path / "perfect.toml"
    perfect.write_text(re.sub(r"(?m)^contrast *=.*$", "contrast = inf", load_profile("oled-qcmos").text))
    found = pans("info", perfect)
    assert found["object_modulator"]["contrast"] == "inf"


EXPECTED = {
    **{"profile": "ideal", "task": "test", "split": "test", "objects": 9, "accuracy": 0.5, "clicks": 1.0},
    **{"photons": 1.5, "illumination": 4.0, "exposures": 2.5},
}


def test_info_of_an_automaton(tmp_path: Path, pans: Pans) -> None:
    write_bundle(with_expected(automaton_bundle(diamond()), EXPECTED), tmp_path / "a.pans")
    found = pans("info", tmp_path / "a.pans")
    assert (found["encoder"], found["patterns"], found["back_ends"]) == ("automaton", 3, ["automaton"])
    assert found["expected"] == EXPECTED
    wanted = {"dark_states": 0, "states": 5, "leaves": 3, "outcomes": 2, "dwell_steps": 2, "exposures_longest": 3}
    wanted |= {"exposures_shortest": 3, "states_of_most_used_patterns": {"0": 2, "1": 2, "2": 1}}
    assert {name: found["automaton"][name] for name in wanted} == wanted
    assert main(["info", str(tmp_path / "a.pans")]) == 0
    text = pans.said().out
    assert all(words in text for words in ("expected.accuracy", "automaton.states", "automaton.exposures_longest"))
    write_bundle(automaton_bundle(early_leaf()), tmp_path / "b.pans")
    found = pans("info", tmp_path / "b.pans")
    assert found["automaton"]["exposures_shortest"] == 1


def test_verify_tells_of_an_odd_automaton(tmp_path: Path, pans: Pans) -> None:
    write_bundle(automaton_bundle(diamond()), tmp_path / "good.pans")
    pans("verify", tmp_path / "good.pans")
    half = Automaton([0], [1], 2, [[1, 1]], [[0.4, 0.3, 0.3], [0.5, 0.3, 0.2]])
    levels = [[3, 0, 0, 0], [0, 0, 0, 0]]
    write_bundle(automaton_bundle(half, pattern_levels=levels), tmp_path / "odd.pans")
    found = pans("verify", tmp_path / "odd.pans", code=1)
    assert found["violations"] == []
    messages = " ".join(item["message"] for item in found["alerts"])
    for sign in (
        "1 of 2 patterns are shown by no state (the first: 1)",
        *("the longest dwell is 1 of 2", "2 classes are never decided by any click word: c1, c2"),
    ):
        assert sign in messages


def test_info_reads_a_damaged_recording_as_far_as_it_goes(tmp_path: Path, pans: Pans) -> None:
    path = record(tmp_path / "a.pansrec", [decision(0)])
    path.write_bytes(path.read_bytes()[:-1] + b"\x00\x00")
    found = pans("info", path, code=2)
    assert found["damage"]
    assert found["decisions"] == 1
    found = pans("verify", path, code=2)
    assert found["files"][0]["damaged"]
    assert "1 decisions in the first" in found["violations"][1]["message"]


def make_inputs(folder: Path, d_f: int = 3, pixels: int = 4) -> list[str]:
    rng = np.random.default_rng(8)
    np.save(folder / "p.npy", rng.uniform(0, 0.7, size=(d_f, pixels)))
    np.save(folder / "t.npy", rng.normal(size=(1 << d_f, 2)))
    return ["bundle", "--patterns", str(folder / "p.npy"), "--table", str(folder / "t.npy"), "--classes", "left,right"]


def test_a_bundle_from_arrays(tmp_path: Path, pans: Pans) -> None:
    words = make_inputs(tmp_path)
    out = tmp_path / "made.pans"
    found = pans(*words, "--levels", "16", "-o", out)
    assert found["bundle"] == str(out)
    assert found["sha256"] == hashlib.sha256(out.read_bytes()).hexdigest()
    made, _ = load_bundle(out)
    patterns = np.load(tmp_path / "p.npy")
    assert (made.name, made.classes, made.image_shape, made.levels) == ("made", ("left", "right"), (2, 2), 16)
    assert made.pattern_levels.max() == 15
    assert made.photons_per_level == pytest.approx(patterns.max() / 15)
    error = np.abs(made.patterns() - patterns).max()
    assert error <= made.photons_per_level / 2 + 1e-12
    assert found["quantisation_error_max_photons"] == pytest.approx(error)
    np.testing.assert_array_equal(made.table, np.load(tmp_path / "t.npy").astype(np.float32))
    assert made.provenance["inputs"]["patterns"]["file"] == "p.npy"
    before = out.read_bytes()
    pans(*words, "--levels", "16", "-o", out, "--force")
    assert out.read_bytes() == before  # the same inputs give the same bytes
    pans("verify", out)


def test_a_bundle_of_photon_numbers(tmp_path: Path, pans: Pans) -> None:
    out, words = tmp_path / "numbers.pans", make_inputs(tmp_path)
    np.save(tmp_path / "p.npy", np.array([[0.2, 0.0], [0.2, 0.2]]))
    np.save(tmp_path / "t.npy", np.arange(18.0).reshape(9, 2) % 5)
    found = pans(*words, "--outcomes", "3", "--profile", "dmd-qcmos", "-o", out)
    assert found["exposure_us"] == pytest.approx(2000.0)
    assert load_bundle(out)[0].table[7].tolist() == [14 % 5, 15 % 5]
    told = pans("info", out)
    assert (told["photon_number_max"], told["table_rows"]) == (2, 9)
    found = pans(*words, "--outcomes", "4", "-o", tmp_path / "never.pans", code=2)
    assert "(4**d_f, classes) = (16, 2)" in found["error"]["message"]
    assert not (tmp_path / "never.pans").exists()


def test_a_bundle_from_a_head(tmp_path: Path, pans: Pans) -> None:
    weights = np.array([[1, -1], [2, 0], [0, 3]])
    (tmp_path / "h.onnx").write_bytes(affine_head(weights, np.zeros(2)))
    words = make_inputs(tmp_path)
    words[3:5] = ["--head", str(tmp_path / "h.onnx")]
    out = tmp_path / "made.pans"
    pans(*words, "-o", out)
    made, _ = load_bundle(out)
    assert made.levels == 124
    np.testing.assert_array_equal(made.table[0b101], [1, 2])
    words += ["--table", str(tmp_path / "t.npy"), "-o", str(out), "--force"]
    assert main(words) == 2  # this table is another back end's
    assert "disagree" in pans.said().err
    assert load_bundle(out)[0].n_features == 3


def test_a_profile_gives_levels_and_is_held_against_the_light(tmp_path: Path, pans: Pans) -> None:
    profile = load_profile("oled-qcmos")
    words = make_inputs(tmp_path)
    middle_us = (profile.exposure.min_us + profile.exposure.max_us) / 2
    patterns = np.full((3, 4), profile.projector.peak_photoelectrons_hz * middle_us * 1e-6)
    np.save(tmp_path / "p.npy", patterns)
    found = pans(*words, "--profile", "oled-qcmos", "-o", tmp_path / "o.pans")
    assert found["exposure_us"] == pytest.approx(middle_us)
    assert found["levels"] == profile.projector.levels
    np.save(tmp_path / "p.npy", patterns * 1e6)
    assert "too weak" in pans.refuses(*words, "--profile", "oled-qcmos", "-o", tmp_path / "o2.pans")
    assert not (tmp_path / "o2.pans").exists()


def dim_patterns(tmp_path: Path, data: dict[str, Any]) -> list[str]:
    """Two patterns, each lighting one half of 8 x 8 pixels dimly, with one bright pixel: rounded to one bit, the halves are dark."""
    patterns = np.zeros((2, 8, 8), np.float32)
    patterns[0, :4], patterns[1, 4:] = 0.3, 0.3
    patterns[:, 0, 0] = 1.0
    np.save(tmp_path / "p.npy", patterns.reshape(2, 64))
    np.save(tmp_path / "t.npy", np.array([[0, 0], [1, 0], [0, 1], [0, 0]], np.float32))
    np.savez(tmp_path / "d.npz", **data)
    words = ["bundle", "--patterns", tmp_path / "p.npy", "--table", tmp_path / "t.npy", "--classes", "above,below"]
    return [*map(str, words), "--levels", "2", "--data", str(tmp_path / "d.npz")]


def halves() -> dict[str, Any]:
    labels = np.arange(60) % 2
    images = np.zeros((60, 8, 8), np.uint8)
    images[labels == 0, :4], images[labels == 1, 4:] = 255, 255
    return {"images": images, "labels": labels}


def test_error_diffusion_keeps_the_accuracy_that_rounding_to_one_bit_loses(tmp_path: Path, pans: Pans) -> None:
    words = dim_patterns(tmp_path, halves())
    found, off = (pans(*words, "--dither", one, "-o", tmp_path / f"{one}.pans") for one in ("auto", "off"))
    assert (found["dithered"], off["dithered"]) == (True, False)
    assert found["accuracy_given"] > 0.98  # nearly ten photons of the right half, one of the other at most
    assert found["accuracy_shown"] > 0.98
    assert off["accuracy_shown"] < 0.6
    bundle, _ = load_bundle(tmp_path / "auto.pans")
    assert bundle.provenance["quantisation"]["dithered"]
    light = bundle.pattern_levels.sum() * bundle.photons_per_level
    assert light == pytest.approx(np.load(tmp_path / "p.npy").sum(), rel=0.15)

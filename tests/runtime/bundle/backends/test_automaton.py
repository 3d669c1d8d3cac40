"""The automaton as a back end: every walk as the oracle, exact expectations as sums over all words, abstention where nothing is sure."""

from dataclasses import replace
from fractions import Fraction

import naive_automaton as naive
import numpy as np
import pytest
from automata import automaton_bundle, diamond, early_leaf, random_automaton
from bundles import made_bundle

from pans.base.errors import DamagedFileError, UsageError
from pans.bundle.automaton import Automaton
from pans.bundle.backends import make_decider
from pans.bundle.backends.automaton import AutomatonDecider, walk_words
from pans.bundle.backends.expectation import ExpectedWalk, expected_walk
from pans.instrument.click_law import ClickLaw, CountLaw, click_probability
from pans.instrument.detector import Afterpulses

AUTOMATA = [early_leaf(), diamond(), random_automaton(1, slots=9), random_automaton(2, slots=5, channels=2)]


@pytest.mark.uncompiled
@pytest.mark.parametrize("automaton", AUTOMATA)
def test_every_walk_as_the_oracle(automaton: Automaton) -> None:
    words = np.random.default_rng(1).integers(0, 2, (300, automaton.n_bits))
    leaves, exposures = np.empty(300, np.uint32), np.empty(300, np.uint16)
    assert walk_words(automaton.successors, words, automaton.channels, leaves, exposures) == -1
    wanted = [naive.walk(automaton, word) for word in words.tolist()]
    assert leaves.tolist() == [walk.leaf for walk in wanted]
    assert exposures.tolist() == [len(walk.states) for walk in wanted]
    words[17, 0] = 2
    assert walk_words(automaton.successors, words, automaton.channels, leaves, exposures) == 17


@pytest.mark.parametrize("automaton", AUTOMATA)
def test_all_answers_of_a_decider_agree(automaton: Automaton) -> None:
    decider = make_decider(automaton_bundle(automaton))
    assert isinstance(decider, AutomatonDecider)
    assert (decider.n_features, decider.n_classes) == (automaton.n_bits, automaton.n_classes)
    words = np.random.default_rng(2).integers(0, 2, (50, automaton.n_bits))
    found, scores = decider.verdicts(words, 1), decider.scores_batch(words, 1)
    for i, word in enumerate(words):
        posterior = automaton.posteriors[automaton.n_states + naive.walk(automaton, word.tolist()).leaf]
        verdict = decider.decide(word, 1)
        assert verdict == (posterior.argmax(), posterior.max()) == (found.labels[i], found.probabilities[i])
        assert np.exp(scores[i]) == pytest.approx(posterior, rel=1e-6)
    assert decider.decide_batch(words, 1).tolist() == found.labels.tolist()


def test_ties_go_to_the_lowest_label() -> None:
    tied = Automaton([0], [1], 1, [[1, 2]], [[0.4, 0.3, 0.3], [0.25, 0.375, 0.375], [0.4, 0.2, 0.4]])
    assert make_decider(automaton_bundle(tied)).decide_batch([[0], [1]], 1).tolist() == [1, 0]


def test_what_cannot_answer_is_refused() -> None:
    bundle, fixed = automaton_bundle(), made_bundle(table=np.zeros((4, 2)))
    others = ("table", "onnx", "sparse", "int8", "float64", "count-table")
    for asked, facts, words in (
        *((bundle, {"backend": backend}, "its automaton decides") for backend in others),
        (bundle, {"shots": 3}, "not on 3 shots"),
        (fixed, {"backend": "automaton"}, "has no automaton"),
        (fixed, {"confidence": 0.9}, r"confidence is 0\.9"),
    ):
        with pytest.raises(UsageError, match=words):
            make_decider(asked, **facts)
    decider = make_decider(bundle, backend="automaton")
    for counts in ([2, 0, 0], [-1, 0, 0]):
        with pytest.raises(UsageError, match="numbers of 0 to 1"):
            decider.decide(np.array(counts), 1)
        with pytest.raises(ValueError, match="counts run from"):
            decider.decide_batch([counts], 1)


def test_golden_walks_bind_the_back_end() -> None:
    bundle = automaton_bundle()
    wrong = bundle.golden_walks.copy()
    wrong[3, -1] += 1 if wrong[3, -1] < 7 else -1
    with pytest.raises(DamagedFileError, match="golden walk 3"):
        make_decider(replace(bundle, golden_walks=wrong))
    with pytest.raises(DamagedFileError, match="contradicts the golden vectors"):
        make_decider(replace(bundle, golden_scores=bundle.golden_scores[::-1]))


def of_objects(automaton: Automaton, seed: int = 3, n: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.random((int(automaton.pattern.max()) + automaton.channels, 6)) * 0.6, rng.random((n, 6))


def light_of(automaton: Automaton, whole: np.ndarray, brightness: float) -> list[float]:
    """Photoelectrons of each state, of patterns that give `whole` (n_patterns,) at brightness 1 and full dwell."""
    return [
        brightness * float(whole[p]) * d / automaton.dwell_steps for p, d in zip(automaton.pattern, automaton.dwell)
    ]


def totals_of(found: ExpectedWalk) -> list[np.ndarray]:
    return [found.clicks, found.exposures, found.photons, found.illumination]


LAWS = [ClickLaw(), ClickLaw(0.02), ClickLaw(0.01, 0.3, 0.6), ClickLaw(0.0, 0.2, 1.5)]


@pytest.mark.uncompiled
@pytest.mark.parametrize("afterpulse", [0.0, 0.25])
@pytest.mark.parametrize("law", LAWS, ids=str)
@pytest.mark.parametrize("automaton", [early_leaf(), diamond(), random_automaton(5, slots=8)])
def test_expectations_are_sums_over_all_words(automaton: Automaton, law: ClickLaw, afterpulse: float) -> None:
    patterns, objects = of_objects(automaton)
    found = expected_walk(automaton, patterns, objects, law, photons_per_level=1.5, afterpulses=Afterpulses(afterpulse))
    for i, seen in enumerate(objects):
        light = light_of(automaton, patterns @ seen, 1.5)
        click = [float(click_probability(law, mu)) for mu in light]
        wanted = naive.expectation(automaton, [Fraction(p) for p in click], Fraction(1), Fraction(afterpulse))
        whole = light_of(automaton, patterns.sum(axis=1), 1.5)
        photons, illumination = (sum(float(p) * e for p, e in zip(wanted["shown"], each)) for each in (light, whole))
        totals = [float(wanted["clicks"]), float(wanted["exposures"]), photons, illumination]
        assert [sums[i] for sums in totals_of(found)] == pytest.approx(totals, rel=1e-12)
        assert found.first_clicked[i] == pytest.approx(click[0], rel=1e-12)
        assert found.leaves[i] == pytest.approx([float(chance) for chance in wanted["leaves"]], rel=1e-11, abs=1e-300)
        assert found.leaves[i].sum() == pytest.approx(1.0, abs=1e-13)


@pytest.mark.parametrize("brightness", [1e-12, 40.0, 150.0])
def test_chances_keep_their_digits_however_small(brightness: float) -> None:
    """A leaf behind a missed bright exposure, or behind a click in the dark, against 60 digits."""
    automaton = random_automaton(6, slots=7, width=3)
    patterns, objects = of_objects(automaton, n=2)
    found = expected_walk(automaton, patterns, objects, ClickLaw(), photons_per_level=brightness)
    mpmath = pytest.importorskip("mpmath", reason="needs the test extra")
    with mpmath.workdps(60):
        for i, seen in enumerate(objects):
            light = light_of(automaton, patterns @ seen, brightness)
            click = [1 - mpmath.exp(-mpmath.mpf(mu)) for mu in light]
            wanted = naive.expectation(automaton, click, mpmath.mpf(1))
            for chance, exact in zip(found.leaves[i], wanted["leaves"]):
                if exact > mpmath.mpf("1e-290"):  # below it float64 ends
                    assert abs(chance - exact) < 1e-10 * exact
            assert min(wanted["leaves"]) < 1e-10 or brightness < 1


def test_objects_in_pieces_are_objects_together(monkeypatch: pytest.MonkeyPatch) -> None:
    automaton = random_automaton(7, slots=6)
    patterns, objects = of_objects(automaton, n=23)
    whole = expected_walk(automaton, patterns, objects, ClickLaw(0.01), afterpulses=Afterpulses(0.1))
    monkeypatch.setattr("pans.bundle.backends.expectation._NUMBERS_AT_ONCE", 5 * len(automaton.posteriors))
    monkeypatch.setattr("pans.bundle.backends.expectation._PATTERNS_AT_ONCE", 2)
    pieces = expected_walk(automaton, patterns, objects, ClickLaw(0.01), afterpulses=Afterpulses(0.1))
    assert np.array(totals_of(pieces)) == pytest.approx(np.array(totals_of(whole)), rel=1e-13)
    assert pieces.leaves == pytest.approx(whole.leaves, rel=1e-13)


def test_expectations_refuse_what_does_not_fit() -> None:
    automaton, counting, two = diamond(), random_automaton(5, outcomes=3), AUTOMATA[3]
    patterns, objects = of_objects(automaton)
    pulses, counts = Afterpulses(0.1), CountLaw(0.0, 0.2, (0.5, 1.5))
    for walked, seen, law, afterpulses, words in (
        (automaton, (patterns[:, 1:], objects), ClickLaw(), Afterpulses(0.0), "the same pixels"),
        (automaton, (patterns[:2], objects), ClickLaw(), Afterpulses(0.0), "shows pattern 2 of 2"),
        (two, (of_objects(two)[0][:-1], objects), ClickLaw(), Afterpulses(0.0), "a state shows pattern"),
        (counting, of_objects(counting), counts, pulses, "the same outcomes, and no afterpulses"),
        (two, of_objects(two), ClickLaw(), pulses, "no afterpulses"),
    ):
        with pytest.raises(ValueError, match=words):
            expected_walk(walked, *seen, law, afterpulses=afterpulses)


@pytest.mark.parametrize("channels", [2, 3])
def test_expectations_of_several_channels_are_sums_over_all_words(channels: int) -> None:
    """Outcome by outcome in exact numbers: the chance of a word is the product over its channels."""
    automaton, law = random_automaton(5, slots=3, width=3, channels=channels), ClickLaw(0.01, 0.3, 0.6)
    patterns, objects = of_objects(automaton)
    found = expected_walk(automaton, patterns, objects, law, photons_per_level=1.5)
    for i, seen in enumerate(objects):
        sums, leaves = np.zeros(4), np.zeros(automaton.n_leaves)  # as totals_of
        going = [(0, Fraction(1), np.zeros(4))]
        while going:
            node, chance, met = going.pop()
            if node >= automaton.n_states:
                leaves[node - automaton.n_states] += float(chance)
                sums += float(chance) * met
                continue
            first, share = int(automaton.pattern[node]), automaton.dwell[node] / automaton.dwell_steps
            lit = [1.5 * patterns[first + channel] * share for channel in range(channels)]
            light = [float(part @ seen) for part in lit]
            click = [Fraction(float(click_probability(law, mu))) for mu in light]
            for word, part in enumerate(naive.word_chances(click, Fraction(1))):
                here = np.array([bin(word).count("1"), 1.0, sum(light), sum(part.sum() for part in lit)])
                going.append((int(automaton.successors[node, word]), chance * part, met + here))
        np.testing.assert_allclose([totals[i] for totals in totals_of(found)], sums, rtol=1e-11)
        np.testing.assert_allclose(found.leaves[i], leaves, rtol=1e-10, atol=1e-300)

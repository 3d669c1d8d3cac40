"""Merging by the information bottleneck: against an oracle that recomputes every cost, and on cases with a known answer."""

import numpy as np
import pytest
from naive_adaptive import merged as oracle

from pans.trainer.adaptive.grow import merged


@pytest.mark.uncompiled
@pytest.mark.parametrize("seed", range(5))
def test_merges_as_the_oracle(seed):
    rng = np.random.default_rng(seed)
    counts = rng.gamma(0.3, 10, (14, 4))
    for wanted in (13, 6, 2, 1):
        found = merged(counts, wanted)
        groups = [np.flatnonzero(found == group).tolist() for group in range(wanted)]
        assert sorted(groups, key=lambda group: group[0]) == oracle(counts.tolist(), wanted)


def test_same_posteriors_are_merged_first_whatever_their_mass():
    counts = np.array([[90.0, 10.0], [1.0, 9.0], [9.0, 1.0], [50.0, 450.0], [5.0, 5.0]])
    found = merged(counts, 3)
    assert found[0] == found[2]
    assert found[1] == found[3]
    assert len(set(found.tolist())) == 3


def test_empty_nodes_cost_nothing():
    found = merged(np.array([[0.0, 0.0], [3.0, 1.0], [1.0, 3.0], [0.0, 0.0]]), 2)
    assert found[1] != found[2]


def test_nothing_to_merge_and_nonsense():
    assert merged(np.ones((3, 2)), 5).tolist() == [0, 1, 2]
    for counts, wanted in ((np.ones((3, 2)), 0), (-np.ones((3, 2)), 2), (np.full((3, 2), np.nan), 2)):
        with pytest.raises(ValueError, match="groups"):
            merged(counts, wanted)

"""A sweep that moves edges: it never raises the loss of its objects, and leaves no node without an edge."""

# ruff: noqa: E402  (what follows needs torch)
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from trainings import bars_task

from pans.runtime.instrument.click_law import ClickLaw
from pans.runtime.instrument.profile import load_profile
from pans.trainer.adaptive import sweeps as module
from pans.trainer.adaptive.grow import GrowOptions, Growth
from pans.trainer.adaptive.machine import Sight, forward
from pans.trainer.adaptive.objects import Augmentation, TrainingObjects
from pans.trainer.adaptive.sweeps import reroute
from pans.trainer.adaptive.tune import figures

PRICE = 0.02


@pytest.fixture
def grown():
    objects = TrainingObjects(bars_task(), load_profile("ideal"), 0, Augmentation())
    blocks = objects.epoch(0, 200, torch.float32)
    sight = Sight(ClickLaw(), objects.gain)
    with torch.no_grad():
        growth = Growth(blocks, sight, GrowOptions(states=8), torch.Generator().manual_seed(0))
        for _ in range(6):
            growth.grow(PRICE)
    return growth.machine(), sight, blocks


def cost(machine, sight, blocks):
    found = figures(machine, sight, blocks)
    return found.loss + PRICE * found.photons


def test_edges_spoiled_are_put_right(grown, monkeypatch):
    machine, sight, blocks = grown
    good = cost(machine, sight, blocks)
    for level in machine.levels[2:5]:
        level.successors = level.successors.flip(1)
    spoiled = cost(machine, sight, blocks)
    assert spoiled > good + 0.05
    monkeypatch.setattr(module, "SURE", 0.0)
    for _ in range(3):
        before = cost(machine, sight, blocks)
        found = reroute(machine, sight, blocks, PRICE)
        after = cost(machine, sight, blocks)
        assert found.moved > 0
        assert (
            after <= before + 2e-3
        )  # the light is kept in bfloat16, and revived leaves are counted anew by the caller
    assert after < good + 0.3 * (spoiled - good)


def test_nodes_without_an_edge_are_revived(grown, monkeypatch):
    machine, sight, blocks = grown
    monkeypatch.setattr(module, "SURE", 1e9)  # so that no other edge moves
    machine.levels[3].successors[:] = 0
    assert reroute(machine, sight, blocks, PRICE).revived >= 7
    used = torch.bincount(machine.levels[3].successors.flatten(), minlength=8)
    assert bool((used > 0).all())


DEAR = 0.03  # nats per exposure


def test_walks_end_where_exposures_cost_more_than_they_bring(grown, monkeypatch):
    machine, sight, blocks = grown
    monkeypatch.setattr(module, "SURE", 0.0)

    def dear():
        return cost(machine, sight, blocks) + DEAR * figures(machine, sight, blocks).exposures

    before, all_of_them = dear(), figures(machine, sight, blocks).exposures
    found = reroute(machine, sight, blocks, PRICE, DEAR)
    after, walked = dear(), figures(machine, sight, blocks)
    assert all_of_them == pytest.approx(6.0, abs=1e-4)
    assert found.stopped > 0
    assert walked.exposures < 5.5
    assert sum(len(counts) for counts in machine.counts[:-1]) == found.stopped
    assert before - after > 0.9 * found.saved > 0.01  # what the sweep promised; revived leaves are counted anew later
    first = next(number for number, counts in enumerate(machine.counts) if len(counts))
    early = sum(float(forward(machine, sight, block.grey).leaves[first].sum()) for block in blocks)
    counted = float(machine.counts[first].sum()) - len(machine.counts[first])  # and an object per leaf, for its doubts
    assert counted == pytest.approx(
        early, rel=0.05
    )  # nothing before it moved after it; the sweep sees light in bfloat16


def test_only_sure_gains_move_edges(grown, monkeypatch):
    machine, sight, blocks = grown
    monkeypatch.setattr(module, "SURE", 1e9)
    assert reroute(machine, sight, blocks, PRICE).moved == 0

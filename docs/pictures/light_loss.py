"""Which loss of light the watch of an automaton's states finds, by its formula: `python docs/pictures/light_loss.py`.

The shipped automaton on the shipped images: by how much the clicks fall of what its states gave before, and after how many walks as long
before as after the loss that passes the threshold of one false alarm per week. Prints the table of docs/measurements/index.md.
"""

import numpy as np

from pans.base import SHIPPED
from pans.bundle.backends import pattern_light
from pans.bundle.sensor import load_bundle
from pans.decide.dark import LOOK_S, TOLERATED, WEEK_S, found_at
from pans.decide.plan import build_plan
from pans.instrument.click_law import both_chances, click_law, object_transmission
from pans.instrument.profile import load_profile
from pans_sim import scenes

WALKS = (2_500, 5_000, 10_000, 20_000, 50_000, 100_000, 1_000_000)
LOSSES = np.arange(0.01, 0.6, 0.01)


def main() -> None:
    bundle, profile = load_bundle(SHIPPED / "fashion-adaptive.pans")[0], load_profile("dmd-spad")
    with np.load(next(iter(scenes.__path__)) + "/fashion200.npz") as file:
        images = file["images"]
    seen = object_transmission(profile, images.reshape(len(images), -1))
    automaton, law = bundle.automaton, click_law(profile, build_plan(profile, bundle).exposure_us)
    light = pattern_light(bundle.pattern_levels, seen, bundle.photons_per_level)[:, automaton.rows[:, 0]]
    light *= automaton.dwell / automaton.dwell_steps

    def rates(left: float) -> tuple[np.ndarray, np.ndarray]:
        """Exposures and clicks per walk of each state with `left` of the light; afterpulses are left out."""
        reached, click = np.zeros((len(seen), len(automaton.posteriors))), both_chances(law, light * left)[0]
        reached[:, 0] = 1.0
        for state in np.argsort(automaton.depth, kind="stable").tolist():
            for outcome, chance in enumerate((1 - click[:, state], click[:, state])):
                reached[:, automaton.successors[state, outcome]] += reached[:, state] * chance
        reached = reached[:, : automaton.n_states]
        return reached.mean(axis=0), (reached * click).mean(axis=0)

    shown, clicked = rates(1.0)
    share = clicked / np.maximum(shown, 1e-300)
    spread = float((clicked * (1 - share)).sum())  # variance of the clicks beyond those expected, per walk
    falls = np.array([float((after[0] * share - after[1]).sum()) for after in map(rates, 1 - LOSSES)])
    looks = WEEK_S / LOOK_S
    print("walks before, and as many since | loss of light that is found\n---|---")
    for walks in WALKS:
        half = walks / 2
        least = TOLERATED * clicked.sum() + found_at(spread * half, looks) / half
        found = np.flatnonzero(falls >= least)
        print(f"{walks:,} | {f'{100 * LOSSES[found[0]]:.0f} %' if len(found) else 'none below 60 %'}")


if __name__ == "__main__":
    main()

"""The arguments of `pans train`: their names, defaults and help, and which of them belong to an automaton.

Owns the command line alone; what the arguments mean for a task is said in train.py and train_automaton.py.
"""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path

from pans.runtime.cli import add_new_bundle
from pans.runtime.ranges import Range
from pans.trainer.options import BUDGETS, ENCODERS, ESTIMATOR_NAMES, HEADS, Options

from .arguments import add_data_dir, add_order_and_bleach, add_threads

SEED = Range(0, (1 << 63) - 1, whole=True)

DEFAULT_PROFILE = "oled-qcmos"
AUTOMATON = "automaton"
# options that are numbers, with the defaults of Options: name, metavar, help
NUMBERS = (
    ("input_photons", "N", "mean photoelectrons that reach a passive encoder in one exposure"),
    ("clicks", "C", "clicks per decision to aim for, beside either"),
    ("illumination", "L", "photoelectrons to send per decision, summed over all pixels of all patterns"),
    ("epochs", "E", "passes over the training objects (default 60)"),
    ("restarts", "R", "trainings; the best on validation stays"),
    ("starts", "S", "runs of the first stage per restart; the best goes on"),
    ("warm", "W", "part of the epochs in the first stage"),
    ("polish", "P", "last part of the epochs, trained for decisions (default 0)"),
    (
        "spread",
        "W",
        "weight in the loss of how concentrated the light of a pattern is, for optics that are not perfect (default 0)",
    ),
    ("similarity", "S", "of pictures: share of 1 - SSIM in the loss, the rest being the squared error (default 0)"),
    ("mix", "M", "share of the loss of 2 to K shots, for patterns too (default 0)"),
    ("shots", "K", "fit the head to 1 to K shots (default 1)"),
    ("shift_px", "X", "move training images by up to X along the rows (default 0)"),
    ("offset_px", "Y", "and by up to Y across them (default 0)"),
    ("strength", "F", "of an automaton: of the distortions, times the usual (default 0.3)"),
    ("rate", "R", "of an automaton: learning rate of its last stage (default 0.01)"),
    ("decide", "F", "of an automaton: part of the last loss that counts wrong decisions (default 0.7)"),
    ("exposure_price", "P", "of an automaton: nats per exposure; walks then end early where that pays (default 0)"),
    (
        "soft",
        "W",
        "of an automaton: weight of a network's answers in the targets (default: 0.5 for fashion-mnist, else 0)",
    ),
    (
        "copies",
        "N",
        "add N distorted copies of every training image: turned, stretched, bent a little (default 0; of an automaton for mnist 20)",
    ),
    ("seed", "N", "of everything random (default 0)"),
    ("hidden", "H", "hidden units of the head (default 512)"),
    ("batch", "B", "objects per step (default 512; of an automaton 250)"),
    ("slope", "S", "slope annealing: light at the start times S"),
    ("clamp", "L", "clamp photoelectrons early in training"),
    ("dark", "R", "dark photoelectrons per exposure in training, instead of the profile's"),
)
OF_AUTOMATA = (
    *("exposures", "states", "patterns", "grey", "strength", "decide", "exposure_price", "soft", "teacher"),
    *("start", "rate", "reroutes", "channels"),
)
AS_GIVEN = (
    *("features", "photons", "budget", "complex_field", "optics", "bleach", "outcomes"),
    *(name for name, _, _ in NUMBERS if name not in OF_AUTOMATA),
)


def configure_train(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `pans train`."""
    parser.add_argument(
        "task", metavar="TASK", help="a name (`pans data list`), a .npz file, or a folder of class folders"
    )
    parser.add_argument("--features", type=int, metavar="D", help="number of patterns (not of an automaton)")
    parser.add_argument("--profile", metavar="P", help=f"default: {DEFAULT_PROFILE}; of an automaton ideal")
    parser.add_argument(
        "--encoder",
        choices=(*ENCODERS, AUTOMATON),
        help="how light meets the object (default: what the task's is); automaton: each pattern follows from the clicks before it",
    )
    _add_of_automata(parser)
    _add_of_fixed(parser)
    defaults = {field.name: field.default for field in fields(Options)}
    for name, metavar, words in NUMBERS:
        flag, default = "--" + name.replace("_", "-"), defaults.get(name)
        kind = float if default is None else type(default)
        read = SEED.option if name == "seed" else kind
        parser.add_argument(flag, type=read, metavar=metavar, help=words)
    parser.add_argument(
        "--optics",
        metavar="SPEC",
        help="train through optics drawn within this tolerance, like shift=1:rotate=2:psf=0.5..0.8:black=0.002",
    )
    parser.add_argument(
        "--data-seed", type=SEED.option, default=0, metavar="N", help="of a drawn task's images (default 0)"
    )
    parser.add_argument("--history", type=Path, metavar="DIR", help="write and draw how the training went (extra plot)")
    parser.add_argument(
        "--device",
        choices=("cpu", "cuda"),
        default="cpu",
        help="where to compute (default cpu); changes the random numbers",
    )
    add_threads(parser)
    parser.add_argument("--resume", action="store_true", help="go on from OUT.pans.checkpoint")
    parser.add_argument("--name", metavar="NAME", help="the bundle's name (default: that of the output file)")
    add_data_dir(parser)
    parser.add_argument(
        "--as-is",
        action="store_true",
        help="of your own images: choose nothing from them, take the options and defaults as they are",
    )
    add_new_bundle(parser)


def _add_of_automata(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--exposures", type=int, metavar="T", help="of an automaton: exposures per decision (default: by the budget)"
    )
    parser.add_argument(
        "--states", type=int, metavar="S", help="of an automaton: most states per exposure (default: by the budget)"
    )
    parser.add_argument(
        "--patterns",
        type=int,
        metavar="P",
        help="of an automaton: most different patterns, which states share (default: the projector's memory)",
    )
    parser.add_argument(
        "--outcomes",
        type=int,
        metavar="K",
        help="outcomes of an exposure; 3: no photon, one, two or more, on a detector that counts (default 2)",
    )
    parser.add_argument(
        "--channels",
        type=int,
        metavar="C",
        help="of an automaton: detectors that are read at once, each with a pattern of its own (default 1, at most 4)",
    )
    parser.add_argument(
        "--grey", action="store_true", help="of an automaton: patterns in all levels, not one bit and a brightness"
    )
    parser.add_argument(
        "--teacher",
        type=Path,
        metavar="FILE.npz",
        help="of an automaton: the network's answers are read from there; where nothing is, they are made and kept there",
    )
    parser.add_argument(
        "--reroutes", type=int, metavar="R", help="of an automaton: sweeps that move edges to better states (default 2)"
    )
    parser.add_argument(
        "--start",
        type=Path,
        metavar="OLD.pans",
        help="of an automaton: train on the patterns and states of that one, instead of growing new ones",
    )


def _add_of_fixed(parser: argparse.ArgumentParser) -> None:
    """Optics, estimator and head; the budget of light, which automata have too."""
    parser.add_argument("--complex-field", action="store_true", help="a coherent encoder's W is complex, not real")
    made = parser.add_mutually_exclusive_group()
    made.add_argument(
        "--conserving", action="store_true", help="a passive encoder gives no more light than it gets (default)"
    )
    made.add_argument(
        "--unconstrained",
        action="store_true",
        help="a passive encoder may give more light than it gets, as the paper's does",
    )
    parser.add_argument(
        "--estimator", choices=ESTIMATOR_NAMES, help="default: exact up to 12 patterns, else local; of pictures ste"
    )
    parser.add_argument(
        "--head", choices=HEADS, help="digital back end (default mlp; picture where the task asks for it)"
    )
    add_order_and_bleach(parser)
    light = parser.add_mutually_exclusive_group()
    light.add_argument(
        "--alpha", type=float, metavar="A", help="weight of the illumination in the loss (default 0.0003)"
    )
    light.add_argument("--photons", type=float, metavar="B", help="photoelectrons per decision to aim for")
    parser.add_argument(
        "--budget",
        choices=tuple(BUDGETS),
        help="how strictly --photons, --clicks and --illumination hold during training (default firm)",
    )

"""Accuracy against the weight of the illumination: `python -m pans.trainer.commands.alpha_sweep TASK --features D --alphas ... -o DIR`.

Owns the walk over alphas and its two pictures (extra `plot`); training, history and measuring are the ordinary ones. SIMULATED.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from pans.runtime.cli import say
from pans.runtime.container import replace_file
from pans.runtime.instrument.profile import load_profile
from pans.trainer.export.writer import export_trained
from pans.trainer.figures import new_figure, save_figure
from pans.trainer.options import EXACT_FEATURES_MAX, Options, check_options
from pans.trainer.tasks.registry import load_task
from pans.trainer.train.history import History, draw_curves
from pans.trainer.train.loop import EpochReport, train

from .evaluate import add_data_dir, first, measure

ALPHAS = (1e-5, 1e-4, 3e-4, 1e-3, 3e-3)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m pans.trainer.commands.alpha_sweep", description=__doc__.split("\n")[0]
    )
    parser.add_argument("task", help="as of `pans train`")
    parser.add_argument("--features", type=int, required=True, metavar="D")
    parser.add_argument("--alphas", type=float, nargs="+", default=list(ALPHAS), metavar="A")
    parser.add_argument("--profile", default="oled-qcmos")
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--hidden", type=int, default=128)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--objects", type=int, help="held-out objects to judge by (default: all)")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="DIR")
    add_data_dir(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Train one bundle per alpha into DIR, and draw what they cost and what they decide."""
    args = _parser().parse_args(argv)
    torch.set_num_threads(1)
    profile, task = load_profile(args.profile), load_task(args.task, args.data_dir)
    args.out.mkdir(parents=True, exist_ok=True)
    estimator = "exact" if args.features <= EXACT_FEATURES_MAX else "local"
    base = Options(features=args.features, estimator=estimator, epochs=args.epochs, hidden=args.hidden, seed=args.seed)
    rows: list[dict[str, Any]] = []
    courses: dict[str, list[EpochReport]] = {}
    for alpha in sorted(args.alphas):
        options = replace(base, alpha=alpha)
        check_options(options, profile)
        name = f"alpha-{alpha:g}"
        checkpoint = args.out / f"{name}.checkpoint"
        history = History(checkpoint, options, task.sha256)
        trained = train(task, profile, options, checkpoint=checkpoint, report=history.take)
        bundle = export_trained(args.out / f"{name}.pans", trained, task, profile, name=name, provenance={}).bundle
        checkpoint.unlink()
        history.write(args.out / name, bundle.patterns(), task.image_shape)
        courses[f"alpha {alpha:g}"] = history.epochs
        measured = asdict(measure(bundle, profile, first(task.test, args.objects), 1, None, 0, fall_back=True))
        rows.append({"alpha": alpha, **measured})
        say(f"{name}: {100 * measured['accuracy_mean']:.2f} % at {measured['clicks_mean']:.2f} clicks")
    draw_curves(args.out / "curves.png", courses)
    _draw(args.out / "alpha.png", rows, f"{task.name}, {args.features} patterns")
    facts = {"simulated": True, "task": task.name, "profile": profile.name, "seed": args.seed, "epochs": args.epochs}
    replace_file(args.out / "alpha.json", (json.dumps({**facts, "rows": rows}, indent=1) + "\n").encode())
    return 0


def _draw(path: Path, rows: list[dict[str, Any]], title: str) -> None:
    figure, (left, right) = new_figure()
    alphas = [row["alpha"] for row in rows]
    accuracy = [100 * row["accuracy_mean"] for row in rows]
    error = [100 * row["accuracy_se_objects"] for row in rows]
    left.errorbar(alphas, accuracy, yerr=error, fmt="o-", label="accuracy; bars: error from the objects")
    left.set(xscale="log", xlabel="alpha, weight of the illumination", ylabel="accuracy, %", title=title)
    for key in ("clicks_mean", "photons_mean", "illumination"):
        right.plot(alphas, [row[key] for row in rows], "o-", label=key.removesuffix("_mean"))
    right.set(xscale="log", yscale="log", xlabel="alpha, weight of the illumination", ylabel="per decision")
    for axis in (left, right):
        axis.grid(alpha=0.3)
        axis.legend()
    figure.suptitle("SIMULATED", fontsize=9)
    save_figure(figure, path)


if __name__ == "__main__":
    sys.exit(main())

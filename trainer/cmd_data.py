"""`pans data`: the public sets (listed, fetched), and scenes for the simulator made from any task.

Owns the command's arguments and how its answers look; the sets are public_sets.py's, the drawn objects generators.py's. A scene is a .npz
file with images, labels and classes (docs/SIMULATOR.md): objects that stand still, or cells for a scene that moves.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

import numpy as np

from pans.runtime.cli import EXIT_FINE, Command, emit, say
from pans.runtime.container import replace_file
from pans.runtime.errors import PansError, UsageError

from .cmd_evaluate import add_data_dir
from .generators import GENERATORS
from .tasks import Objects, draw_task, load_task

PARTS = ("test", "train")


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "action", choices=("list", "fetch", "scene"), help="what is there, fetch what is not, or write a scene"
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="public sets (default: all), or the scene's one task")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE.npz", help="the scene to write")
    parser.add_argument("--objects", type=int, metavar="N", help="the first N objects of the part (default: all)")
    parser.add_argument("--part", choices=PARTS, default="test", help="which objects (default: held out, test)")
    parser.add_argument("--data-seed", type=int, default=0, metavar="N", help="of drawn tasks (default 0)")
    add_data_dir(parser)


def _data(args: argparse.Namespace) -> int:
    return _scene(args) if args.action == "scene" else _sets(args)


def _scene(args: argparse.Namespace) -> int:
    if len(args.names) != 1 or args.out is None:
        raise UsageError(
            "a scene is made of one task and written to one file", remedy="pans data scene TASK -o FILE.npz"
        )
    if args.out.suffix != ".npz":
        raise UsageError(f"{args.out}: a scene's name ends in .npz")
    if args.objects is not None and args.objects < 1:
        raise UsageError(f"--objects is {args.objects}, allowed: 1 or more")
    classes, objects = _objects(args.names[0], args)
    part = objects if args.objects is None else Objects(objects.images[: args.objects], objects.labels[: args.objects])
    data = io.BytesIO()
    np.savez_compressed(data, images=part.images, labels=part.labels.astype(np.int16), classes=np.array(classes))
    replace_file(args.out, data.getvalue())
    height, width = part.images.shape[1:]
    payload = {"scene": str(args.out), "task": args.names[0], "part": args.part, "objects": len(part)}
    payload |= {"height_px": height, "width_px": width, "classes": list(classes), "bytes": len(data.getvalue())}
    emit(args, payload, f"{args.out}  {len(part)} objects of {height} x {width} pixels, classes {', '.join(classes)}")
    return EXIT_FINE


def _objects(name: str, args: argparse.Namespace) -> tuple[tuple[str, ...], Objects]:
    """The classes and the wanted part; of a drawn task no more objects than were asked for are drawn."""
    if name in GENERATORS:
        wanted = {f"n_{part}": args.objects if part == args.part else 1 for part in PARTS}
        task = draw_task(name, args.data_seed, **wanted)
    else:
        task = load_task(name, args.data_dir)
    return task.classes, task.test if args.part == "test" else task.train


def _sets(args: argparse.Namespace) -> int:
    from .public_sets import PUBLIC_SETS, check_pinned, data_folder, fetch

    unknown = [name for name in args.names if name not in PUBLIC_SETS]
    if unknown:
        raise UsageError(f"no data set {unknown[0]!r}, allowed: {', '.join(PUBLIC_SETS)}")
    folder = data_folder(args.data_dir)
    rows = []
    for name in args.names or PUBLIC_SETS:
        for pinned in PUBLIC_SETS[name].files:
            path = folder / PUBLIC_SETS[name].folder / pinned.name
            if args.action == "fetch" and fetch(PUBLIC_SETS[name].source + pinned.name, path, pinned):
                say(f"fetched {path}")
            try:
                check_pinned(path, pinned)
                state = "ok"
            except PansError as error:
                state = "missing" if isinstance(error, UsageError) else "altered"
            rows.append(
                {"set": name, "file": pinned.name, "bytes": pinned.n_bytes, "sha256": pinned.sha256, "state": state}
            )
    text = "\n".join(f"{row['state']:<8} {row['set']:<14} {row['file']:<28} {row['bytes']:>10}" for row in rows)
    emit(args, {"folder": str(folder), "rows": rows}, f"{text}\nin {folder}")
    return EXIT_FINE


DATA = Command("list or fetch the public data sets; write a scene for the simulator", _configure, _data)

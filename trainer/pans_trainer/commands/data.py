"""`pans data`: the public sets (listed, fetched), and scenes for the simulator made from any task.

A scene is a .npz file with images, labels and classes (docs/reference/simulator.md): objects that stand still, or cells for one that moves.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from pans.app.command import Command, add_force, new_file
from pans.base.console import emit, say
from pans.base.errors import EXIT_FINE, PansError, UsageError
from pans.base.files import check_outputs, npz_bytes, write_file
from pans_trainer.tasks.generators import GENERATORS
from pans_trainer.tasks.public_sets import PUBLIC_SETS, check_pinned, data_folder, fetch
from pans_trainer.tasks.registry import FIBRE_TASKS, Objects, draw_task, load_task

from .arguments import add_data_dir, add_reading, reading_from

PARTS = ("test", "train")


def _configure(parser: argparse.ArgumentParser) -> None:
    words = "what is there, fetch what is not, or write a scene"
    parser.add_argument("action", choices=("list", "fetch", "scene"), help=words)
    parser.add_argument("names", nargs="*", metavar="NAME", help="public sets (default: all), or the scene's one task")
    parser.add_argument("-o", "--out", type=new_file, metavar="FILE.npz", help="the scene to write")
    parser.add_argument("--objects", type=int, metavar="N", help="the first N objects of the part (default: all)")
    parser.add_argument("--part", choices=PARTS, default="test", help="which objects (default: held out, test)")
    parser.add_argument("--data-seed", type=int, default=0, metavar="N", help="of drawn tasks (default 0)")
    add_reading(parser)
    add_force(parser)
    add_data_dir(parser)


def _data(args: argparse.Namespace) -> int:
    if args.action != "scene":
        return _sets(args)
    if len(args.names) != 1 or args.out is None:
        what = "a scene is made of one task and written to one file"
        raise UsageError(what, remedy="pans data scene TASK -o FILE.npz")
    if args.out.suffix != ".npz":
        raise UsageError(f"{args.out}: a scene's name ends in .npz", remedy=f"-o {args.out.with_suffix('.npz')}")
    if args.objects is not None and args.objects < 1:
        raise UsageError(f"--objects is {args.objects}, allowed: 1 or more")
    check_outputs([args.out], inputs=args.names, force=args.force)
    classes, objects = _objects(args.names[0], args)
    part = objects.first(args.objects)
    data = npz_bytes(images=part.images, labels=part.labels.astype(np.int16), classes=np.array(classes))
    write_file(args.out, data, force=args.force)
    height, width = part.images.shape[1:]
    payload = {"scene": str(args.out), "task": args.names[0], "part": args.part, "objects": len(part)}
    payload |= {"height_px": height, "width_px": width, "classes": list(classes), "bytes": len(data)}
    emit(args, payload, f"{args.out}  {len(part)} objects of {height} x {width} pixels, classes {', '.join(classes)}")
    return EXIT_FINE


def _objects(name: str, args: argparse.Namespace) -> tuple[tuple[str, ...], Objects]:
    """The classes and the wanted part; of a drawn task no more objects than were asked for are drawn."""
    if name in GENERATORS:
        wanted = {f"n_{part}": args.objects if part == args.part else 1 for part in PARTS}
        task = draw_task(name, args.data_seed, **wanted)
    else:
        task = load_task(name, args.data_dir, reading=reading_from(args))
        for line in task.account.lines() if task.account else ():
            say(line)
    return task.classes, task.test if args.part == "test" else task.train


def _sets(args: argparse.Namespace) -> int:
    unknown = [name for name in args.names if name not in PUBLIC_SETS]
    if unknown:
        raise UsageError(f"no data set {unknown[0]!r}, allowed: {', '.join(PUBLIC_SETS)}")
    folder = data_folder(args.data_dir)
    rows = [row for name in args.names or PUBLIC_SETS for row in _files(folder, name, fetching=args.action == "fetch")]
    payload = {"folder": str(folder), "rows": rows}
    text = "\n".join(f"{row['state']:<8} {row['set']:<14} {row['file']:<28} {row['bytes']:>10}" for row in rows)
    text += f"\nin {folder}"
    if args.action == "list" and not args.names:
        payload["tasks"] = tasks = _tasks({str(row["set"]) for row in rows if row["state"] != "ok"})
        lines = (f"{task['task']:<16} {task['encoder']:<10} {task['state']:<15} {task['about']}" for task in tasks)
        text += "\n\ntask             encoder    images\n" + "\n".join(lines)
    emit(args, payload, text)
    return EXIT_FINE


def _files(folder: Path, name: str, *, fetching: bool) -> list[dict[str, object]]:
    """The state of each file of a public set, fetched before if wanted."""
    rows: list[dict[str, object]] = []
    for pinned in PUBLIC_SETS[name].files:
        path = folder / PUBLIC_SETS[name].folder / pinned.name
        if fetching and fetch(PUBLIC_SETS[name].source + pinned.name, path, pinned):
            say(f"fetched {path}")
        try:
            check_pinned(path, pinned)
            state = "ok"
        except PansError as error:
            state = "missing" if isinstance(error, UsageError) else "altered"
        facts = {"set": name, "file": pinned.name, "bytes": pinned.n_bytes, "sha256": pinned.sha256}
        rows.append({**facts, "state": state})
    return rows


def _tasks(absent: set[str]) -> list[dict[str, str]]:
    """Every task by name: the encoder that its physics asks for, and whether its images can be had now."""
    found = [
        (name, "active", "not there" if name in absent else "there", f"public, {one.licence}")
        for name, one in PUBLIC_SETS.items()
    ]
    mnist = "not there" if "mnist" in absent else "there"
    wants = {"class": "which digit", "image": "the image itself is asked for"}
    found += [
        (name, "coherent", mnist, f"MNIST behind a fibre: {wants[target]}") for name, target in FIBRE_TASKS.items()
    ]
    found += [(name, one.encoder, "drawn on demand", one.summary) for name, one in GENERATORS.items()]
    return [dict(zip(("task", "encoder", "state", "about"), row)) for row in found]


DATA = Command(
    "list or fetch the public data sets; write a scene for the simulator",
    _configure,
    _data,
    examples=("pans data list", "pans data scene parts -o parts.npz"),
)

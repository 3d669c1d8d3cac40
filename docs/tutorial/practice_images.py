"""Draw a folder of made-up images to practise on: `python practice_images.py shapes my-shapes`.

Three sets, each a folder with one folder of pictures per class, the same for the same seed:

- `shapes`:  1200 pictures of 32 x 32 pixels, grey PNG: discs, squares, triangles and crosses, moved, turned and resized at random;
- `letters`: 300 pictures of 24 x 24 pixels, colour PNG and TIFF: five letters, tilted and moved, in strokes of several widths and colours;
- `rods`:    3000 pictures of 40 x 32 pixels, grey PNG, BMP and JPEG: a rod in one of six directions, off the middle, over dust.

Needs numpy and Pillow.
"""

import math
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

FINER = 4  # drawn that much larger, then reduced, for smooth edges
LETTERS = {
    "H": [[(-1, -1), (-1, 1)], [(1, -1), (1, 1)], [(-1, 0), (1, 0)]],
    "L": [[(-1, -1), (-1, 1), (1, 1)]],
    "T": [[(-1, -1), (1, -1)], [(0, -1), (0, 1)]],
    "X": [[(-1, -1), (1, 1)], [(1, -1), (-1, 1)]],
    "Z": [[(-1, -1), (1, -1), (-1, 1), (1, 1)]],
}


def corners(radii, turn, place):
    """Return the corners of a polygon: one radius per corner, evenly spaced angles, turned and moved."""
    angles = turn + 2 * math.pi * np.arange(len(radii)) / len(radii)
    return [(place[0] + r * math.cos(a), place[1] + r * math.sin(a)) for r, a in zip(radii, angles)]


def smooth(size, colour_mode="L"):
    """Return an empty picture, drawn on larger than `size` (width, height), and its pen."""
    picture = Image.new(colour_mode, (FINER * size[0], FINER * size[1]))
    return picture, ImageDraw.Draw(picture)


def draw_shape(kind, rng):
    """A filled shape on black, of about the same area whatever its kind."""
    picture, pen = smooth((32, 32))
    place, turn = FINER * (16 + rng.uniform(-3, 3, 2)), math.radians(rng.uniform(-30, 30))
    size, grey = FINER * rng.uniform(6.5, 9), int(rng.integers(170, 256))
    if kind == "disc":
        pen.polygon(corners([0.85 * size] * 60, turn, place), fill=grey)
    elif kind == "square":
        pen.polygon(corners([1.06 * size] * 4, turn, place), fill=grey)
    elif kind == "triangle":
        pen.polygon(corners([1.32 * size] * 3, turn, place), fill=grey)
    else:  # a cross: two bars
        for more in (0, math.pi / 2):
            along, across = np.array([math.cos(turn + more), math.sin(turn + more)]), 0.38 * size
            side = across * np.array([-along[1], along[0]])
            ends = place - 1.15 * size * along, place + 1.15 * size * along
            pen.polygon([tuple(p) for p in (ends[0] - side, ends[1] - side, ends[1] + side, ends[0] + side)], fill=grey)
    return picture.resize((32, 32), Image.Resampling.BOX), "png"


def draw_letter(kind, rng):
    """A letter in a random light colour on a dark one."""
    picture, pen = smooth((24, 24), "RGB")
    turn, height, width = rng.uniform(-0.26, 0.26), rng.uniform(6, 8), rng.uniform(4, 6)
    place, colour = FINER * (12 + rng.uniform(-2, 2, 2)), tuple(int(c) for c in rng.integers(150, 256, 3))
    pen.rectangle((0, 0, *picture.size), fill=tuple(int(c) for c in rng.integers(0, 40, 3)))
    turned = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    stroke = int(FINER * rng.uniform(2, 3.4))
    for line in LETTERS[kind]:
        points = [tuple(place + FINER * turned @ (np.array(p) * (width, height))) for p in line]
        pen.line(points, fill=colour, width=stroke, joint="curve")
    return picture.resize((24, 24), Image.Resampling.BOX), "tif" if rng.random() < 0.3 else "png"


def draw_rod(kind, rng):
    """A soft rod in one of six directions, 30 degrees apart and up to 8 more or less, over dim dust."""
    y, x = np.mgrid[:32, :40]
    turn = math.radians(30 * int(kind[3:]) + rng.uniform(-8, 8))
    middle = np.array((20, 16)) + rng.uniform(-4, 4, 2)
    along = (x - middle[0]) * math.cos(turn) + (y - middle[1]) * math.sin(turn)
    across = (y - middle[1]) * math.cos(turn) - (x - middle[0]) * math.sin(turn)
    rod = rng.uniform(150, 230) * np.exp(-((across / rng.uniform(1.5, 2.3)) ** 2) - (along / rng.uniform(7.5, 10)) ** 6)
    for _ in range(int(rng.integers(2, 6))):
        place, size = rng.uniform((0, 0), (40, 32)), rng.uniform(1, 2)
        rod += 60 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * size**2))
    grey = np.clip(rod + rng.normal(8, 4, rod.shape), 0, 255).astype(np.uint8)
    return Image.fromarray(grey), ("png", "bmp", "jpg")[int(rng.integers(3))]


SETS = {
    "shapes": (draw_shape, ("cross", "disc", "square", "triangle"), 1200),
    "letters": (draw_letter, tuple(LETTERS), 300),
    "rods": (draw_rod, tuple(f"dir{i}" for i in range(6)), 3000),
}


def draw_folder(name, folder, seed=1, number=None):
    """Write a set (or the first `number` pictures of it) as class folders below `folder`."""
    draw, classes, usual = SETS[name]
    rng = np.random.default_rng([seed, len(classes)])
    for i in range(number or usual):
        kind = classes[i % len(classes)]
        picture, suffix = draw(kind, rng)
        path = Path(folder) / kind / f"{i:04d}.{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.save(path, **({"quality": 95} if suffix == "jpg" else {}))


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 4 or sys.argv[1] not in SETS:
        sys.exit(f"usage: python practice_images.py {'|'.join(SETS)} FOLDER [SEED]")
    draw_folder(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) == 4 else 1)

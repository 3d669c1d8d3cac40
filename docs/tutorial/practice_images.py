"""Draw a folder of made-up images to practise on: `python practice_images.py shapes my-shapes`.

Three sets, each a folder with one folder of pictures per class, the same for the same seed:

- `shapes`:  1200 pictures of 32 x 32 pixels, grey PNG: discs, squares, triangles and crosses, moved, turned and resized at random;
- `letters`: 300 pictures of 24 x 24 pixels, colour PNG and TIFF: five letters, tilted and moved, in strokes of several widths and colours;
- `photos`:  336 pictures of 20 to 4000 pixels, 298 discs, 32 squares and 6 triangles, as folders of photos are: JPEG, PNG and TIFF, grey
             and colour, some turned by their EXIF data, transparent or of 16 bits, one copied twice, one damaged.

Needs numpy and Pillow.
"""

import math
import shutil
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


def draw_photos(folder, rng, counts=(("disc", 298), ("square", 32), ("triangle", 6)), largest=4000):
    """Shapes before a grey background with noise, in files of every kind."""
    for kind, number in counts:
        (Path(folder) / kind).mkdir(parents=True, exist_ok=True)
        for i in range(number):
            width, height = (
                int(x) for x in math.exp(rng.uniform(math.log(20), math.log(0.75 * largest))) * rng.uniform(1, 4 / 3, 2)
            )
            if i == 1:
                width, height = largest, 3 * largest // 4
            side = min(width, height)
            shape = draw_shape(kind, rng)[0].resize((side, side), Image.Resampling.BICUBIC)
            grey = np.clip(rng.normal(rng.uniform(10, 40), 5, (height, width)), 0, 255)
            top, left = (height - side) // 2, (width - side) // 2
            part = grey[top : top + side, left : left + side]
            part[:] = np.maximum(part, shape)
            save_photo(grey, Path(folder) / kind / f"{i:04d}", i)
        shutil.copy(next(Path(folder, kind).glob("0000.*")), Path(folder, kind, "copy-of-the-first.jpg"))
    (Path(folder) / "disc" / "damaged.jpg").write_bytes(b"\xff\xd8\xff\xe0 no picture")


def save_photo(grey, path, i):
    """Save a picture (height, width), 0 to 255, as a file of the kind whose turn it is."""
    picture = Image.fromarray(grey.astype(np.uint8))
    if i % 16 == 2:
        Image.fromarray((grey * 257).astype(np.uint16)).save(path.with_suffix(".tif"))
    elif i % 16 == 3:
        clear = Image.fromarray(np.where(grey > 60, 255, 0).astype(np.uint8))
        Image.merge("RGBA", (picture, picture, picture, clear)).save(path.with_suffix(".png"), compress_level=1)
    elif i % 16 == 4:  # on its side, and EXIF data that say so
        turned = Image.Exif()
        turned[0x0112] = 6
        picture.transpose(Image.Transpose.ROTATE_90).save(path.with_suffix(".jpg"), quality=90, exif=turned)
    else:
        picture.convert("RGB").save(path.with_suffix(".jpg"), quality=90)


SETS = {
    "shapes": (draw_shape, ("cross", "disc", "square", "triangle"), 1200),
    "letters": (draw_letter, tuple(LETTERS), 300),
}


def draw_folder(name, folder, seed=1, number=None):
    """Write a set (or the first `number` pictures of it) as class folders below `folder`."""
    if name == "photos":
        draw_photos(folder, np.random.default_rng(seed))
        return
    draw, classes, usual = SETS[name]
    rng = np.random.default_rng([seed, len(classes)])
    for i in range(number or usual):
        kind = classes[i % len(classes)]
        picture, suffix = draw(kind, rng)
        path = Path(folder) / kind / f"{i:04d}.{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.save(path)


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 4 or sys.argv[1] not in {*SETS, "photos"}:
        sys.exit(f"usage: python practice_images.py {'|'.join(SETS)}|photos FOLDER [SEED]")
    draw_folder(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) == 4 else 1)

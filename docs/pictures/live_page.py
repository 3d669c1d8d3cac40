"""Draws docs/pictures/live-page.png: the live page beside a run whose dark counts rise for ten seconds. SIMULATED.

python docs/pictures/live_page.py        (extras `ui` and `browser`, Pillow, chromium and chromedriver; two idle cores)
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "browsers"))
from browser import browser, look, picture

DEVICE = "sim:dmd-spad?scene=fashion200&seed=1&pace=real&changes=dark:at_s=25:factor=60:for_s=8"
WIDTH, HEIGHT, SECONDS, LOADED_S = 1400, 1790, 46, 4


def main() -> None:
    """Write the picture beside this file."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["pans", "run", "fashion-adaptive", "--device", DEVICE, "--serve", "127.0.0.1:0"]
        words += ["--seconds", str(SECONDS + 30), "--deadline-us", "16667", "--out", f"{folder}/run"]
        run = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        try:
            url = next(found[0] for line in run.stderr or () if (found := re.search(r"http://\S+", line)))
            time.sleep(SECONDS)  # a browser that is open all the time would take one of two cores from the run
            with browser(Path(folder)) as driver:
                look(driver, WIDTH)
                driver.get(url)
                time.sleep(LOADED_S)
                picture(driver, Path(folder, "page.png"))
        finally:
            run.terminate()
            run.communicate()
        page = Image.open(io.BytesIO(Path(folder, "page.png").read_bytes())).convert("RGB")
    page = page.crop((0, 0, page.width, min(page.height, HEIGHT))).quantize(
        96, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
    )
    page.save(Path(__file__).with_name("live-page.png"), optimize=True)


if __name__ == "__main__":
    main()

"""A headless chromium for tests of pages: widths, light and dark, console errors, axe-core, and the Tab key.

axe-core is the one that axe-core-python (extra `browser`) brings; `AXE_CORE` names another axe.min.js.
Without both, accessibility is not checked, with a warning.
"""

import base64
import os
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync")
FLAGS += ("--disable-background-networking", "--disable-component-update")
# all elements of a page that match, those in shadow roots too
DEEP = """const deep = (root, what) => [...root.querySelectorAll("*")].flatMap(
  one => [...(one.matches(what) ? [one] : []), ...(one.shadowRoot ? deep(one.shadowRoot, what) : [])]);
"""


@contextmanager
def browser(folder: Path) -> Iterator[Any]:
    """Yield a driver of a fresh profile in `folder`; skips the test without selenium, chromium and chromedriver."""
    pytest.importorskip("selenium", reason="needs selenium")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    program = next(filter(None, map(shutil.which, CHROMIUM)), None)
    driver_program = shutil.which("chromedriver")
    if program is None or driver_program is None:
        pytest.skip("needs chromium and chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in (*FLAGS, f"--user-data-dir={folder / 'profile'}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(driver_program))
    driver.set_page_load_timeout(60)  # a page that takes longer hangs
    try:
        yield driver
    finally:
        driver.quit()


def look(driver: Any, width: int, *, dark: bool = False, height: int = 900) -> None:
    """Let the page be `width` pixels wide, in light or dark colours."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})


def picture(driver: Any, path: Path) -> None:
    """Write a PNG of the whole page."""
    shot = driver.execute_cdp_cmd("Page.captureScreenshot", {"captureBeyondViewport": True, "format": "png"})
    path.write_bytes(base64.b64decode(shot["data"]))


def clipped(driver: Any) -> list[str]:
    """Return the parts that are wider than the window, or whose text is cut, outside of regions that scroll."""
    found: list[str] = driver.execute_script(
        DEEP
        + """
        const bad = [], wide = document.documentElement.clientWidth;
        for (const one of deep(document.body, "*")) {
          if (one.closest(".scroll") && !one.matches(".scroll")) continue;
          const box = one.getBoundingClientRect();
          if (box.width && (box.right > wide + 1 || box.left < -1))
            bad.push(one.tagName + "." + one.getAttribute("class") + ": " + one.textContent.slice(0, 60));
        }
        for (const text of document.querySelectorAll("svg text")) {
          const svg = text.ownerSVGElement.getBoundingClientRect(), box = text.getBoundingClientRect();
          const inside = box.left > svg.left - 1 && box.right < svg.right + 1 && box.top > svg.top - 1 && box.bottom < svg.bottom + 1;
          if (svg.width && box.width && !inside)
            bad.push("svg text: " + text.textContent + " in " + text.ownerSVGElement.getAttribute("aria-label"));
        }
        return bad;
        """
    )
    return found


def console(driver: Any) -> list[str]:
    """Return the warnings and errors of the page's console since the last call."""
    return [entry["message"] for entry in driver.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]


def axe_source() -> str | None:
    """Return axe-core's script, None where it is not there."""
    if named := os.environ.get("AXE_CORE"):
        return Path(named).read_text(encoding="utf-8")
    if find_spec("axe_core_python") is None:
        return None
    return files("axe_core_python").joinpath("axe.min.js").read_text(encoding="utf-8")


def serious(driver: Any) -> list[str]:
    """Return axe-core's serious and critical findings; none, with a warning, where there is no axe-core."""
    source = axe_source()
    if source is None:
        warnings.warn("neither axe-core-python nor AXE_CORE: accessibility is not checked", stacklevel=2)
        return []
    driver.execute_cdp_cmd("Page.setBypassCSP", {"enabled": True})
    driver.execute_script(source)
    result = driver.execute_async_script(
        "const done = arguments[0], failed = e => done({violations: [{impact: 'critical', id: String(e), nodes: []}]});"
        "axe.run(document).then(done, failed);"
    )
    return [
        f"{one['id']}: {node['html'][:120]} {node.get('failureSummary', '')[:300]}"
        for one in result["violations"]
        if one["impact"] in ("serious", "critical")
        for node in one["nodes"] or [{"html": ""}]
    ]


def unreachable(driver: Any) -> list[str]:
    """Return what can be used but is not reached with the Tab key, or does not show that it has the focus."""
    count: int = driver.execute_script(
        DEEP
        + """
        document.activeElement.blur();
        const usable = "a[href], button, summary, input, select, textarea, [tabindex='0']";
        const seen = deep(document, usable).filter(one => one.checkVisibility() && !one.disabled);
        window.waiting = new Set(seen);
        window.unseen = [];
        // events do not leave a shadow root in which the focus moves: it is looked for after each key
        window.noted = () => {
          let one = document.activeElement;
          while (one?.shadowRoot?.activeElement) one = one.shadowRoot.activeElement;
          if (!one) return;
          window.waiting.delete(one);
          const style = getComputedStyle(one), unseen = style.outlineStyle === "none" && style.boxShadow === "none";
          if (unseen && one !== document.body) window.unseen.push("no focus is seen: " + one.outerHTML.slice(0, 120));
        };
        return window.waiting.size;
        """
    )
    for _ in range(count + 1):
        for kind in ("rawKeyDown", "keyUp"):
            key = {"type": kind, "key": "Tab", "code": "Tab", "windowsVirtualKeyCode": 9}
            driver.execute_cdp_cmd("Input.dispatchKeyEvent", key)
        driver.execute_script("window.noted()")
    found: list[str] = driver.execute_script(
        "return [...window.waiting].map(one => 'not reached: ' + one.outerHTML.slice(0, 120)).concat(window.unseen);"
    )
    return found

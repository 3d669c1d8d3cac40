"""The lean runtime: from a trained bundle to timed decisions on single-photon clicks."""

from pathlib import Path

__version__ = "0.1.0"
SHIPPED = Path(__file__).parent / "shipped"  # bundles, settings and rules that come with the package

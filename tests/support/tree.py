"""Where the checkout is: tests that read documents or shipped files start here."""

from pathlib import Path

ROOT = Path(__file__).parents[2]

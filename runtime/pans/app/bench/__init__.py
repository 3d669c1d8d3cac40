"""Speed beside error. Each benchmark is an entry point (`pans.benches`): `BenchOptions` in, rows out. Start at rows.py."""

from .rows import BenchOptions, Row

__all__ = ["BenchOptions", "Row"]

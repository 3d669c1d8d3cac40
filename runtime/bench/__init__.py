"""Speed beside error, on this machine: decisions, links, the loop, ingest.

Owns how things are measured; each benchmark is found by entry point (`pans.benches`) and takes a `BenchOptions` to rows. It never judges
a figure: tests do.
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .rows import BenchOptions, Row

__all__ = ["BenchOptions", "Row"]

__getattr__ = lazy_names(
    __name__,
    {
        "BenchOptions": ".rows",
        "Row": ".rows",
    },
)

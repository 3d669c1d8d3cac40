"""The paper's tables and figures beside ours, and the frontier: what `pans reproduce NAME` measures, prints and draws.

A page goes from a recipe (recipes.toml) to rows (flat, one figure per key), from rows to tables (pages.toml) and pictures (plots.py).
Start reading at `page.py`, then `active.py`. To add a page, write a function `Asked -> Made` and an entry in pages.toml.
"""

"""The deterministic core for objects that stand still: plan, windows, one frame in, decisions out."""

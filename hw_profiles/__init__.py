"""Hardware profiles as validated TOML, each figure with its source (`pans.runtime.instrument.profile` reads them)."""

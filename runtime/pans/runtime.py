"""What `pans.runtime` was in earlier releases is `pans` itself now; importing it says so."""

raise ImportError(
    "pans.runtime is pans itself now, for example pans.runtime.live is pans.live (CHANGELOG.md lists all names)"
)

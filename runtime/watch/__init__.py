"""What watches a run alongside its loop: state file, metrics, systemd, the computer around it, and the end of a process that hangs.

A `LiveRun` and its recorder come in; a flat picture of the run goes out, as a file and over HTTP. All of it runs in threads of its own,
which the loop never waits for. Start with `watchers.py`.
"""

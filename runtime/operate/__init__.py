"""Operating pans over weeks and over many files: options from a file, systemd units, folders of runs, batches of commands.

Owns what is around a command, never what a command does: the loop and its recordings are live's and record's, who watches a run is watch's.
"""

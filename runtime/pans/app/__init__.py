"""The `pans` command: it finds a command, runs it, and turns errors into exit codes.

In: the words of the command line. Out: an answer on stdout, files, an exit code.
Packages that add commands import command, main, run, bench and doctor.
Start at main.py, then command.py (what a command is) and run/one_run.py (`pans run` from the options to the report).
Each command is a module of its own in commands/, doctor/, run/ or bench/, and is imported when it is asked for.
"""

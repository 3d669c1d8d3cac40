"""The commands of the lean runtime, found by entry point (`pans.commands`): arguments in, files, one answer and an exit code out.

Start reading at one_run.py, which is `pans run` and `pans demo` from the options to the report.
"""

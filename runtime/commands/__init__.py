"""The commands of the lean runtime: arguments in, exit codes out.

Owns how options are spelled and what is printed; nothing is computed here. Each command is found by entry point (`pans.commands`), so that
this package has no public names: a program calls `pans` or the packages below.
"""

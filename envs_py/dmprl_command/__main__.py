"""Runs the command with ``python -m dmprl_command``."""

from dmprl_command import main

main()

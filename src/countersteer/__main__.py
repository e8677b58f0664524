"""`python -m countersteer` is the command."""

from countersteer.cli import entry

entry()

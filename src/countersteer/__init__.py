"""Countersteer makes a radio-controlled car drift through a course by itself.

Start reading at `countersteer.simulator`.
"""

__version__ = "0.1.0"

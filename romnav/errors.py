"""What a user's mistake raises."""

from __future__ import annotations


class RomnavError(Exception):
    """A mistake the user can fix: one line that names the file, the key and the fix.

    The command line prints the message without a traceback and exits with status 1.
    """


class NothingRecorded(RomnavError):
    """A report that there is nothing yet to make of."""

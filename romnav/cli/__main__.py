"""``python -m romnav.cli`` is ``romnav``."""

from romnav.cli import main

main()

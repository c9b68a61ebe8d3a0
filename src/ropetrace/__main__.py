"""``python -m ropetrace``."""

from ropetrace.cli import main

main()

"""``python -m rbfmuscle``."""

from rbfmuscle.cli import main

main()

"""`python -m fisheyerec.cli`."""

from . import main

main()

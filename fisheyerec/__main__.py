"""`python -m fisheyerec`."""

from .cli import main

main()

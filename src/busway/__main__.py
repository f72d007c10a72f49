"""``python -m busway``: the command line."""

from .cli import main

main()

"""`python -m dengine`: the command line."""

from .cli import main

main(prog_name="dengine")

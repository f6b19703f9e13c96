"""`python -m ssmppl`: the command line."""

from ssmppl.cli import main

main(prog_name="ssmppl")

"""`python -m dual_ur10`."""

from dual_ur10.cli import main

main()

"""`python -m dual_ur10`."""

from dual_ur10.cli.main import main

main()

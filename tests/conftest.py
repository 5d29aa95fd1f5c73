"""Same conditions wherever the tests run."""

import os

# Workers of pytest-xdist get the width of the terminal; rich takes it when a console is made, at import.
os.environ.pop("COLUMNS", None)

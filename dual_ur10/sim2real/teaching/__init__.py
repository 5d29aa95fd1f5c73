"""Teaching: arms guided by hand, points taken, and the file that keeps them."""

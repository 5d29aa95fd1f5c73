"""Records of runs: written so that no kill loses a row, read so that no file does harm."""

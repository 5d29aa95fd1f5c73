"""Tools of an arm: their figures, commands and MJCF. What a program grips with them is not known here."""

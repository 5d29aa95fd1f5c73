"""Synchronised carry: both arms carry one bar along a path. No policy that carries it is here."""

"""Operators: persons who lead both arms with input devices, as policies."""

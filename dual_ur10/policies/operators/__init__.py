"""Operators: persons who lead both arms with input devices, as policies, and their session in a live page."""

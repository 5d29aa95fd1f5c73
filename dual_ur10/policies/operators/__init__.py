"""Operators: persons who lead both arms with input devices, as policies, and their session in a live page.

A device never commands arms: its readings reach them only as the action of a policy.
"""

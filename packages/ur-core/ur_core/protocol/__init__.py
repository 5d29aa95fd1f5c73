"""Wire formats of UR controllers: RTDE, the primary interface, the dashboard, and their mode codes.

It converts values to bytes and back, without sockets, for clients and for emulated
controllers.
"""

"""Wire formats of UR controllers: RTDE, the primary interface, the dashboard, and their mode codes.

Bytes in, bytes out: no sockets. The clients in `links` and the controllers in `emulator` share it.
"""

"""Wire formats of UR controllers: RTDE, the primary interface, the dashboard, and their mode codes.

It converts values to bytes and back, without sockets. The clients in `links` and the controllers in
`ur_emulator` use it.
"""

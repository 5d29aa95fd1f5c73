"""Teaching: arms guided by hand, points taken, and the file that keeps them.

The arms move by the hand that guides them: nothing here sends a target.
"""

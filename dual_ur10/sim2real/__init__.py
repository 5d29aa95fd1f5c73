"""From an action to the motion of two arms: cell, servoj adapter, safety gate."""

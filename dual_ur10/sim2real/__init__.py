"""Everything between an action and two arms: control, cell file, links and processes, and records.

An environment takes `control` and `cell` of it, and loads the rest by name where there are controllers or records.
Nothing here knows of emulated controllers: what moves real arms cannot tell them apart.
"""

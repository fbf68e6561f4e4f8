"""The engine that runs the blocks themselves, event by event, in plain NumPy.

`plan` writes for each pattern of present sources one straight function that calls the blocks in order; `run`
holds the registers and calls it tick by tick; `engine` is its face. A `Run` is also how live events are fed.
"""

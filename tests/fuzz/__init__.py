"""Damaged files: each ends in what it holds or in our error, soon, and within a few times its own memory.

`python -m tests.fuzz --count N --seed S --json` damages a small whole file of each kind that is read, one
file an input, and prints how many ended otherwise and which. An input follows from the seed and its number
alone, so that `--first K --count 1` repeats it.
"""

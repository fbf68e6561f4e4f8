"""Random graphs against a second reading of docs/semantics.md.

`specs` draws a graph as plain data: sources with their events, and operations on what came before. `build`
declares it with flowgraph. `meaning` reads the same data by the words of the document, stream by stream, and
knows nothing of ticks as engines have them: a stream is a list of (time, value), and an operation a function
from lists to a list. `check` holds the two against each other, and one engine against another.

    python -m tests.oracle --count 1000 --seed 0 --json
"""

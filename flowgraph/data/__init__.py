"""Data: what goes into a graph and what comes out.

A recording of one signal is a `Series`: times in whole nanoseconds, and the fields of the signal as arrays
with a row a time (`series`); a `Flight` holds several of them with their truth (`flight`). Before a run,
the inputs are held against what the graph declares, source by source, and nothing is mended in silence
(`inputs`). Then they are laid on one line of time, where all events of one time are one tick (`tape`). This
is all that an engine sees of the world. It answers with a `Result`, which is series again, with the last
state and counts (`result`), and a result can be handed on to other tools (`export`).

Graphs and recordings are found by name among all packages that are installed, and a graph that is made
ready for one recording, with its score, is a `Case` (`registry`). Long runs say how far they are
(`progress`).
"""

"""What runs a graph: engines behind one contract, and the little that all of them share.

A run begins as a question: a graph, its inputs, and `options`, one frozen object that says what is asked.
`registry` knows which engines are installed; `contract` is what they promise. An engine of blocks (`python`)
is handed the graph. For the others the graph is lowered, or a pipeline was read from a file: both are a
`subject`, which gives register cells to start from and a tape of checked events. `playback` lets the engine
prepare the pipeline and play the tape, and gives the outputs their types back; where a graph has blocks for
the host, `parts` does so between two runs of blocks. `many` is the same for many runs, together where the
engine takes many. `simulate` is the door to all of it.

The engines themselves stand apart from one another: `reference` plays the instructions in NumPy and is the
definition of the others, `xla` in one compiled scan, `c` as generated C. `forks` watches, from the first
import on, for processes in which JAX could only wait.
"""

from flowgraph.engines import forks as forks

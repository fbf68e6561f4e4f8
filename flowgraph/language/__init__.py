"""The language: what a graph is, and how it is declared.

A graph says how measurements become estimates. It is made of blocks, which are plain functions with typed
ports (`block`), and of wires between them. What flows on a wire is a stream: values of one signal type,
each at a tick of the stream's clock (`clock`). Clocks are what the language is about: an IMU at 200 Hz and
a camera that comes when it can are never present together by accident, and a block that asks for both is
refused until a join says how they meet.

A graph is declared by running a function once. In it, `Stream` and `Held` stand for values that will flow
and for registers that remember (`stream`). Calling a block on them (`wiring`) checks types and clocks there
and then, records the step (`recording`), and adds a node to the graph under construction (`builder`). When
the function returns, what can only be seen at the end is checked (`declare`), and the graph is frozen:
sources, calls and registers in firing order, data that never changes again (`graph`).

The rest is vocabulary, written with the same blocks that a user writes. `joins` and `pairs` bring streams
of different clocks together; `operations`, `timed` and `windows` change one stream, by its values, by the
time between them, and several values at once; `checks` and `queues` are what these share.

A frozen graph runs nothing. To be drawn, simulated or lowered is done to it by later rooms.
"""

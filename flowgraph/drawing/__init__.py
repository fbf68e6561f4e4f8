"""Drawing: a graph to be believed, and a result to be looked at.

The first use of a declared graph is to see it. The same words and arrows make a text for a terminal
(`text`) and a block diagram that nests as the graphs do (`draw`): sources and their rates, the order of the
blocks, what is remembered, and which wires are read one tick later.

The rest is for results: every field over time, with the band of three standard deviations that the filter
claims (`plot`), attitudes as angles and as errors against the truth (`attitude`), and the flight itself, in
space beside its truth and over time (`trajectory`).

What is drawn for a browser is a page of its own: a graph that unfolds (`page`, from its description in
`model`), and a run to scrub through (`run_page`), with what a `recorder` kept of the wires and what `scopes`
makes of the outputs; or a run as it goes on (`live`). Their scripts are written in `front`, in TypeScript.

Nothing here changes what it draws, and the libraries that draw are imported when they are needed.
"""

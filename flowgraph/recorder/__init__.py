"""The recorder: writing down what a block's step does, without running it on numbers.

A step is a plain Python function of arrays. To draw conclusions from it (what type does it give, can a chip
do it, what does it cost) its operations must be known one by one. So it is called once with arrays that
have a shape and a kind of number but no values (`symbolic`). Each operation on one of them appends an
instruction to a list (`trace`), and what the step computes from constants alone is computed on the spot.
Which operations there are, and what shape each gives, is said in one table (`ops`), which every engine
reads as well: an operation exists everywhere or nowhere. What has no place in such a list (a branch on a
value, a write in place, a size that depends on data) is refused with the line that asked for it
(`refusals`).

A step reaches its operations through `xp`, the namespace it is handed: `symbolic_namespace` while it is
recorded, `namespaces` when it runs in NumPy. Random numbers are a function of their name, the time and the
seed, so that they can be recorded like anything else and come out the same in every engine (`random`).

Because a step says nothing but operations of that table, its derivative follows from it: each operation has
a rule (`dual_rules`) by which an array that carries its change along (`dual`) passes it on. `derivatives`
hands a function such arrays, over the namespace of numbers or over the symbolic one, and a Jacobian is
recorded like the rest.

Nothing here knows what a block or a graph is.
"""

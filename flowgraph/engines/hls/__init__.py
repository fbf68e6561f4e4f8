"""Fixed point as C++ for the compilers of high-level synthesis, and a run of it on this computer.

`arrays` says in which array each value lies, `source` writes the tick in the words of such compilers, `bench`
the test bench beside it, and `play` compiles both and runs them. The instructions are those of fixed-point C.
"""

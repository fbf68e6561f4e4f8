"""Many runs of one pipeline side by side: each number of a run is a lane of a vector of the processor.

The code is that of a single run with other types: a real is a vector of reals, a truth a mask, and what a run
would choose by a branch is computed on both sides and picked by the mask. Time, and what follows from it
alone, is the same for all lanes and stays a scalar. So all runs of a call must have their events at the same
times; and a pipeline that resamples, searches or sorts has no lanes, and its runs go singly.
"""

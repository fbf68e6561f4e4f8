"""The bootstrap filter of `particles` (N. Chopin), in an interpreter that has it, timed by itself.

A program of its own, which needs nothing of flowgraph: the first line that it reads is the model, as JSON;
at each further one it filters once, and writes the processor time and the estimate after the last step.
"""

from __future__ import annotations

import json
import sys
from time import process_time

import numpy as np
import particles
from particles import kalman
from particles import state_space_models as models


def main() -> None:
    given = json.loads(sys.stdin.readline())
    matrices = {name: np.array(given[name]) for name in ("F", "G", "covX", "covY", "cov0")}
    model = kalman.MVLinearGauss(**matrices)
    seen = list(np.array(given["seen"]))
    print(json.dumps({"numpy": np.__version__}), flush=True)
    for _ in sys.stdin:
        start = process_time()
        steps = models.Bootstrap(ssm=model, data=seen)
        run = particles.SMC(fk=steps, N=given["particles"], resampling="systematic", ESSrmin=0.5)
        run.run()
        mean = np.asarray(run.W @ run.X)
        took = process_time() - start
        print(json.dumps({"seconds": took, "mean": mean.tolist()}), flush=True)


if __name__ == "__main__":
    main()

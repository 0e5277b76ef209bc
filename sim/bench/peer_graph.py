"""GTSAM on one pose graph: prints one line of JSON.

    python peer_graph.py FILE.g2o REPEATS

Levenberg-Marquardt from the file's values, the fastest of REPEATS runs counts; the first pose is held by a prior whose
standard deviation is a micrometre. `chi2` is twice GTSAM's error without that prior. Marginals: of all poses if that is
quick, else of the first few, extrapolated. Times are of the processor. Needs gtsam.
"""
import json
import os
import sys
import time

os.environ["OMP_NUM_THREADS"] = "1"

import gtsam  # noqa: E402

BUDGET_S = 5.0


def main(path, repeats):
    with open(path) as file:
        spatial = any(line.startswith("EDGE_SE3") for line in file)
    graph, initial = gtsam.readG2o(path, spatial)
    first = min(initial.keys())
    size = 6 if spatial else 3
    at = initial.atPose3(first) if spatial else initial.atPose2(first)
    prior = gtsam.PriorFactorPose3 if spatial else gtsam.PriorFactorPose2
    graph_held = gtsam.NonlinearFactorGraph(graph)
    graph_held.add(prior(first, at, gtsam.noiseModel.Isotropic.Sigma(size, 1e-6)))
    best = None
    for _ in range(repeats):
        start = time.process_time()
        result = gtsam.LevenbergMarquardtOptimizer(graph_held, initial).optimize()
        spent = time.process_time() - start
        best = spent if best is None else min(best, spent)
        if spent > BUDGET_S:
            break
    start = time.process_time()
    marginals = gtsam.Marginals(graph_held, result)
    made = time.process_time() - start
    keys = list(initial.keys())
    done, start = 0, time.process_time()
    for key in keys:
        if done >= 5 and time.process_time() - start > BUDGET_S:
            break
        marginals.marginalCovariance(key)
        done += 1
    each = (time.process_time() - start) / done
    row = {
        "chi2": 2 * graph.error(result),
        "solve_s": best,
        "marginals_s": made + each * len(keys),
    }
    print(json.dumps(row))


main(sys.argv[1], int(sys.argv[2]))

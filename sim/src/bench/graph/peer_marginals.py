"""GTSAM's covariances of one pose graph at given values: prints one line of JSON.

    python peer_marginals.py FILE.g2o POSES

The smallest pose is taken as known, at its value: a measurement of it is a prior on the other end. Prints the covariance
of at most POSES poses, evenly, as [id, 36 numbers by rows] in GTSAM's order (rotation, translation). Needs gtsam.
"""
import json
import os
import sys

os.environ["OMP_NUM_THREADS"] = "1"

import gtsam  # noqa: E402


def main(path, poses):
    graph, values = gtsam.readG2o(path, True)
    keys = sorted(values.keys())
    held = gtsam.NonlinearFactorGraph()
    for k in range(graph.size()):
        factor = graph.at(k)
        i, j = factor.keys()
        t, noise = factor.measured(), factor.noiseModel()
        if keys[0] not in (i, j):
            held.add(factor)
        elif i == keys[0]:
            held.add(gtsam.PriorFactorPose3(j, values.atPose3(i).compose(t), noise))
        else:
            sys.exit("a measurement to the first pose; turn it around")
    values.erase(keys[0])
    marginals = gtsam.Marginals(held, values)
    rest = keys[1:]
    chosen = [rest[k * len(rest) // min(poses, len(rest))] for k in range(min(poses, len(rest)))]
    rows = [[key, marginals.marginalCovariance(key).ravel().tolist()] for key in chosen]
    print(json.dumps({"covariances": rows}))


main(sys.argv[1], int(sys.argv[2]))

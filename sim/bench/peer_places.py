"""KISS-Matcher on pairs of scans. Arguments: voxel, m. Standard input: a JSON list of pairs, each two scans {path, stride,
turn: 3x3}; standard output: a JSON list of {pose: 4x4 of the first in the second, valid, cpu_s, wall_s}."""
import json
import sys
import time

import kiss_matcher
import numpy as np


def load(scan):
    points = np.fromfile(scan["path"], "<f4").reshape(-1, scan["stride"])[:, :3].astype(np.float64)
    return points @ np.array(scan["turn"]).T


def main():
    voxel = float(sys.argv[1])
    answers = []
    for first, second in json.load(sys.stdin):
        source, target = load(first), load(second)
        matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel))
        cpu, wall = time.process_time(), time.perf_counter()
        found = matcher.estimate(source, target)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = found.rotation, np.ravel(found.translation)
        answers.append({"pose": pose.tolist(), "valid": bool(found.valid), "cpu_s": cpu, "wall_s": wall})
    print(json.dumps(answers))


main()

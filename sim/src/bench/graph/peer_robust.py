"""Robust peers on one pose graph of several robots: prints one line of JSON per peer.

    python peer_robust.py FILE.g2o

Ids are GTSAM's symbols: the top byte is the robot. Measurements between a robot's consecutive poses, and its own others,
are taken as known to be true, for both peers.

PCM + LM (Mangelson et al. 2018): of the closures between each pair of robots the largest set that agrees pairwise
(chi-squared at 99 % under the odometry's covariance; maximum clique, greedily from every vertex), laid out along the pairs
with the largest sets, then GTSAM's Levenberg-Marquardt.
GNC (Yang et al. 2020): GTSAM's GncLMOptimizer from the same start, with the odometry as known inliers.

Times are of the processor. Needs gtsam and numpy.
"""
import json
import os
import sys
import time
from collections import defaultdict

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import gtsam  # noqa: E402
import numpy as np  # noqa: E402

GATE = 16.811893829770927
PERM = [3, 4, 5, 0, 1, 2]


def read(path):
    poses, edges = set(), []
    with open(path) as file:
        for line in file:
            word = line.split()
            if word and word[0] == "VERTEX_SE3:QUAT":
                poses.add(int(word[1]))
            if word and word[0] == "EDGE_SE3:QUAT":
                x, y, z, qx, qy, qz, qw = map(float, word[3:10])
                info = np.zeros((6, 6))
                info[np.triu_indices(6)] = list(map(float, word[10:31]))
                info = info + np.triu(info, 1).T
                t = gtsam.Pose3(gtsam.Rot3.Quaternion(qw, qx, qy, qz), np.array([x, y, z]))
                edges.append((int(word[1]), int(word[2]), t, info[np.ix_(PERM, PERM)]))
                poses.update(edges[-1][:2])
    return sorted(poses), edges


def robot(key):
    return key >> 56


def trees(poses, edges):
    """Each robot's poses along its own measurements, consecutive ones first; the covariance in the robot's first
    pose's coordinates grows by each step's."""
    own = defaultdict(list)
    follows = dict(zip(poses, poses[1:]))
    for i, j, t, info in edges:
        if robot(i) == robot(j):
            step = follows.get(min(i, j)) == max(i, j)
            own[i].append((not step, j, t))
            own[j].append((not step, i, t.inverse()))
    out, sigma = {}, {}
    for key in poses:
        if key in out or any(robot(k) == robot(key) for k in out):
            continue
        out[key], sigma[key] = gtsam.Pose3(), np.zeros((6, 6))
        reached = [key]
        while reached:
            at = reached.pop()
            for _, other, t in sorted(own[at], key=lambda e: e[:2]):
                if other not in out:
                    out[other] = out[at].compose(t)
                    reached.append(other)
    covariance = {}
    for i, j, t, info in edges:
        if robot(i) == robot(j):
            covariance.setdefault((i, j), np.linalg.inv(info))
    for first in [k for k in sigma]:
        order, seen = [first], {first}
        while order:
            at = order.pop()
            for _, other, t in sorted(own[at], key=lambda e: e[:2]):
                if other in seen or other not in out:
                    continue
                seen.add(other)
                order.append(other)
                if (at, other) in covariance:
                    end, step = other, covariance[(at, other)]
                else:
                    end, step = at, covariance[(other, at)]
                ad = out[end].AdjointMap()
                sigma[other] = sigma[at] + ad @ step @ ad.T
    return out, sigma


def agreeing(closures, place, sigma):
    n = len(closures)
    agree = np.zeros((n, n), bool)
    for a in range(n):
        ia, ja, ta, ca = closures[a]
        for b in range(a):
            ib, jb, tb, cb = closures[b]
            there, back = place[ia].between(place[ib]), place[jb].between(place[ja])
            told = there.compose(tb).compose(back)
            r = gtsam.Pose3.Logmap(ta.between(told))
            # Every error brought to the end of the told pose.
            m_back = back.inverse().AdjointMap()
            m_there = tb.compose(back).inverse().AdjointMap()
            ad_i, ad_j = place[ib].inverse().AdjointMap(), place[ja].inverse().AdjointMap()
            of_i = ad_i @ (sigma[ib] - sigma[ia]) @ ad_i.T
            of_j = ad_j @ (sigma[ja] - sigma[jb]) @ ad_j.T
            if ib < ia:
                of_i = -of_i
            if ja < jb:
                of_j = -of_j
            cov = ca + m_back @ cb @ m_back.T + m_there @ of_i @ m_there.T + of_j
            agree[a, b] = agree[b, a] = r @ np.linalg.solve(cov, r) <= GATE
    return agree


def clique(agree):
    best = []
    for v in range(len(agree)):
        chosen, left = [v], agree[v].copy()
        while left.any():
            scores = np.where(left, (agree & left).sum(1), -1)
            u = int(scores.argmax())
            chosen.append(u)
            left &= agree[u]
        if len(chosen) > len(best):
            best = chosen
    return sorted(best)


def between(i, j, t, info):
    return gtsam.BetweenFactorPose3(i, j, t, gtsam.noiseModel.Gaussian.Information(info))


def problem(edges, kept, first):
    graph = gtsam.NonlinearFactorGraph()
    for k in kept:
        graph.add(between(*edges[k]))
    graph.add(gtsam.PriorFactorPose3(first, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    return graph


def report(name, used, values, poses, spent):
    places = [[k, *values.atPose3(k).translation().tolist()] for k in poses]
    print(json.dumps({"name": name, "cpu_s": spent, "used": used, "places": places}))


def main(path):
    poses, edges = read(path)
    start = time.process_time()
    place, sigma = trees(poses, edges)
    pairs = defaultdict(list)
    for k, (i, j, t, info) in enumerate(edges):
        if robot(i) != robot(j):
            pairs[min(robot(i), robot(j)), max(robot(i), robot(j))].append(k)
    chosen = {}
    for pair, list_ in pairs.items():
        turned = []
        for k in list_:
            i, j, t, info = edges[k]
            cov = np.linalg.inv(info)
            if robot(i) != pair[0]:
                ad = t.AdjointMap()
                i, j, t, cov = j, i, t.inverse(), ad @ cov @ ad.T
            turned.append((i, j, t, cov))
        members = clique(agreeing(turned, place, sigma))
        chosen[pair] = [(list_[m], turned[m]) for m in members]
    robots = sorted({robot(k) for k in poses})
    world = {robots[0]: gtsam.Pose3()}
    while len(world) < len(robots):
        best = None
        for pair, members in chosen.items():
            if (pair[0] in world) != (pair[1] in world) and (best is None or len(members) > len(chosen[best])):
                best = pair
        if best is None:
            break
        middle = chosen[best][len(chosen[best]) // 2][1]
        t_a_b = place[middle[0]].compose(middle[2]).compose(place[middle[1]].inverse())
        if best[0] in world:
            world[best[1]] = world[best[0]].compose(t_a_b)
        else:
            world[best[0]] = world[best[1]].compose(t_a_b.inverse())
    values = gtsam.Values()
    for key in poses:
        values.insert(key, world.get(robot(key), gtsam.Pose3()).compose(place[key]))
    own = [k for k, e in enumerate(edges) if robot(e[0]) == robot(e[1])]
    told = sorted(k for members in chosen.values() for k, _ in members)
    made = time.process_time() - start
    start = time.process_time()
    graph = problem(edges, sorted(own + told), poses[0])
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    report("PCM + LM", told, result, poses, made + time.process_time() - start)
    start = time.process_time()
    graph = problem(edges, range(len(edges)), poses[0])
    params = gtsam.GncLMParams()
    params.setKnownInliers(own + [len(edges)])
    optimizer = gtsam.GncLMOptimizer(graph, values, params)
    result = optimizer.optimize()
    weights = optimizer.getWeights()
    known = set(own)
    used = [k for k in range(len(edges)) if weights[k] > 0.5 and k not in known]
    report("GNC", used, result, poses, made + time.process_time() - start)


main(sys.argv[1])

"""Peers of the estimator on the same problems: prints a CSV row per solver and problem.

    python peers.py SIGMA_MAX [SOLVER ...] < list-of-files

Rows are those of `merganser-sim bench registration --csv`; cpu_s is the processor time of the whole process, so that
threads count. Solvers are told the true noise, as in the recorded results: their bound is that of the noise, not
SIGMA_MAX. A solver that is not installed is named on standard error, with the reason. Needs numpy.
"""
import os
import struct
import sys
import time

os.environ["OMP_NUM_THREADS"] = "1"  # Threads that wait for each other burn processor time.

HEADER = "solver,group,N,ratio,seed,status,cpu_s,rot_deg,trans,scale_rel"


def read(path):
    """Points, truth and noise of one file (see sim/src/bench/corr.rs)."""
    with open(path, "rb") as file:
        data = file.read()
    if data[:8] != b"CORRv001":
        raise SystemExit(f"{path}: not a correspondence file")
    (n,) = struct.unpack_from("<I", data, 8)
    numbers = struct.unpack_from("<14d", data, 16)
    points = np.frombuffer(data, "<f4", 6 * n, 128).astype(float).reshape(2, n, 3)
    return points[0], points[1], numbers[0], np.reshape(numbers[2:11], (3, 3)), np.array(numbers[11:14])


def kiss(prune):
    import kiss_matcher

    def solve(source, target, sigma):
        config = kiss_matcher.KISSMatcherConfig(voxel_size=0.05)
        config.robin_noise_bound = 3 * sigma
        config.solver_noise_bound = 3 * sigma
        matcher = kiss_matcher.KISSMatcher(config)
        if prune:
            found = matcher.prune_and_solve(list(source.astype(np.float32)), list(target.astype(np.float32)))
        else:
            found = matcher.solve(source.T, target.T)
        return np.array(found.rotation), np.array(found.translation).ravel()

    return solve


def open3d(fast):
    import open3d as o3d

    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    registration = o3d.pipelines.registration

    def solve(source, target, sigma):
        clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (source, target)]
        pairs = o3d.utility.Vector2iVector(np.repeat(np.arange(len(source)), 2).reshape(-1, 2))
        if fast:
            option = registration.FastGlobalRegistrationOption(maximum_correspondence_distance=3 * sigma)
            found = registration.registration_fgr_based_on_correspondence(*clouds, pairs, option)
        else:
            criteria = registration.RANSACConvergenceCriteria(100_000, 0.999)
            found = registration.registration_ransac_based_on_correspondence(
                *clouds, pairs, 3 * sigma, ransac_n=3, criteria=criteria
            )
        return found.transformation[:3, :3], found.transformation[:3, 3]

    return solve


SOLVERS = {
    "kiss_prune_solve": lambda: kiss(True),
    "kiss_solve": lambda: kiss(False),
    "o3d_ransac": lambda: open3d(False),
    "o3d_fgr": lambda: open3d(True),
}


def main():
    named = sys.argv[2:] or list(SOLVERS)
    files = [line.rstrip("\n") for line in sys.stdin if line.strip()]
    ready = {}
    for name in named:
        if name not in SOLVERS:
            raise SystemExit(f"{name}: no such peer; there are {', '.join(SOLVERS)}")
        try:
            ready[name] = SOLVERS[name]()
        except Exception as error:  # Broken installations fail in many ways.
            print(f"{name}: cannot be measured: {error}", file=sys.stderr)
    print(HEADER)
    for name, solve in ready.items():
        for path in files:
            group, n, ratio, seed = os.path.basename(path).removesuffix(".corr").split("_")
            if group == "SIM3":
                continue  # None of these estimates scale.
            source, target, sigma, rotation, translation = read(path)
            began = time.process_time()
            found_rotation, found_translation = solve(source, target, sigma)
            spent = time.process_time() - began
            cosine = (np.trace(found_rotation.T @ rotation) - 1) / 2
            degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            error = np.linalg.norm(found_translation - translation)
            print(f"{name},{group},{int(n[1:])},{int(ratio[1:])},{int(seed[1:])},ok,{spent:.6f},{degrees:.5f},{error:.6f},0.0")


try:
    import numpy as np
except ImportError as error:
    raise SystemExit(f"numpy cannot be imported: {error}")
main()

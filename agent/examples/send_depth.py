"""Feeds depth images to the agent on this host, as a SLAM with a depth camera would. Needs: pip install eclipse-zenoh
Usage: python send_depth.py ENDPOINT SWARM ROBOT FOLDER, e.g. tcp/127.0.0.1:7448 demo alpha rgbd_7scenes; the folder
holds frame-XXXXXX.depth.png in millimetres, camera-intrinsics.txt and poses_all_1000.txt (camera-to-world)."""
import base64, json, math, pathlib, sys, time, zenoh

endpoint, swarm, robot, folder = sys.argv[1:5]
folder = pathlib.Path(folder)
fx, _, cx, _, fy, cy, *_ = map(float, (folder / "camera-intrinsics.txt").read_text().split())
poses = {int(line.split()[0]): [float(x) for x in line.split()[1:]] for line in open(folder / "poses_all_1000.txt")}


def quaternion(m):
    """[x, y, z, w] of a 4x4 matrix, row by row."""
    squares = [1 + m[0] - m[5] - m[10], 1 - m[0] + m[5] - m[10], 1 - m[0] - m[5] + m[10], 1 + m[0] + m[5] + m[10]]
    x, y, z, w = (math.sqrt(max(0.0, s)) / 2 for s in squares)
    return [math.copysign(x, m[9] - m[6]), math.copysign(y, m[2] - m[8]), math.copysign(z, m[4] - m[1]), w]


variances = [1e-4] * 3 + [3e-6] * 3  # of the motion since the keyframe before: 1 cm and 0.1 degrees
covariance = [variances[r] if r == c else 0.0 for r in range(6) for c in range(r, 6)]
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
with zenoh.open(config) as session:
    time.sleep(1.0)  # until the link is up
    for path in sorted(folder.glob("frame-*.depth.png")):
        index, data = int(path.name[6:12]), path.read_bytes()
        width, height = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
        depth = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "unit_m": 0.001}
        depth |= {"range_m": [0.3, 4.0], "encoding": "png", "data": base64.b64encode(data).decode()}
        m = poses[index]
        keyframe = {"stamp_ns": index * 33_333_333, "translation": [m[3], m[7], m[11]], "rotation": quaternion(m)}
        keyframe |= {"covariance": covariance, "covariance_of": "motion", "depth": depth}
        session.put(
            f"merganser/v1/{swarm}/{robot}/in/keyframe",
            json.dumps(keyframe),
            encoding=zenoh.Encoding.APPLICATION_JSON,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        print(path.name, flush=True)
        time.sleep(0.33)

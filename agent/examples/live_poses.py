"""Prints the live poses that each robot of a swarm sees, with their standard deviations. Needs: pip install eclipse-zenoh
Usage: python live_poses.py [ENDPOINT], e.g. tcp/127.0.0.1:7447; without one, robots are found by multicast."""
import json
import sys
import time

import zenoh

config = zenoh.Config()
if len(sys.argv) > 1:
    config.insert_json5("connect/endpoints", json.dumps(sys.argv[1:]))
with zenoh.open(config) as session:
    def show(sample):
        observer = str(sample.key_expr).split("/")[3]
        for robot in json.loads(sample.payload.to_string())["robots"]:
            if robot["t_own_body"]:
                x, s = robot["t_own_body"]["pose"]["translation"], robot["t_own_body"]["sigmas"]
                pose = "  ".join(f"{n} {v:+8.3f} ± {e:.3f} m" for n, v, e in zip("xyz", x, s))
                print(f"{observer} sees {robot['robot']} at {pose}", flush=True)
    session.declare_subscriber("merganser/v1/*/*/view/poses", show)
    while True:
        time.sleep(1)

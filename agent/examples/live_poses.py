"""Prints the live poses that each robot of a swarm sees, with their standard deviations. Needs: pip install eclipse-zenoh
Usage: python live_poses.py [ENDPOINT...], e.g. tcp/127.0.0.1:7447; without one, robots are found by multicast."""
import json, sys, zenoh

config = zenoh.Config()
if len(sys.argv) > 1:
    config.insert_json5("connect/endpoints", json.dumps(sys.argv[1:]))
with zenoh.open(config) as session, session.declare_subscriber("merganser/v1/*/*/view/poses") as poses:
    for sample in poses:
        observer = str(sample.key_expr).split("/")[3]
        for robot in json.loads(sample.payload.to_string())["robots"]:
            if robot["live"] and robot["t_own_body"]:
                x, sigmas = robot["t_own_body"]["pose"]["translation"], robot["t_own_body"]["sigmas"]
                pose = "  ".join(f"{n} {v:+8.3f} ± {s:.3f} m" for n, v, s in zip("xyz", x, sigmas))
                print(f"{observer} sees {robot['robot']:8} at {pose}", flush=True)

#!/usr/bin/env bash
# Runs agent/examples/live_poses.py, an ordinary Zenoh subscriber, against a live swarm of three agents, and checks that
# it sees each robot observe all three. Skipped, with the reason, where Python's venv or the Zenoh package is not to be
# had.
set -euo pipefail
cd "$(dirname "$0")/../.."
merganser=${CARGO_TARGET_DIR:-$PWD/target}/release/merganser
script=$PWD/agent/examples/live_poses.py
recordings=$PWD/agent/recordings
[ -x "$merganser" ] || cargo build --release --locked -p merganser

work=$(mktemp -d)
agents=()
finish() {
  [ ${#agents[@]} -eq 0 ] || kill "${agents[@]}" 2>/dev/null || true
  wait 2>/dev/null || true
  rm -rf "$work"
}
trap finish EXIT

skip() {
  echo "skipped: $1"
  exit 0
}
command -v python3 >/dev/null || skip "python3 is missing"
python3 -m venv "$work/venv" 2>/dev/null || skip "python3 has no venv module"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check 'eclipse-zenoh==1.10.*' 2>/dev/null ||
  skip "pip cannot install eclipse-zenoh"

# Three free loopback ports, then three keys, a roster and three configurations.
read -r -a ports <<<"$(python3 -c '
import socket
sockets = [socket.socket() for _ in range(3)]
for s in sockets: s.bind(("127.0.0.1", 0))
print(*(s.getsockname()[1] for s in sockets))')"
names=(alpha beta gamma)
roster=""
for name in "${names[@]}"; do
  roster+=$("$merganser" keys generate --name "$name" --out "$work" | grep -E "^$name *= *\"")$'\n'
done
for k in 0 1 2; do
  name=${names[$k]}
  others=$(for o in 0 1 2; do [ $o -eq $k ] || printf '"tcp/127.0.0.1:%s", ' "${ports[$o]}"; done)
  cat >"$work/$name.toml" <<TOML
swarm = "python"
robot = "$name"
key_file = "$name.key"

[roster]
$roster
[store]
path = "$name.redb"

[zenoh]
listen = ["tcp/127.0.0.1:${ports[$k]}"]
connect = [${others%, }]
multicast = false

[debug]
publish = true
interval_secs = 0.5
TOML
  "$merganser" check -c "$work/$name.toml" >/dev/null
  "$merganser" run -c "$work/$name.toml" --recording "$recordings/$name" --speed 10 >"$work/$name.log" 2>&1 &
  agents+=($!)
done

timeout 25 "$work/venv/bin/python" "$script" "tcp/127.0.0.1:${ports[0]}" "tcp/127.0.0.1:${ports[1]}" \
  "tcp/127.0.0.1:${ports[2]}" >"$work/seen.txt" || true
sed -n '1,3p;$p' "$work/seen.txt"
missing=0
for observer in "${names[@]}"; do
  for robot in "${names[@]}"; do
    grep -q "^$observer sees $robot " "$work/seen.txt" || { echo "$observer never saw $robot"; missing=1; }
  done
done
if [ $missing -ne 0 ]; then
  tail -n 20 "$work"/*.log
  exit 1
fi
echo "an ordinary Zenoh subscriber saw every robot through every robot's eyes ($(wc -l <"$work/seen.txt") lines)"

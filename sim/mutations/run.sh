#!/bin/sh
# Re-introduces bugs, one patch at a time, and shows that the simulator finds each within 200 seeds.
# Usage: sim/mutations/run.sh [NAME...]    all patches, or those named (without .patch)
# Each patch is applied to a copy of the committed tree; nothing of the tree itself is touched.
# Exits with 0 only if every bug was found.
set -eu
root=$(git -C "$(dirname "$0")" rev-parse --show-toplevel)
seeds=${SEEDS:-0..200}
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$root/target/mutations}"
# One place for all copies, so that they share what they build.
copy=$CARGO_TARGET_DIR/mutant-source
mkdir -p "$copy"
missed=0

# Mutants are built often and run briefly: our own crates are optimised less.
build() {
    cargo build --release --quiet -p merganser-sim \
        --config 'profile.release.package.merganser-protocol.opt-level=1' \
        --config 'profile.release.package.merganser-registration.opt-level=1' \
        --config 'profile.release.package.merganser-estimation.opt-level=1' \
        --config 'profile.release.package.merganser-store.opt-level=1' \
        --config 'profile.release.package.merganser-sim.opt-level=1'
}

if [ $# -eq 0 ]; then
    for patch in "$root"/sim/mutations/*.patch; do
        set -- "$@" "$(basename "$patch" .patch)"
    done
fi
for name in "$@"; do
    rm -rf "${copy:?}/tree"
    mkdir "$copy/tree"
    git -C "$root" archive HEAD | tar -x -m -C "$copy/tree" # files of today: what the last mutant built is not fresh
    # The copy lies outside any repository, so the patch is applied to plain files.
    (cd "$copy/tree" && patch -p1 -s --fuzz=3 <"$root/sim/mutations/$name.patch")
    if ! (cd "$copy/tree" && build) 2>"$copy/log"; then
        echo "$name: the patch no longer compiles; mend it:"
        cat "$copy/log"
        missed=1
        continue
    fi
    found=$("$CARGO_TARGET_DIR/release/merganser-sim" vopr --seeds "$seeds" --fail-fast | sed -n 's/^BROKEN *//p')
    if [ -z "$found" ]; then
        echo "MISSED $name: seeds $seeds broke no invariant"
        missed=1
    else
        echo "found  $name: $(echo "$found" | head -n 1)"
    fi
done
exit $missed

//! Hostile bytes take no memory beyond the bounds: a message in proportion to its length, a bag at most a chunk.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "../src/bag/write.rs"]
mod write;

mod reading;

use merganser_ros::bag::{Bag, Flow};
use merganser_ros::limits::CHUNK_BYTES_MAX;
use proptest::prelude::*;
use std::cell::Cell;
use std::path::Path;
use tracking_allocator::{AllocationGroupId, AllocationRegistry, AllocationTracker, Allocator};
use write::Written;

#[global_allocator]
static ALLOCATOR: Allocator<std::alloc::System> = Allocator::system();

thread_local! {
    static LARGEST: Cell<usize> = const { Cell::new(0) };
}

/// Keeps the largest allocation of each thread.
struct Largest;

impl AllocationTracker for Largest {
    fn allocated(&self, _: usize, object_size: usize, _: usize, _: AllocationGroupId) {
        LARGEST.with(|largest| largest.set(largest.get().max(object_size)));
    }

    fn deallocated(&self, _: usize, _: usize, _: usize, _: AllocationGroupId, _: AllocationGroupId) {}
}

/// The largest allocation that `work` makes, bytes.
fn largest(work: impl FnOnce()) -> usize {
    let _ = AllocationRegistry::set_global_tracker(Largest);
    AllocationRegistry::enable_tracking();
    LARGEST.set(0);
    work();
    LARGEST.get()
}

/// Bytes of memory for each byte of a message, and besides: a point of three doubles may come of three bytes, an
/// element of a list with its text of a dozen.
const PER_BYTE: usize = 32;
const BESIDES: usize = 4_096;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(500))]
    #[test]
    fn a_message_takes_memory_in_proportion_to_its_bytes(
        mut bytes in prop::collection::vec(prop_oneof![Just(0_u8), Just(1), Just(0xff), any::<u8>()], 0..600), cdr: bool,
    ) {
        if cdr && bytes.len() >= 4 {
            bytes[..4].copy_from_slice(&[0, 1, 0, 0]);
        }
        let most = largest(|| reading::messages(&bytes));
        prop_assert!(most <= PER_BYTE * bytes.len() + BESIDES, "{most} bytes for {}", bytes.len());
    }
}

fn messages() -> Vec<Written> {
    let message = |k: i64| Written {
        topic: "/odom".into(),
        kind: "nav_msgs/msg/Odometry".into(),
        received_ns: k,
        bytes: vec![7; 100],
    };
    (1..30).map(message).collect()
}

fn bag_takes(path: &Path) -> usize {
    largest(|| {
        if let Ok(bag) = Bag::open(path) {
            let _ = bag.read(|_| true, |_| Flow::On);
        }
    })
}

/// Each run of eight bytes in turn claims as much as eight bytes can, and a little more than a chunk may have.
#[test]
fn a_bag_takes_no_more_than_a_chunk_whatever_it_claims() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write::mcap(&path("a.mcap"), &messages(), Some(mcap::Compression::Zstd), true, "cdr");
    write::mcap(&path("b.mcap"), &messages(), Some(mcap::Compression::Lz4), true, "cdr");
    write::mcap(&path("c.mcap"), &messages(), None, false, "cdr");
    write::db3(&path("d.db3"), &messages(), false, true);
    write::ros1(&path("e.bag"), &messages(), "lz4");
    write::ros1(&path("f.bag"), &messages(), "bz2");
    for name in ["a.mcap", "b.mcap", "c.mcap", "d.db3", "e.bag", "f.bag"] {
        let good = std::fs::read(path(name)).unwrap();
        assert!(bag_takes(&path(name)) <= 4 << 20, "{name}");
        for claim in [u64::MAX, CHUNK_BYTES_MAX as u64 + 1] {
            for at in (8..good.len().min(800) - 8).step_by(10) {
                let mut bytes = good.clone();
                bytes[at..at + 8].copy_from_slice(&claim.to_le_bytes());
                std::fs::write(path(name), &bytes).unwrap();
                let most = bag_takes(&path(name));
                assert!(most <= CHUNK_BYTES_MAX + (4 << 20), "{name}: {most} bytes, with {claim:x} at {at}");
            }
        }
    }
}

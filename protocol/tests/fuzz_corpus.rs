//! Hostile bytes, on every test run: the corpus that fuzzing found, replayed, and some thousands of random stories
//! more. An allocation over [`fuzzing::ALLOCATION_MAX`] fails, as does any panic. One input alone:
//! `MERGANSER_FUZZ=handle:path/to/file cargo test -p merganser-protocol --release --test fuzz_corpus`, and random ones
//! of another seed: `MERGANSER_FUZZ_SEED=7 …`.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "a failed unwrap in a test is its report"
)]

mod fuzzing;
#[path = "fuzzing/list.rs"]
mod list;

use fuzzing::{ALLOCATION_MAX, Meter};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::cell::Cell;
use std::path::PathBuf;
use tracking_allocator::{AllocationGroupId, AllocationRegistry, AllocationTracker, Allocator};

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

/// Fails where the core asks for more than it may.
struct Limit;

impl Limit {
    fn new() -> Self {
        // The first thread wins; all install the same.
        let _ = AllocationRegistry::set_global_tracker(Largest);
        AllocationRegistry::enable_tracking();
        Self
    }
}

impl Meter for Limit {
    fn begin(&self) {
        LARGEST.set(0);
    }

    fn end(&self, what: &str) {
        let largest = LARGEST.get();
        assert!(largest <= ALLOCATION_MAX, "{what} made the core allocate {largest} bytes at once");
    }
}

fn run(target: &str, bytes: &[u8]) {
    match target {
        "decode" => fuzzing::decode(bytes, &Limit::new()),
        "handle" => fuzzing::handle(bytes, &Limit::new()),
        other => panic!("no fuzz target {other}"),
    }
}

fn fuzz_folder() -> PathBuf {
    PathBuf::from("fuzz")
}

/// Every file of a target's corpus, in the order of their names.
fn corpus(target: &str) -> Vec<(PathBuf, Vec<u8>)> {
    let folder = fuzz_folder().join("corpus").join(target);
    let files = std::fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut paths: Vec<PathBuf> = files.map(|file| file.unwrap().path()).collect();
    paths.sort();
    assert!(!paths.is_empty(), "{} is empty; `git checkout` it", folder.display());
    paths.into_iter().map(|path| (path.clone(), std::fs::read(&path).unwrap())).collect()
}

/// Runs `work`; should it panic, says how to see it again.
fn reproducible(line: &str, work: impl FnOnce()) {
    if let Err(panic) = std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)) {
        println!("REPRODUCE WITH: {line} cargo test -p merganser-protocol --release --test fuzz_corpus");
        std::panic::resume_unwind(panic);
    }
}

fn replay(target: &str) {
    let files = corpus(target);
    let bytes: usize = files.iter().map(|(_, bytes)| bytes.len()).sum();
    for (path, bytes) in &files {
        reproducible(&format!("MERGANSER_FUZZ={target}:{}", path.display()), || run(target, bytes));
    }
    println!("{target}: replayed {} inputs, {bytes} bytes", files.len());
}

/// Random inputs. Each has a seed of its own: the one that failed is the first of another run.
fn explore(target: &str, count: u64, mut make: impl FnMut(&mut ChaCha8Rng) -> Vec<u8>) {
    let first = std::env::var("MERGANSER_FUZZ_SEED").map_or(1000, |seed| seed.parse::<u64>().unwrap());
    println!("{target}: {count} random inputs from seed {first}");
    for seed in first..first + count {
        let bytes = make(&mut ChaCha8Rng::seed_from_u64(seed));
        reproducible(&format!("MERGANSER_FUZZ_SEED={seed}"), || run(target, &bytes));
    }
}

#[test]
fn the_corpus_of_the_decoders_holds() {
    replay("decode");
}

#[test]
fn the_corpus_of_stories_holds() {
    replay("handle");
}

#[test]
fn damaged_inputs_of_the_decoders_hold() {
    let files = corpus("decode");
    explore("decode", 20_000, |rng| {
        let (_, mut bytes) = files[rng.random_range(0..files.len())].clone();
        for _ in 0..rng.random_range(0..4) {
            if !bytes.is_empty() {
                let at = rng.random_range(0..bytes.len());
                bytes[at] = rng.random();
            }
        }
        bytes.truncate(if rng.random_range(0..4) == 0 { rng.random_range(0..=bytes.len()) } else { bytes.len() });
        bytes
    });
}

#[test]
fn random_stories_hold() {
    let files = corpus("handle");
    explore("handle", 2_000, |rng| {
        // Half a story that was found, then one that nobody knows; or either alone.
        let mut bytes = files[rng.random_range(0..files.len())].1.clone();
        bytes.truncate(rng.random_range(0..=bytes.len()));
        let mut rest = vec![0; rng.random_range(0..400)];
        rng.fill_bytes(&mut rest);
        bytes.extend(rest);
        bytes
    });
}

/// One input alone, named by `MERGANSER_FUZZ=target:path`.
#[test]
fn the_input_that_was_named_holds() {
    let Ok(named) = std::env::var("MERGANSER_FUZZ") else { return };
    let (target, path) = named.split_once(':').unwrap();
    run(target, &std::fs::read(path).unwrap());
    println!("{target}: {path} holds");
}

#[test]
#[should_panic(expected = "at once")]
fn an_allocation_over_the_limit_is_seen() {
    let limit = Limit::new();
    limit.begin();
    drop(vec![1u8; ALLOCATION_MAX]);
    limit.end("the limit");
    drop(std::hint::black_box(vec![1u8; ALLOCATION_MAX + 1]));
    limit.end("a byte more");
}

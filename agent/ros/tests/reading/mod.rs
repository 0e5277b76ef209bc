//! What the fuzz target `bags` of `agent/recording/fuzz` does with bytes, shared with the test `memory`, which measures
//! what it takes.
#![allow(missing_docs, clippy::unwrap_used, reason = "a failed unwrap in a test is its report")]

use merganser_ros::bag::{Bag, Flow};
use merganser_ros::join::{Wanted, choose, gather};
use merganser_ros::msg::{CameraInfo, Image, Imu, LaserScan, Odometry, PointCloud2, TfMessage};
use merganser_ros::wire::{Message, Serialization};

/// The bytes as a file of each kind: read to the end, and joined as far as they go.
pub fn bags(bytes: &[u8]) {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.mcap", "a.db3", "a.bag"] {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let Ok(bag) = Bag::open(&path) else { continue };
        let _ = bag.read(|_| true, |_| Flow::On);
        if let Ok(choices) = choose(bag.topics(), &Wanted::default()) {
            let _ = gather(&bag, &choices);
        }
    }
}

/// The bytes as each message, in each serialization.
pub fn messages(bytes: &[u8]) {
    let _ = (read::<Odometry>(bytes), read::<TfMessage>(bytes), read::<CameraInfo>(bytes));
    let _ = (read::<Image>(bytes), read::<Imu>(bytes));
    if let Some(scan) = read::<LaserScan>(bytes) {
        let _ = scan.points();
    }
    if let Some(cloud) = read::<PointCloud2>(bytes) {
        let _ = cloud.points(usize::MAX);
    }
}

fn read<M: Message>(bytes: &[u8]) -> Option<M> {
    let read = [Serialization::Cdr, Serialization::Ros1].map(|serialization| M::decode(serialization, bytes).ok());
    read.into_iter().flatten().next()
}

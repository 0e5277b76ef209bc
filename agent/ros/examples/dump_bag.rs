//! Prints what is read of a bag, a line for each message, to be compared with another reader: topic, time of receipt,
//! and, of odometry, scans, clouds and transforms, stamp, frame and numbers (poses; how many points, and their sum).
//!
//! ```sh
//! cargo run --release -p merganser-ros --example dump_bag -- BAG
//! ```

use merganser_ros::bag::{Bag, Flow, Record};
use merganser_ros::msg::{Header, LaserScan, Odometry, PointCloud2, TfMessage};
use merganser_ros::wire::{Message as _, Serialization};
use std::io::{BufWriter, Write as _};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args_os().nth(1).ok_or("name a bag")?;
    let bag = Bag::open(path.as_ref())?;
    let mut out = BufWriter::new(std::io::stdout().lock());
    let mut failed = None;
    bag.read(
        |_| true,
        |Record { topic, received_ns, bytes }| {
            let topic = &bag.topics()[topic];
            let told = topic.serialization.map(|serialization| told(serialization, &topic.kind, bytes));
            let line = match told {
                Some(Ok(told)) => told,
                Some(Err(error)) => format!(" {error}"),
                None => String::new(),
            };
            match writeln!(out, "{} {received_ns}{line}", topic.name) {
                Ok(()) => Flow::On,
                Err(error) => {
                    failed = Some(error);
                    Flow::Stop
                }
            }
        },
    )?;
    for told in bag.damage().told() {
        writeln!(out, "# {told}")?;
    }
    failed.map_or(Ok(()), |error| Err(error.into()))
}

/// What a message says.
fn told(serialization: Serialization, kind: &str, bytes: &[u8]) -> Result<String, Box<dyn std::error::Error>> {
    let (header, numbers) = match kind {
        Odometry::TYPE => {
            let Odometry { header, pose, .. } = Odometry::decode(serialization, bytes)?;
            let numbers = [&pose.pose.position.xyz()[..], &pose.pose.orientation.xyzw(), &pose.covariance].concat();
            (header, numbers)
        }
        LaserScan::TYPE => {
            let scan = LaserScan::decode(serialization, bytes)?;
            let (points, _) = scan.points();
            let [x, y, _] = points.last().copied().unwrap_or_default();
            let [all_x, all_y, _] = sum(&points);
            (scan.header, vec![points.len() as f64, all_x, all_y, x, y])
        }
        PointCloud2::TYPE => {
            let cloud = PointCloud2::decode(serialization, bytes)?;
            let (points, _) = cloud.points(usize::MAX)?;
            (cloud.header, [&[points.len() as f64][..], &sum(&points)].concat())
        }
        TfMessage::TYPE => {
            let TfMessage { transforms } = TfMessage::decode(serialization, bytes)?;
            let mut numbers = vec![transforms.len() as f64];
            for transform in &transforms {
                numbers.extend(transform.transform.translation.xyz());
                numbers.extend(transform.transform.rotation.xyzw());
            }
            let none = Header { stamp_ns: 0, frame_id: "-".into() };
            (transforms.into_iter().next().map_or(none, |first| first.header), numbers)
        }
        _ => return Ok(String::new()),
    };
    let numbers: Vec<String> = numbers.iter().map(|number| format!("{number:.9}")).collect();
    Ok(format!(" {} {} {}", header.stamp_ns, header.frame_id, numbers.join(" ")))
}

fn sum(points: &[[f64; 3]]) -> [f64; 3] {
    points.iter().fold([0.0; 3], |sum, point| [sum[0] + point[0], sum[1] + point[1], sum[2] + point[2]])
}

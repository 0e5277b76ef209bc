//! A second reading of a bag for the clouds that are wanted, in the body's frame.

use super::{JoinError, Joined, Posed, Tally};
use crate::bag::{Bag, Flow};
use crate::limits::{GAP_SECS_MAX, POINTS_KEPT_MAX};
use crate::msg::{Header, LaserScan, PointCloud2};
use crate::tf::TfError;
use crate::wire::Message as _;
use merganser_geometry::Se3;
use nalgebra::Vector3;

/// A cloud in the body's frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Placed {
    /// m; at least one.
    pub points: Vec<[f32; 3]>,
    /// `t_body_sensor`.
    pub t_body_sensor: Se3,
}

impl Joined {
    /// Reads the clouds for which `wanted` says so, by their place in [`Joined::clouds`], and gives them to `each` in
    /// their order. Clouds that have no point, cannot be read, or whose frame has no transform then, are counted in
    /// what is returned. It may stop the reading.
    ///
    /// # Errors
    /// [`JoinError::Unplaced`] or [`JoinError::Unusable`] if none can be used for that reason, [`JoinError::Bag`]; an error
    /// of `each` ends the reading.
    pub fn read<E: From<JoinError>>(
        &self,
        bag: &Bag,
        wanted: impl Fn(usize) -> bool,
        mut each: impl FnMut(usize, &Posed, Placed) -> Result<Flow, E>,
    ) -> Result<Tally, E> {
        let (mut number, mut next) = (0, 0);
        let (mut unplaced, mut bad) = (Tally::default(), Tally::default());
        let (mut used, mut failed) = (0_u64, None);
        let result = bag.read(
            |topic| topic == self.choice.cloud,
            |record| {
                let this = number;
                number += 1;
                let Some(posed) = self.clouds.get(next) else { return Flow::Stop };
                if posed.number != this {
                    return Flow::On;
                }
                let index = next;
                next += 1;
                if !wanted(index) {
                    return Flow::On;
                }
                match self.placed(record.bytes, posed) {
                    Ok(placed) => {
                        used += 1;
                        match each(index, posed, placed) {
                            Ok(flow) => return flow,
                            Err(error) => {
                                failed = Some(error);
                                return Flow::Stop;
                            }
                        }
                    }
                    Err(Unused::Frame(why)) => unplaced.count(why),
                    Err(Unused::Cloud(why)) => bad.count(why),
                }
                Flow::On
            },
        );
        if let Some(error) = failed {
            return Err(error);
        }
        let damage = result.map_err(|error| E::from(JoinError::Bag(error)))?;
        if used == 0 {
            let (cloud, body) = (self.cloud.clone(), self.body.clone());
            if let Some(why) = unplaced.commonest() {
                return Err(JoinError::Unplaced { cloud, body, why: why.into() }.into());
            }
            let why = bad.commonest().unwrap_or("none is wanted").into();
            return Err(JoinError::Unusable { topic: cloud, count: bad.sum(), why }.into());
        }
        for (why, count) in unplaced.reasons() {
            bad.add(format!("cannot be put into the body's frame: {why}"), count);
        }
        for told in damage.beyond(bag.damage()).beyond(&self.damage).told() {
            bad.count(told);
        }
        Ok(bad)
    }

    fn placed(&self, bytes: &[u8], posed: &Posed) -> Result<Placed, Unused> {
        let (header, points, missed) = self.points(bytes)?;
        if points.is_empty() {
            return Err(Unused::Cloud(match missed {
                0 => "has no points".into(),
                _ => "has no point that is finite and in range".into(),
            }));
        }
        let t_body_sensor = self.t_body_sensor(header.frame(), posed)?;
        let mut placed = Vec::with_capacity(points.len());
        for point in points {
            let p = t_body_sensor * Vector3::from(point);
            placed.push([p.x as f32, p.y as f32, p.z as f32]);
        }
        Ok(Placed { points: placed, t_body_sensor })
    }

    /// Points in the frame of the header, and how many were none.
    fn points(&self, bytes: &[u8]) -> Result<(Header, Vec<[f64; 3]>, usize), Unused> {
        let told = |error: &dyn std::fmt::Display| Unused::Cloud(error.to_string());
        if self.is_planar {
            let scan = LaserScan::decode(self.serialization, bytes).map_err(|error| told(&error))?;
            let (mut points, missed) = scan.points();
            points.truncate(POINTS_KEPT_MAX);
            return Ok((scan.header, points, missed));
        }
        let cloud = PointCloud2::decode(self.serialization, bytes).map_err(|error| told(&error))?;
        let (points, missed) = cloud.points(POINTS_KEPT_MAX).map_err(|error| told(&error))?;
        Ok((cloud.header, points, missed))
    }

    /// How the sensor sits; of points in the odometry's frame, where that lies by the pose.
    fn t_body_sensor(&self, frame: &str, posed: &Posed) -> Result<Se3, Unused> {
        if frame.is_empty() {
            return Err(Unused::Frame("the cloud names no frame (header.frame_id is empty)".into()));
        }
        if frame == self.body {
            return Ok(Se3::identity());
        }
        if frame == self.odom {
            return Ok(posed.pose.inverse());
        }
        self.tree.lookup(&self.body, frame, posed.stamp_ns).map_err(|error| {
            // Without stamps, so that equal reasons are told once.
            Unused::Frame(match error {
                TfError::Time { parent, child, .. } => {
                    format!("TF {parent} → {child} moves, and no transform comes before, or none after it")
                }
                TfError::Gap { parent, child, .. } => {
                    format!("TF {parent} → {child} is silent for more than {GAP_SECS_MAX} s then")
                }
                other => other.to_string(),
            })
        })
    }
}

enum Unused {
    /// There is no transform.
    Frame(String),
    /// There are no points.
    Cloud(String),
}

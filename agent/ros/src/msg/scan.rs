//! `sensor_msgs/LaserScan` and its points.

use super::{Header, message};

message! {
    /// `sensor_msgs/LaserScan`.
    LaserScan = "sensor_msgs/LaserScan" {
        /// When the first ray was measured, and the laser's frame.
        header: Header,
        /// Of the first ray, rad, counter-clockwise from the x axis.
        angle_min: f32,
        /// Of the last ray, rad.
        angle_max: f32,
        /// Between rays, rad.
        angle_increment: f32,
        /// Between rays, s.
        time_increment: f32,
        /// Between scans, s.
        scan_time: f32,
        /// Nearer ranges are none, m.
        range_min: f32,
        /// This range and farther ones are none, m.
        range_max: f32,
        /// m; infinite or NaN where nothing was measured.
        ranges: Vec<f32>,
        /// Of the driver's own unit, or none.
        intensities: Vec<f32>,
    }
}

impl LaserScan {
    /// What the rays hit, in the laser's frame, m; and how many rays hit nothing, or nothing from `range_min` on and
    /// below `range_max`: simulators report `range_max` itself where nothing was hit.
    pub fn points(&self) -> (Vec<[f64; 3]>, usize) {
        let limits = self.range_min..self.range_max;
        let hit = |(ray, range): (usize, &f32)| {
            let angle = f64::from(self.angle_min) + ray as f64 * f64::from(self.angle_increment);
            let range =
                (limits.contains(range) && range.is_finite() && angle.is_finite()).then_some(f64::from(*range))?;
            Some([range * angle.cos(), range * angle.sin(), 0.0])
        };
        let points: Vec<_> = self.ranges.iter().enumerate().filter_map(hit).collect();
        let missed = self.ranges.len() - points.len();
        (points, missed)
    }
}

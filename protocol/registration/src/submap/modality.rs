//! What tells sensors apart, a row for each, without wild cards: whoever adds a sensor is asked for its row by the
//! compiler, and nothing else of this crate asks which sensor it was.

use crate::config::Sensor;

/// How a sensor sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Modality {
    /// It gives landmarks; all others give points of surfaces.
    pub landmarks: bool,
    /// Poses are taken as planar, and heights are left out.
    pub planar: bool,
    /// Scan matching sharpens the motion between keyframes, so that submaps lie in a frame that is not the SLAM's.
    pub sharpens: bool,
    /// All its views of a place are bent alike, as those of a depth camera of a wrong lens are: they are tried against
    /// one another, and an alignment reckons with it.
    pub bends: bool,
    /// It measures ranges of its own, as a LiDAR does, whose errors are independent and small.
    pub ranges: bool,
}

impl Modality {
    /// The row of a sensor.
    pub const fn of(sensor: Sensor) -> Self {
        let space = Self { landmarks: false, planar: false, sharpens: false, bends: false, ranges: false };
        match sensor {
            Sensor::Points3d => Self { bends: true, ..space },
            Sensor::Lidar3d => Self { ranges: true, ..space },
            Sensor::Laser2d => Self { planar: true, sharpens: true, ..space },
            Sensor::Landmarks => Self { landmarks: true, ..space },
            Sensor::Landmarks2d => Self { landmarks: true, planar: true, ..space },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_agree_with_what_options_say_of_a_sensor() {
        for sensor in [Sensor::Points3d, Sensor::Lidar3d, Sensor::Laser2d, Sensor::Landmarks, Sensor::Landmarks2d] {
            let row = Modality::of(sensor);
            assert_eq!((row.planar, row.landmarks), (sensor.is_planar(), sensor.sees_landmarks()), "{sensor:?}");
            assert!(!row.sharpens || row.planar, "scans are matched in the plane");
        }
    }
}

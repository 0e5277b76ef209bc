//! A simulated drive, as messages of a bag, for tests: a robot on a circle in a rectangular room, with odometry at 20
//! Hz and a planar laser, or a LiDAR that sees the walls' height, at 10 Hz.

use super::geometry::{Se3, So3};
use super::ros::msg::{
    Header, LaserScan, Odometry, PointCloud2, PointField, Pose, PoseWithCovariance, Quaternion, TfMessage, Transform,
    TransformStamped, Twist, TwistWithCovariance, Vector3,
};
use super::ros::wire::{Blob, Message, Serialization};
use super::write::Written;

/// Half the room's length and width, m.
pub const ROOM: [f64; 2] = [12.0, 8.0];
/// When the drive begins, ns.
pub const BEGIN_NS: i64 = 1_700_000_000_000_000_000;

/// A robot.
#[derive(Clone, Copy, Debug)]
pub struct Robot<'a> {
    /// Before the names of its topics, such as `/robot1`.
    pub namespace: &'a str,
    /// How its messages are written.
    pub serialization: Serialization,
    /// Where on the circle it begins, rad.
    pub phase: f64,
    /// Variance of x, y and yaw as it states them; those of z, roll and pitch are 1e6.
    pub variance: f64,
    /// Whether it has a LiDAR.
    pub sees_height: bool,
}

/// A robot with a laser.
pub const ROBOT: Robot<'static> =
    Robot { namespace: "", serialization: Serialization::Cdr, phase: 0.0, variance: 0.0, sees_height: false };

impl Robot<'_> {
    /// `t_odom_body`, and so `t_room_body`, so many seconds after the beginning.
    pub fn pose(&self, secs: f64) -> Se3 {
        let angle = self.phase + 0.25 * secs;
        let heading = So3::exp(&nalgebra::Vector3::z().scale(angle + core::f64::consts::FRAC_PI_2));
        Se3::new(heading, nalgebra::Vector3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 0.0))
    }

    /// Its messages in the order of their stamps.
    pub fn drive(&self, secs: f64) -> Vec<Written> {
        let mut messages = vec![self.message("tf_static", 0.0, &self.sensor_pose())];
        for tick in 0..(20.0 * secs) as u32 {
            let at = f64::from(tick) / 20.0;
            messages.push(self.message("odom", at, &self.odometry(at)));
            if tick % 2 == 0 {
                messages.push(match self.sees_height {
                    true => self.message("points", at + 0.013, &self.cloud(at + 0.013)),
                    false => self.message("scan", at + 0.013, &self.scan(at + 0.013)),
                });
            }
        }
        messages
    }

    /// A message of this robot.
    pub fn message<M: Message>(&self, topic: &str, secs: f64, message: &M) -> Written {
        let kind = match self.serialization {
            Serialization::Cdr => M::TYPE.replace('/', "/msg/"),
            Serialization::Ros1 => M::TYPE.into(),
        };
        Written {
            topic: format!("{}/{topic}", self.namespace),
            kind,
            received_ns: stamp(secs) + 2_000_000,
            bytes: message.encode(self.serialization),
        }
    }

    /// Its odometry.
    pub fn odometry(&self, secs: f64) -> Odometry {
        let mut covariance = [0.0; 36];
        if self.variance > 0.0 {
            for (axis, at) in [0, 7, 14, 21, 28, 35].into_iter().enumerate() {
                covariance[at] = if [0, 1, 5].contains(&axis) { self.variance } else { 1e6 };
            }
        }
        let zero = || Vector3 { x: 0.0, y: 0.0, z: 0.0 };
        Odometry {
            header: header(secs, "odom"),
            child_frame_id: "base_link".into(),
            pose: PoseWithCovariance { pose: pose(&self.pose(secs)), covariance },
            twist: TwistWithCovariance { twist: Twist { linear: zero(), angular: zero() }, covariance: [0.0; 36] },
        }
    }

    /// How its sensor sits: on a mast, and turned on it.
    pub fn sensor_pose(&self) -> TfMessage {
        let mast = Se3::new(So3::identity(), nalgebra::Vector3::new(0.2, 0.0, 0.3));
        let turned = Se3::new(So3::exp(&nalgebra::Vector3::new(0.0, 0.0, 0.4)), nalgebra::Vector3::zeros());
        let link = |parent: &str, child: &str, t: &Se3| TransformStamped {
            header: header(0.0, parent),
            child_frame_id: child.into(),
            transform: transform(t),
        };
        TfMessage { transforms: vec![link("base_link", "mast", &mast), link("mast", "laser", &turned)] }
    }

    /// What its laser sees.
    pub fn scan(&self, secs: f64) -> LaserScan {
        const RAYS: usize = 180;
        let step = core::f64::consts::TAU / RAYS as f64;
        let t_room_laser = self.pose(secs) * self.t_body_laser();
        let range = |ray: usize| {
            let angle = ray as f64 * step;
            let way = t_room_laser.rotation * nalgebra::Vector3::new(angle.cos(), angle.sin(), 0.0);
            let to_wall = |axis: usize| {
                let (from, way) = (t_room_laser.translation[axis], way[axis]);
                if way == 0.0 { f64::INFINITY } else { (ROOM[axis] * way.signum() - from) / way }
            };
            if ray == 7 { f32::NAN } else { to_wall(0).min(to_wall(1)) as f32 }
        };
        LaserScan {
            header: header(secs, "laser"),
            angle_min: 0.0,
            angle_max: (step * (RAYS - 1) as f64) as f32,
            angle_increment: step as f32,
            time_increment: 0.0,
            scan_time: 0.1,
            range_min: 0.1,
            range_max: 30.0,
            ranges: (0..RAYS).map(range).collect(),
            intensities: vec![],
        }
    }

    /// What its LiDAR sees.
    pub fn cloud(&self, secs: f64) -> PointCloud2 {
        let (points, _) = self.scan(secs).points();
        let levels = [-0.3_f32, 0.5, 1.5, 2.5];
        let number = |value: f32| value.to_le_bytes();
        let all = levels.iter().flat_map(|z| points.iter().map(|[x, y, _]| [*x as f32, *y as f32, *z, 17.0]));
        let data: Vec<u8> = all.flat_map(|point| point.map(number).concat()).collect();
        let field = |(k, name): (u32, &str)| PointField { name: name.into(), offset: 4 * k, datatype: 7, count: 1 };
        PointCloud2 {
            header: header(secs, "laser"),
            height: 1,
            width: data.len() as u32 / 16,
            fields: ["x", "y", "z", "intensity"].into_iter().enumerate().map(|(k, n)| field((k as u32, n))).collect(),
            is_bigendian: false,
            point_step: 16,
            row_step: data.len() as u32,
            data: Blob(data),
            is_dense: true,
        }
    }

    fn t_body_laser(&self) -> Se3 {
        let links = self.sensor_pose().transforms;
        links.iter().fold(Se3::identity(), |t, link| t * link.transform.se3().unwrap())
    }
}

/// A header.
pub fn header(secs: f64, frame: &str) -> Header {
    Header { stamp_ns: stamp(secs), frame_id: frame.into() }
}

/// So long after the beginning, ns.
pub fn stamp(secs: f64) -> i64 {
    BEGIN_NS + (secs * 1e9).round() as i64
}

/// As a message has it.
pub fn pose(t: &Se3) -> Pose {
    let Transform { translation, rotation } = transform(t);
    Pose { position: translation, orientation: rotation }
}

/// As a message has it.
pub fn transform(t: &Se3) -> Transform {
    let ([x, y, z, w], p) = (t.rotation.xyzw(), t.translation);
    Transform { translation: Vector3 { x: p.x, y: p.y, z: p.z }, rotation: Quaternion { x, y, z, w } }
}

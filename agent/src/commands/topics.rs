//! Which topics of a ROS bag are meant.

use super::BadInput;
use crate::recording::import::Wanted;
use anyhow::Result;

/// Options that name topics.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Topics {
    /// Of a ROS bag: the topic of poses (nav_msgs/Odometry, PoseStamped, PoseWithCovarianceStamped). Without a
    /// leading slash it is that of each robot's namespace.
    #[arg(long, value_name = "TOPIC")]
    pub odometry: Option<String>,
    /// Of a ROS bag: the topic of clouds (sensor_msgs/PointCloud2, LaserScan), named alike.
    #[arg(long, value_name = "TOPIC")]
    pub cloud: Option<String>,
}

impl Topics {
    /// As the importer takes them.
    pub fn wanted(&self) -> Wanted {
        Wanted { odometry: self.odometry.clone(), cloud: self.cloud.clone() }
    }

    /// Where there is no bag.
    ///
    /// # Errors
    /// If a topic is named.
    pub(crate) fn refuse(&self, option: &str) -> Result<()> {
        match self {
            Self { odometry: None, cloud: None } => Ok(()),
            _ => Err(BadInput::told(format!(
                "--odometry and --cloud name topics of a ROS bag: name the bag by {option}"
            ))),
        }
    }
}

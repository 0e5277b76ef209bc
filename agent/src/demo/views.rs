//! The views of one robot as they are read off Zenoh, and poses out of them.

use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance};
use merganser_protocol::snapshot::{
    FramesView, GraphView, MapView, PairView, PoseView, RelationView, StatsView, StatusView,
};
use nalgebra::SMatrix;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;

/// What must be one may differ from it by this: numbers travel as text.
const UNIT_SLACK: f64 = 1e-6;

/// What one robot showed at one moment.
#[derive(Clone, Debug, PartialEq)]
pub struct Views {
    /// Who and how.
    pub status: StatusView,
    /// Frames and pairs.
    pub frames: FramesView,
    /// Anchors.
    pub map: MapView,
    /// Alignments.
    pub graph: GraphView,
    /// Counters.
    pub stats: StatsView,
}

impl Views {
    /// From JSON documents by view name.
    ///
    /// # Errors
    /// The first view that is absent or of another shape.
    pub fn parse(documents: &BTreeMap<String, Vec<u8>>) -> Result<Self, String> {
        fn view<T: DeserializeOwned>(documents: &BTreeMap<String, Vec<u8>>, name: &str) -> Result<T, String> {
            let json = documents.get(name).ok_or_else(|| format!("view/{name} did not come"))?;
            serde_json::from_slice(json).map_err(|error| format!("view/{name} is of another shape: {error}"))
        }
        Ok(Self {
            status: view(documents, "status")?,
            frames: view(documents, "frames")?,
            map: view(documents, "map")?,
            graph: view(documents, "graph")?,
            stats: view(documents, "stats")?,
        })
    }

    /// The pair of these two frames and its `t_a_b`, whichever way round the robot states it.
    pub fn pair(&self, a: &str, b: &str) -> Option<(&PairView, Option<Relative>)> {
        let stated = |a: &str, b: &str| self.frames.pairs.iter().find(|pair| pair.a == a && pair.b == b);
        if let Some(pair) = stated(a, b) {
            return Some((pair, pair.t_a_b.as_ref().and_then(relative)));
        }
        let pair = stated(b, a)?;
        Some((pair, pair.t_a_b.as_ref().and_then(relative).map(|t| t.inverse())))
    }
}

/// A pose without its scale; `None` if a number is not finite or the quaternion is not of length one.
pub fn pose(view: &PoseView) -> Option<Se3> {
    let length = view.rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
    Se3::from_xyzw(view.rotation, view.translation).filter(|_| (length - 1.0).abs() <= UNIT_SLACK)
}

/// A rigid pose with its covariance; `None` for a similarity.
pub fn relation(view: &RelationView) -> Option<PoseWithCovariance> {
    match relative(view)? {
        Relative::Metric(t) => Some(t),
        Relative::Similarity(_) => None,
    }
}

/// A relation with its covariance: a similarity where the covariance is one of seven values. `None` if it is neither: a
/// pose that is none, a scale that is none or, of a rigid one, not 1, or a covariance that is not positive definite.
pub fn relative(view: &RelationView) -> Option<Relative> {
    let (pose, scale) = (pose(&view.pose)?, view.pose.scale);
    match view.covariance.len() {
        21 if (scale - 1.0).abs() <= UNIT_SLACK => {
            let covariance = Covariance::new(square::<6>(&view.covariance)).ok()?;
            Some(Relative::Metric(PoseWithCovariance { pose, covariance }))
        }
        28 if scale.is_finite() && scale > 0.0 => {
            let covariance = Covariance::new(square::<7>(&view.covariance)).ok()?;
            let sim = Sim3::new(pose.rotation, pose.translation, scale);
            Some(Relative::Similarity(SimWithCovariance { sim, covariance }))
        }
        _ => None,
    }
}

/// The symmetric matrix of a row-major upper triangle.
fn square<const N: usize>(triangle: &[f64]) -> SMatrix<f64, N, N> {
    let mut m = SMatrix::zeros();
    for ((row, column), value) in (0..N).flat_map(|r| (r..N).map(move |c| (r, c))).zip(triangle) {
        m[(row, column)] = *value;
        m[(column, row)] = *value;
    }
    m
}

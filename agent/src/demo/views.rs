//! The views of one robot as they are read off Zenoh, and poses out of them.

use merganser_protocol::geometry::Relative;
use merganser_protocol::snapshot::{FramesView, GraphView, MapView, PairView, PathView, StatsView, StatusView};
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;

pub use merganser_protocol::snapshot::{bodies, pose, relation, relative};

/// What one robot showed at one moment.
#[derive(Clone, Debug, PartialEq)]
pub struct Views {
    /// Who and how.
    pub status: StatusView,
    /// Frames and pairs.
    pub frames: FramesView,
    /// Anchors.
    pub map: MapView,
    /// Its keyframes.
    pub path: PathView,
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
            path: view(documents, "path")?,
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

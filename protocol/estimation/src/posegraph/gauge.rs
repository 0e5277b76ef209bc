//! Where a solved part lies: decides which pose says so. Measurements are relative, so that each connected part may lie
//! anywhere; its files say where by the value of the pose that they fix, or else of its first.

use super::PoseGraph;
use crate::geometry::Se3;
use std::collections::BTreeMap;

impl PoseGraph {
    /// Of the poses of one part, the smallest that is fixed, or else the smallest.
    pub fn origin<'a>(&self, part: impl IntoIterator<Item = &'a u64>) -> Option<u64> {
        part.into_iter().copied().min_by_key(|id| (!self.fixed.contains(id), *id))
    }

    /// Moves the poses of one part to where its origin has its value, or is the identity if it has none; the origin.
    pub fn place(&self, part: &mut BTreeMap<u64, Se3>) -> Option<u64> {
        let origin = self.origin(part.keys())?;
        let want = self.poses.get(&origin).copied().flatten().unwrap_or_else(Se3::identity);
        let at = *part.get(&origin)?;
        if at != want {
            let t_want_at = want * at.inverse();
            part.values_mut().for_each(|pose| *pose = t_want_at * *pose);
            part.insert(origin, want);
        }
        Some(origin)
    }
}

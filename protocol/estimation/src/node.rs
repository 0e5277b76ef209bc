//! The nodes and factors of the joint estimate: submaps' anchors and clouds, and what ties them.

use crate::graph::Key;
use crate::ids::{EntryId, FrameId, SubmapId};
use crate::position;
use crate::solve::ComponentError;
use core::cmp::Ordering;
use core::fmt;

/// A node of the joint estimate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Node {
    /// A submap's anchor.
    Anchor(SubmapId),
    /// Where a submap's cloud lies, as all its alignments see it ([`distortion`](crate::distortion)).
    Cloud(SubmapId),
}

/// Where a factor comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Label {
    /// The owner's own motion estimate.
    Odometry,
    /// Where a submap's cloud lies by its anchor, as all alignments see it.
    Cloud,
    /// An agreed alignment.
    Alignment(EntryId),
    /// A direct measurement of another robot.
    Sighting(EntryId),
    /// Where another robot was seen, completed to a pose ([`position`]).
    Position(EntryId),
}

impl Node {
    /// The submap that it belongs to.
    pub fn submap(self) -> SubmapId {
        match self {
            Self::Anchor(id) | Self::Cloud(id) => id,
        }
    }

    /// The submap of which it is the anchor.
    pub(super) fn anchor(self) -> Option<SubmapId> {
        match self {
            Self::Anchor(id) => Some(id),
            Self::Cloud(_) => None,
        }
    }
}

impl From<SubmapId> for Node {
    fn from(id: SubmapId) -> Self {
        Self::Anchor(id)
    }
}

/// By frame, the anchors before the clouds, so that the first anchor of the first frame is the one held fixed.
impl Ord for Node {
    fn cmp(&self, other: &Self) -> Ordering {
        let key = |node: &Self| (node.submap().frame, matches!(node, Self::Cloud(_)), node.submap().index);
        key(self).cmp(&key(other))
    }
}

impl PartialOrd for Node {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// As whoever measured it knows it: by its submap.
impl fmt::Display for Node {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "submap {}", self.submap())
    }
}

impl Key for Node {
    type Unit = FrameId;
    type Label = Label;

    fn unit(self) -> FrameId {
        self.submap().frame
    }

    /// A position says nothing of how what it saw is turned.
    fn rigid_dimension(label: Label) -> usize {
        if matches!(label, Label::Position(_)) { position::DIMENSION } else { 6 }
    }
}

/// Anchors by themselves, as the joint estimate knows them.
impl From<ComponentError<SubmapId>> for ComponentError<Node> {
    fn from(error: ComponentError<SubmapId>) -> Self {
        match error {
            ComponentError::UnderconstrainedNode(id) => Self::UnderconstrainedNode(id.into()),
            ComponentError::UnderconstrainedScale(frame) => Self::UnderconstrainedScale(frame),
            ComponentError::Solve(error) => Self::Solve(error),
        }
    }
}

impl Label {
    /// Whether the rest of the map may find it wrong.
    pub(super) fn is_doubted(self) -> bool {
        matches!(self, Self::Alignment(_) | Self::Sighting(_) | Self::Position(_))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_graphs::submap;

    #[test]
    fn nodes_ascend_by_frame_then_anchors_before_clouds() {
        let (anchor, cloud) = (Node::Anchor, Node::Cloud);
        let ascending = [
            anchor(submap(0, 0)),
            anchor(submap(0, 7)),
            cloud(submap(0, 0)),
            cloud(submap(0, 7)),
            anchor(submap(1, 0)),
        ];
        assert!(ascending.is_sorted_by(|x, y| x < y));
        assert_eq!(cloud(submap(0, 7)).to_string(), anchor(submap(0, 7)).to_string());
    }
}

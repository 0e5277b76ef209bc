//! The debug view of an agent: what it believes, with the names people gave, in plain numbers (see
//! [`crate::snapshot`]).

use super::Agent;
use super::alignment::Sources;
use super::estimation::{estimate_version, live_robots, pair_views, robot_view};
use super::replication::copies::{CopiedFrom, Copies};
use super::replication::knowledge::Agreement;
use crate::estimate::EdgeKind;
use crate::estimate::blame::Blame;
use crate::estimate::joint::Shortfall;
use crate::estimate::misfits::misfits;
use crate::estimate::solve::ComponentError;
use crate::geometry::Se3;
use crate::ids::{EntryId, FrameId, RobotId};
use crate::snapshot::{
    CondensedView, EdgeView, FailedView, FrameView, FramesView, GraphView, MapView, MiddleView, PairView, PathView,
    PoseView, PosesView, RelationView, Snapshot, StatsView, StatusView, SubmapView, SuspectView, TriesView,
};
use crate::time::Instant;
use crate::wire::fact::AlignmentFact;
use std::collections::{BTreeMap, BTreeSet};

impl Agent {
    /// Everything this agent believes at `now`.
    pub fn snapshot(&self, now: Instant) -> Snapshot {
        let path = self.mapping.path_view(self.context.frame_name(self.context.frame()));
        Snapshot { map: self.map_view(), path, ..self.overview(now) }
    }

    /// [`Agent::snapshot`] with an empty map and path: the map of a large swarm has tens of thousands of anchors.
    pub fn overview(&self, now: Instant) -> Snapshot {
        Snapshot {
            status: self.status(),
            frames: self.frames(),
            poses: self.poses_view(now),
            map: MapView { submaps: Vec::new() },
            path: PathView::default(),
            graph: self.graph_view(),
            stats: self.stats_view(),
        }
    }

    /// `view/status` alone: cheap enough to ask often.
    pub fn status(&self) -> StatusView {
        let pending = self.pending();
        let settled = self.estimation.is_settled(self.replication.digest());
        StatusView {
            swarm: self.context.me().swarm.to_string(),
            robot: self.context.me().name.to_string(),
            id: self.context.robot().to_string(),
            epoch: self.context.frame().epoch,
            neighbours: self.replication.neighbours().map(|robot| self.context.robot_name(robot)).collect(),
            entries: self.replication.held(),
            digest: self.replication.digest().to_string(),
            estimate: estimate_version::fingerprint(&self.context.config().estimate),
            submaps: self.alignment.own_submaps() as u64,
            keyframes: self.mapping.keyframes(),
            keyframes_lost: self.mapping.losses().keyframes(),
            gaps: self.mapping.losses().gaps(),
            remarks: self.mapping.remarks(),
            pending,
            unsaved: self.unsaved(),
            idle: pending == 0 && settled,
            merged_with: self.merged_with(),
            receive_only: self.replication.is_receive_only(&self.context),
        }
    }

    /// Work that this robot still has to do with the facts it holds.
    fn pending(&self) -> u64 {
        // A robot at its epoch limit writes no facts that others would accept, so verdicts and proposals do not count.
        let sources = Sources::of(&self.replication, &self.estimation);
        let owed = || self.alignment.answers_owed(&self.context, sources).len();
        let open = match self.replication.epoch_limit(&self.context) {
            Some(_) => 0,
            None => owed() + self.alignment.proposals(&self.context, sources),
        };
        self.unsaved() + (self.alignment.running() + open) as u64
    }

    /// Something is on its way to the disk, and the disk takes it: an end now would lose what a moment would save.
    pub fn is_saving(&self) -> bool {
        self.unsaved() > 0 && !self.replication.store_fails()
    }

    /// What a restart now would lose.
    fn unsaved(&self) -> u64 {
        (self.replication.waiting() + self.context.kept() + self.mapping.pending()) as u64
    }

    fn merged_with(&self) -> Vec<String> {
        let robots: BTreeSet<RobotId> =
            self.estimation.frames_merged_with(self.context.frame()).iter().map(|f| f.robot).collect();
        let mut names: Vec<String> =
            robots.into_iter().filter(|r| *r != self.context.robot()).map(|r| self.context.robot_name(r)).collect();
        names.sort();
        names
    }

    /// `view/frames` alone.
    pub fn frames(&self) -> FramesView {
        let mut submaps: BTreeMap<FrameId, u64> = BTreeMap::new();
        for (id, _) in self.replication.knowledge().submaps() {
            *submaps.entry(id.frame).or_default() += 1;
        }
        let (own, components) = (self.context.frame(), self.components());
        let frames = submaps
            .into_iter()
            .map(|(frame, submaps)| FrameView {
                frame: self.context.frame_name(frame),
                robot: self.context.robot_name(frame.robot),
                submaps,
                component: components.get(&frame).map_or(u64::MAX, |number| *number),
                t_own_frame: self.estimation.t_own_frame(own, frame).as_ref().map(RelationView::from),
            })
            .collect();
        FramesView {
            own: self.context.frame_name(own),
            frames,
            pairs: self.pair_views(),
            suspects: self.suspects(),
            tries: self.tries(),
        }
    }

    fn tries(&self) -> Vec<TriesView> {
        let all = self.alignment.tries().iter();
        all.map(|(own, other, outcomes)| TriesView {
            own: self.context.frame_name(own),
            other: self.context.frame_name(other),
            found: outcomes.found,
            refused: outcomes.refused.clone(),
        })
        .collect()
    }

    /// Numbers the components by their smallest frames; frames with one number are connected.
    fn components(&self) -> BTreeMap<FrameId, u64> {
        let alone = self.estimation.alone().keys().map(|frame| (*frame, *frame));
        let with: BTreeMap<FrameId, FrameId> =
            self.estimation.solved().frames.iter().map(|(frame, placed)| (*frame, placed.with)).chain(alone).collect();
        let smallest: BTreeSet<FrameId> = with.values().copied().collect();
        let numbers: BTreeMap<FrameId, u64> = smallest.into_iter().zip(0..).collect();
        with.into_iter().filter_map(|(frame, with)| Some((frame, *numbers.get(&with)?))).collect()
    }

    fn pair_views(&self) -> Vec<PairView> {
        let mut proposed: BTreeMap<(FrameId, FrameId), u64> = BTreeMap::new();
        for (_, fact) in self.replication.knowledge().alignments() {
            *proposed.entry((fact.i.frame, fact.j.frame)).or_default() += 1;
        }
        let pairs = self.estimation.solved().pairs.iter();
        pairs
            .map(|pair| PairView {
                a: self.context.frame_name(pair.a),
                b: self.context.frame_name(pair.b),
                status: pair.status,
                proposed: proposed.get(&(pair.a, pair.b)).copied().unwrap_or(0),
                agreed: pair.agreed as u64,
                used: pair.used as u64,
                log10_nfa: pair.log10_nfa,
                t_a_b: pair.t_a_b.as_ref().map(RelationView::from),
                middle: pair.middle.as_ref().map(|middle| MiddleView {
                    i: self.context.submap_name(middle.i),
                    j: self.context.submap_name(middle.j),
                    t_i_j: RelationView::from(&middle.t_i_j),
                }),
                reason: pair.blame.as_ref().map(|blame| self.why(blame)).unwrap_or_default(),
            })
            .collect()
    }

    fn why(&self, blame: &Blame) -> String {
        let names: Vec<String> = blame.robots.iter().map(|robot| self.context.robot_name(*robot)).collect();
        let names = names.join(", ");
        if blame.certain {
            format!("what {names} states contradicts what others measured of one another")
        } else {
            format!("pairs around a loop contradict one another, and at least one of {names} is wrong")
        }
    }

    /// Robots that may be wrong: as pairs that contradict one another tell, and clouds that others stated before.
    fn suspects(&self) -> Vec<SuspectView> {
        let blames: BTreeSet<&Blame> =
            self.estimation.solved().pairs.iter().filter_map(|pair| pair.blame.as_ref()).collect();
        let contradicts = blames.into_iter().flat_map(|blame| {
            let view = |robot: &RobotId| SuspectView {
                robot: self.context.robot_name(*robot),
                reason: self.why(blame),
                certain: blame.certain,
            };
            blame.robots.iter().map(view).collect::<Vec<_>>()
        });
        let copies = self.replication.knowledge().copied().map(|(CopiedFrom { by, of }, count)| SuspectView {
            robot: self.context.robot_name(by),
            reason: format!(
                "{count} of its submaps show what {} stated before as its own; nothing is aligned with them",
                self.context.robot_name(of)
            ),
            certain: of == self.context.robot(),
        });
        let odd = misfits(&self.estimation.solved().pairs).into_iter().map(|(robot, others)| SuspectView {
            robot: self.context.robot_name(robot),
            reason: format!(
                "its alignments with {others} others, who agree among themselves, contradict one another: its odometry \
                 is wrong, or less certain than it says"
            ),
            certain: false,
        });
        contradicts.chain(copies).chain(odd).collect()
    }

    fn poses_view(&self, now: Instant) -> PosesView {
        let live = live_robots(&self.context, self.mapping.body(), self.replication.beacons(), now);
        // This robot stands first, if it is among them.
        let t_odom_body = |k: usize| self.mapping.t_odom_body().filter(|_| k == 0 && self.mapping.body().is_some());
        let view = |(k, one)| robot_view(&self.context, &self.estimation, one, t_odom_body(k));
        let robots = live.iter().enumerate().map(view).collect();
        PosesView { robots, pairs: pair_views(&self.context, &self.estimation, &live) }
    }

    fn map_view(&self) -> MapView {
        let own = self.context.frame();
        let mut submaps = Vec::new();
        let mut t_frame_anchor = Se3::identity();
        let mut frame = None;
        for (id, fact) in self.replication.knowledge().submaps() {
            if frame.replace(id.frame) != Some(id.frame) {
                t_frame_anchor = Se3::identity();
            }
            t_frame_anchor = t_frame_anchor * fact.t_prev_this;
            submaps.push(SubmapView {
                frame: self.context.frame_name(id.frame),
                robot: self.context.robot_name(id.frame.robot),
                index: id.index,
                stamps_secs: fact.stamps.map(crate::time::Stamp::as_secs_f64),
                t_frame_anchor: PoseView::from(&t_frame_anchor),
                t_own_anchor: self.estimation.t_own_anchor(own, id).map(RelationView::from),
            });
        }
        MapView { submaps }
    }

    fn graph_view(&self) -> GraphView {
        let solved = self.estimation.solved();
        let mut edges = Vec::new();
        let mut listed = BTreeSet::new();
        for edge in &solved.edges {
            let measurement = &edge.measurement;
            listed.insert(measurement.entry);
            edges.push(EdgeView {
                kind: match edge.kind {
                    EdgeKind::Alignment => "alignment",
                    EdgeKind::Sighting => "sighting",
                    EdgeKind::Position => "position",
                }
                .to_string(),
                i: self.context.submap_name(measurement.i),
                j: self.context.submap_name(measurement.j),
                t_i_j: RelationView::from(&measurement.t_i_j),
                agreed: true,
                weight: edge.weight,
                reason: edge.reason(),
                contradicts: edge.unused.is_some_and(|unused| unused.contradicts()),
            });
        }
        edges.extend(self.unused_edges(&listed));
        let failed = |(frames, why): &(Vec<FrameId>, Shortfall)| FailedView {
            frames: frames.iter().map(|frame| self.context.frame_name(*frame)).collect(),
            reason: self.shortfall(why),
        };
        let nodes = solved.nodes + self.estimation.alone().values().sum::<usize>();
        GraphView {
            nodes: nodes as u64,
            chi2: solved.chi2,
            dof: solved.dof as u64,
            optimality: solved.optimality,
            converged: solved.converged,
            failed: solved.failed.iter().map(failed).collect(),
            edges,
        }
    }

    /// What a component falls short of, in the names that the views have.
    fn shortfall(&self, why: &Shortfall) -> String {
        let text = why.to_string();
        match why {
            Shortfall::Unsolved(ComponentError::UnderconstrainedNode(node)) => {
                let id = node.submap();
                text.replace(&id.to_string(), &self.context.submap_name(id))
            }
            Shortfall::Unsolved(ComponentError::UnderconstrainedScale(frame)) => {
                text.replace(&frame.to_string(), &self.context.frame_name(*frame))
            }
            _ => text,
        }
    }

    /// Alignments that did not enter the estimate, with the reason.
    fn unused_edges(&self, listed: &BTreeSet<EntryId>) -> Vec<EdgeView> {
        let unused = self.replication.knowledge().alignments().filter(|(id, _)| !listed.contains(id));
        let copies = self.replication.knowledge().copies();
        unused
            .map(|(id, fact)| {
                let agreement = self.replication.knowledge().agreement(id);
                EdgeView {
                    kind: "alignment".to_string(),
                    i: self.context.submap_name(fact.i),
                    j: self.context.submap_name(fact.j),
                    t_i_j: RelationView::from(&fact.t_i_j),
                    agreed: agreement == Agreement::Agreed,
                    weight: 0.0,
                    reason: self.reason_outside(id, fact, agreement, &copies),
                    contradicts: false,
                }
            })
            .collect()
    }

    /// Why an alignment is not among those that the estimate was made of.
    fn reason_outside(&self, id: EntryId, fact: &AlignmentFact, agreement: Agreement, copies: &Copies) -> String {
        let is_of_present_facts = self.estimation.is_of(self.replication.digest());
        if self.replication.knowledge().is_of_copy(copies, (fact.i, fact.j)) {
            return "one of the two robots states as its own what the other's submap shows".to_string();
        }
        match (agreement, self.replication.knowledge().counted((fact.i, fact.j))) {
            (Agreement::Waiting, _) => "the other endpoint has not answered".to_string(),
            (Agreement::Disputed, _) => "the other endpoint does not agree".to_string(),
            (Agreement::Agreed, Some(first)) if first != id => {
                format!("another alignment of the same two submaps counts: {first}")
            }
            (Agreement::Agreed, _) if is_of_present_facts => {
                "the odometry to one of its submaps is not known without a gap".to_string()
            }
            (Agreement::Agreed, _) => "newer than the estimate".to_string(),
        }
    }

    fn stats_view(&self) -> StatsView {
        let stats = self.context.stats();
        let bytes = |table: &BTreeMap<&'static str, (u64, u64)>| {
            table.iter().map(|(kind, (bytes, _))| ((*kind).to_string(), *bytes)).collect()
        };
        let messages = |table: &BTreeMap<&'static str, (u64, u64)>| {
            table.iter().map(|(kind, (_, messages))| ((*kind).to_string(), *messages)).collect()
        };
        let counts = |table: &BTreeMap<&'static str, u64>| {
            table.iter().map(|(kind, count)| ((*kind).to_string(), *count)).collect()
        };
        let peer_name =
            |peer: &Option<RobotId>| peer.map_or_else(|| "unknown".to_string(), |p| self.context.robot_name(p));
        StatsView {
            sent_bytes: bytes(&stats.sent),
            sent_messages: messages(&stats.sent),
            received_bytes: bytes(&stats.received),
            received_messages: messages(&stats.received),
            rejected: counts(&stats.rejected),
            rejected_by_peer: stats.rejected_by_peer.iter().map(|(peer, row)| (peer_name(peer), *row)).collect(),
            work: counts(&stats.work),
            held_back: counts(&stats.held_back),
            condensed_bytes: CondensedView { before: stats.condensed_bytes[0], after: stats.condensed_bytes[1] },
        }
    }
}

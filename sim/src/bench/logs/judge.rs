//! What a play was worth, by the truth.

use super::track::{Anchor, Track};
use crate::wires::{Statement, Wires};
use merganser_protocol::geometry::{PoseWithCovariance, Se3, chi2};
use merganser_protocol::kinds::PairStatus;
use merganser_protocol::snapshot::{EdgeView, PairView, Snapshot, pose, relation};
use merganser_protocol::time::Instant;
use nalgebra::{DMatrix, DVector, Vector6};
use std::collections::{BTreeMap, BTreeSet};

/// A relation is wrong if it is farther off than this, m and °.
pub const FALSE: (f64, f64) = (1.0, 8.0);
/// Robots drive the same way where their bodies come as near as this, m.
const COMMON_M: f64 = 2.0;
/// Robots with so much common way, m, should merge; of shorter drives half.
const COMMON_WAY_M: f64 = 10.0;
/// Standard deviations of a relation of two true poses, m and rad: published poses and relations close loops to 2 to
/// 7 cm, landmarks place a submap no better.
pub const TRUTH: (f64, f64) = (0.05, 0.01);
/// A normalised error says something of a covariance only where the truth is sharp: of anchors no more doubtful than
/// this, m and rad.
const SHARP: f64 = 0.05;

/// Two robots.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PairFate {
    /// From the beginning until they had driven enough of a common way, s; `None` if they never had.
    pub overlap_secs: Option<f64>,
    /// Until the first of them called the pair merged, s.
    pub merged_secs: Option<f64>,
    /// Merged at the end, by both, directly or through others.
    pub merged: bool,
    /// A robot called it merged and later did not.
    pub fell_apart: usize,
    /// How long a robot stated a relation that was wrong, s: off by more than [`FALSE`] allows in m, or by more than
    /// its claimed 99.9 %.
    pub wrong_secs: f64,
    /// Statements that were wrong.
    pub wrong: usize,
    /// The farthest off of all statements, m...
    pub worst_m: f64,
    /// ...and °.
    pub worst_deg: f64,
    /// The most over what is claimed: squared normalised error over its quantile at 99.9 %.
    pub worst_claim: f64,
    /// What the first robot calls it at the end; `None` if it knows of no alignment.
    pub status: Option<PairStatus>,
}

/// Errors of relations, m and °.
pub type Errors = Vec<(f64, f64)>;

/// What is measured of one play.
#[derive(Clone, Debug, Default)]
pub struct Judged {
    /// Alignments stated, agreed and used in the estimate of the first robot.
    pub alignments: [usize; 3],
    /// Of those agreed and those used, how many are false.
    pub falsely: [usize; 2],
    /// Of the false ones that are used, how many are farther off than the 99.9 % that they claim. The others say of
    /// themselves that they are vague.
    pub beyond_claim: usize,
    /// Of those used, how many tie an anchor whose truth is not known.
    pub used_unjudged: usize,
    /// The false ones in words.
    pub false_ones: Vec<String>,
    /// Every two robots.
    pub pairs: BTreeMap<(usize, usize), PairFate>,
    /// Statements whose truth is not known.
    pub unjudged: usize,
    /// Relations of one robot's own body...
    pub within: Errors,
    /// ...and of two robots'.
    pub between: Errors,
    /// Normalised squared errors per degree of freedom of what was stated of pairs at the end.
    pub nees_pairs: Vec<f64>,
    /// And of anchors in the first robot's frame.
    pub nees_anchors: Vec<f64>,
    /// Payload sent by all.
    pub bytes: u64,
}

/// How two anchors truly lie.
struct Truth {
    /// `t_i_j`.
    pose: Se3,
    /// Variances of what is not known of either anchor, m² and rad², beside those of all truth.
    doubt: (f64, f64),
}

impl Truth {
    /// What is not known of the first anchor's heading moves the second by as much times their distance.
    fn between(i: &Anchor, j: &Anchor) -> Self {
        let pose = i.t_world_anchor.inverse() * j.t_world_anchor;
        let (of_i, of_j) = (i.doubt * i.doubt, j.doubt * j.doubt);
        Self { doubt: (of_i * (1.0 + pose.translation.norm_squared()) + of_j, of_i + of_j), pose }
    }
}

/// Judges a play.
pub struct Judge<'a> {
    /// The robots.
    pub tracks: &'a [Track],
    /// They move in a plane.
    pub planar: bool,
    /// How uncertain the truth is: standard deviations of a relation, m and rad.
    pub truth: (f64, f64),
}

/// How far two poses are apart, m and °.
pub fn off(a: &Se3, b: &Se3) -> (f64, f64) {
    let between = a.inverse() * *b;
    (between.translation.norm(), between.rotation.angle().to_degrees())
}

impl Judge<'_> {
    /// All but the errors of relations.
    pub fn judge(&self, wires: &Wires) -> (Judged, Vec<Snapshot>) {
        let views: Vec<Snapshot> = wires.agents.iter().map(|agent| agent.snapshot(wires.now)).collect();
        let mut judged = Judged { pairs: self.overlaps(), ..Judged::default() };
        self.statements(&wires.statements, wires.now, &mut judged);
        if let Some(view) = views.first() {
            self.alignments(&view.graph.edges, &mut judged);
            for pair in &view.frames.pairs {
                let (Some(a), Some(b)) = (self.robot(&pair.a), self.robot(&pair.b)) else { continue };
                judged.pairs.entry((a.min(b), a.max(b))).or_default().status = Some(pair.status);
            }
            self.nees(view, &mut judged);
        }
        judged.bytes = views.iter().flat_map(|view| view.stats.sent_bytes.values()).sum();
        (judged, views)
    }

    fn robot(&self, frame: &str) -> Option<usize> {
        let name = frame.split('/').next()?;
        self.tracks.iter().position(|track| track.robot == name)
    }

    /// Where an anchor truly is, `name/epoch#index`.
    fn anchor(&self, name: &str) -> Option<(usize, Anchor)> {
        let (frame, index) = name.rsplit_once('#')?;
        let robot = self.robot(frame)?;
        Some((robot, *self.tracks[robot].anchors.get(&index.parse().ok()?)?))
    }

    /// When each two robots had driven enough of a common way.
    fn overlaps(&self) -> BTreeMap<(usize, usize), PairFate> {
        let all = self.tracks.len();
        let pairs = (0..all).flat_map(|a| (a + 1..all).map(move |b| (a, b)));
        pairs.map(|(a, b)| ((a, b), PairFate { overlap_secs: self.overlap(a, b), ..PairFate::default() })).collect()
    }

    fn overlap(&self, a: usize, b: usize) -> Option<f64> {
        let (a, b) = (&self.tracks[a], &self.tracks[b]);
        let needed = COMMON_WAY_M.min(0.5 * length(a).min(length(b)));
        // Each step of the one that the other has driven, too, once both have.
        let mut steps: Vec<(f64, f64)> = Vec::new();
        for k in 1..a.truth.len() {
            let (Some(before), Some(here)) = (a.truth[k - 1], a.truth[k]) else { continue };
            let near = |other: &Option<Se3>| {
                other.is_some_and(|other| (other.translation - here.translation).norm() <= COMMON_M)
            };
            if let Some(first) = b.truth.iter().position(near) {
                let step = (here.translation - before.translation).norm();
                steps.push((a.seconds[k].max(b.seconds[first]), step));
            }
        }
        steps.sort_by(|x, y| x.0.total_cmp(&y.0));
        let mut way = 0.0;
        steps
            .iter()
            .find(|(_, step)| {
                way += step;
                way >= needed
            })
            .map(|(secs, _)| *secs)
    }

    /// Every statement of a merge, for as long as it stood.
    fn statements(&self, all: &[Statement], end: Instant, judged: &mut Judged) {
        for robot in 0..self.tracks.len() {
            let own: Vec<_> = all.iter().filter(|statement| statement.robot == robot).collect();
            let mut before: BTreeSet<(usize, usize)> = BTreeSet::new();
            for (k, statement) in own.iter().enumerate() {
                let until = own.get(k + 1).map_or(end, |next| next.at);
                let named = |pair: &PairView| Some((self.robot(&pair.a)?, self.robot(&pair.b)?));
                let now = together(self.tracks.len(), statement.pairs.iter().filter_map(named));
                let secs = statement.at.since(Instant::ZERO).as_secs_f64();
                for fate in judged.pairs.iter_mut().filter(|(key, _)| now.contains(key)).map(|(_, fate)| fate) {
                    fate.merged_secs = Some(fate.merged_secs.map_or(secs, |first| first.min(secs)));
                }
                for pair in &statement.pairs {
                    let Some((a, b)) = named(pair) else { continue };
                    let key = (a.min(b), a.max(b));
                    let Some(fate) = judged.pairs.get_mut(&key) else { continue };
                    let ends = pair.middle.as_ref().and_then(|middle| {
                        let (_, i) = self.anchor(&middle.i)?;
                        let (_, j) = self.anchor(&middle.j)?;
                        Some((relation(&middle.t_i_j)?, Truth::between(&i, &j)))
                    });
                    let Some((stated, truth)) = ends else {
                        judged.unjudged += 1;
                        continue;
                    };
                    let (metres, degrees) = off(&stated.pose, &truth.pose);
                    let (d2, dof) = self.distance_squared(&stated, &truth);
                    fate.worst_m = fate.worst_m.max(metres);
                    fate.worst_deg = fate.worst_deg.max(degrees);
                    fate.worst_claim = fate.worst_claim.max(d2 / chi2::P999[dof - 1]);
                    if metres > FALSE.0 || d2 > chi2::P999[dof - 1] {
                        fate.wrong += 1;
                        fate.wrong_secs += until.since(statement.at).as_secs_f64();
                    }
                }
                for key in before.difference(&now) {
                    judged.pairs.entry(*key).or_default().fell_apart += 1;
                }
                before = now;
            }
            for (key, fate) in judged.pairs.iter_mut().filter(|((a, b), _)| *a == robot || *b == robot) {
                // Both have to say so: the first sets it, the second may take it back.
                fate.merged = before.contains(key) && (robot == key.0 || fate.merged);
            }
        }
    }

    fn alignments(&self, edges: &[EdgeView], judged: &mut Judged) {
        let error = |edge: &EdgeView| {
            let ((_, i), (_, j)) = (self.anchor(&edge.i)?, self.anchor(&edge.j)?);
            let truth = Truth::between(&i, &j);
            // What makes no claim in metres has nothing to be vague by.
            let excess = relation(&edge.t_i_j).map_or(f64::INFINITY, |stated| {
                let (d2, dof) = self.distance_squared(&stated, &truth);
                d2 / chi2::P999[dof - 1]
            });
            Some((off(&pose(&edge.t_i_j.pose)?, &truth.pose), excess))
        };
        for edge in edges.iter().filter(|edge| edge.kind == "alignment") {
            let (agreed, used) = (usize::from(edge.agreed), usize::from(edge.weight > 0.0));
            judged.alignments[0] += 1;
            judged.alignments[1] += agreed;
            judged.alignments[2] += used;
            let Some(((metres, degrees), excess)) = error(edge) else {
                judged.used_unjudged += used;
                continue;
            };
            if metres <= FALSE.0 && degrees <= FALSE.1 {
                continue;
            }
            judged.falsely[0] += agreed;
            judged.falsely[1] += used;
            judged.beyond_claim += used * usize::from(excess > 1.0);
            if edge.agreed {
                let fate = if edge.weight > 0.0 { "used" } else { &edge.reason };
                let of_claim = format!("{excess:.2} of the claimed 99.9 %");
                let off = format!("{metres:.2} m, {degrees:.1} deg off, {of_claim}");
                judged.false_ones.push(format!("{} {}: {off}; {fate}", edge.i, edge.j));
            }
        }
    }

    fn nees(&self, view: &Snapshot, judged: &mut Judged) {
        let sharp = |name: &str| self.anchor(name).map(|(_, anchor)| anchor).filter(|anchor| anchor.doubt <= SHARP);
        for middle in view.frames.pairs.iter().filter_map(|pair| pair.middle.as_ref()) {
            let ends = (sharp(&middle.i), sharp(&middle.j), relation(&middle.t_i_j));
            let (Some(i), Some(j), Some(stated)) = ends else { continue };
            let (d2, dof) = self.distance_squared(&stated, &Truth::between(&i, &j));
            judged.nees_pairs.push(d2 / dof as f64);
        }
        let origin = view.map.submaps.iter().find_map(|submap| {
            let is_first = submap.frame == view.frames.own && submap.index == 0;
            let Anchor { t_world_anchor, doubt } = sharp(&format!("{}#0", submap.frame)).filter(|_| is_first)?;
            Some(Anchor { t_world_anchor: t_world_anchor * pose(&submap.t_frame_anchor)?.inverse(), doubt })
        });
        let Some(own) = origin else { return };
        for submap in &view.map.submaps {
            let Some(anchor) = sharp(&format!("{}#{}", submap.frame, submap.index)) else { continue };
            let Some(stated) = submap.t_own_anchor.as_ref().and_then(relation) else { continue };
            // The first is where it is by definition.
            if submap.frame != view.frames.own || submap.index > 0 {
                let (d2, dof) = self.distance_squared(&stated, &Truth::between(&own, &anchor));
                judged.nees_anchors.push(d2 / dof as f64);
            }
        }
    }

    /// Squared Mahalanobis distance of what is stated from the truth, and its degrees of freedom: three in the plane.
    fn distance_squared(&self, stated: &PoseWithCovariance, truth: &Truth) -> (f64, usize) {
        let error: Vector6<f64> = stated.pose.local(&truth.pose);
        let rows: &[usize] = if self.planar { &[0, 1, 5] } else { &[0, 1, 2, 3, 4, 5] };
        let (metres, turn) = self.truth;
        let of_truth = |k: usize| if k < 3 { metres * metres + truth.doubt.0 } else { turn * turn + truth.doubt.1 };
        let covariance = DMatrix::from_fn(rows.len(), rows.len(), |r, c| {
            let own = if r == c { of_truth(rows[r]) } else { 0.0 };
            stated.covariance.matrix()[(rows[r], rows[c])] + own
        });
        let error = DVector::from_iterator(rows.len(), rows.iter().map(|&r| error[r]));
        let d2 = covariance.cholesky().map_or(f64::INFINITY, |l| l.solve(&error).dot(&error));
        (d2, rows.len())
    }
}

/// Every two of so many robots that pairs tie together, directly or through others.
fn together(robots: usize, pairs: impl Iterator<Item = (usize, usize)>) -> BTreeSet<(usize, usize)> {
    let mut group: Vec<usize> = (0..robots).collect();
    for (a, b) in pairs {
        let (from, to) = (group[a], group[b]);
        group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
    }
    let all = (0..robots).flat_map(|a| (a + 1..robots).map(move |b| (a, b)));
    all.filter(|(a, b)| group[*a] == group[*b]).collect()
}

fn length(track: &Track) -> f64 {
    let steps = track.raw.windows(2);
    steps.map(|two| (two[1].translation - two[0].translation).norm()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::time::Duration;
    use merganser_protocol::geometry::{Covariance, Relative, So3};
    use merganser_protocol::snapshot::{MiddleView, RelationView};
    use nalgebra::Vector3;

    fn along(x: f64) -> Se3 {
        Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0))
    }

    /// Two robots on one straight way of 30 m, the second 10 m and as many seconds behind; an anchor each at its middle.
    fn tracks() -> Vec<Track> {
        let track = |robot: &str, offset: f64| {
            let at = |k: u32| along(f64::from(k) - offset);
            Track {
                robot: robot.into(),
                stamps: Vec::new(),
                seconds: (0..30).map(f64::from).collect(),
                raw: (0..30).map(at).collect(),
                within: Vec::new(),
                truth: (0..30).map(|k| Some(at(k))).collect(),
                anchors: BTreeMap::from([(0, Anchor { t_world_anchor: at(15), doubt: 0.0 })]),
            }
        };
        vec![track("a", 0.0), track("b", 10.0)]
    }

    fn said(secs: u64, robot: usize, off: Option<f64>) -> Statement {
        let truth = along(-10.0);
        let stated = |off: f64| {
            let pose = truth * along(off);
            let covariance = Covariance::from_sigmas([0.1; 6]).unwrap();
            RelationView::from(&Relative::Metric(PoseWithCovariance { pose, covariance }))
        };
        let pair = |off: f64| PairView {
            a: "a/0".into(),
            b: "b/0".into(),
            status: PairStatus::Merged,
            proposed: 3,
            agreed: 3,
            used: 3,
            log10_nfa: None,
            t_a_b: None,
            middle: Some(MiddleView { i: "a/0#0".into(), j: "b/0#0".into(), t_i_j: stated(off) }),
            reason: String::new(),
        };
        Statement {
            at: Instant::ZERO.after(Duration::from_secs(secs)),
            robot,
            pairs: off.map(pair).into_iter().collect(),
        }
    }

    fn fate(statements: &[Statement]) -> PairFate {
        let tracks = tracks();
        let judge = Judge { tracks: &tracks, planar: true, truth: TRUTH };
        let mut judged = Judged { pairs: judge.overlaps(), ..Judged::default() };
        judge.statements(statements, Instant::ZERO.after(Duration::from_secs(100)), &mut judged);
        judged.pairs.remove(&(0, 1)).unwrap()
    }

    #[test]
    fn what_is_right_all_the_while_is_good() {
        let fate = fate(&[said(20, 0, Some(0.05)), said(30, 1, Some(0.05)), said(40, 0, Some(0.0))]);
        assert!(fate.merged && fate.wrong == 0 && fate.fell_apart == 0, "{fate:?}");
        // The second is 10 s behind, and near from 2 m on.
        assert_eq!((fate.overlap_secs, fate.merged_secs), (Some(18.0), Some(20.0)));
    }

    #[test]
    fn robots_are_together_through_others_too() {
        let pairs = |ties: &[(usize, usize)]| together(4, ties.iter().copied()).into_iter().collect::<Vec<_>>();
        assert_eq!(pairs(&[(2, 0), (3, 2)]), [(0, 2), (0, 3), (2, 3)]);
        assert_eq!(pairs(&[]), []);
    }

    #[test]
    fn a_wrong_statement_counts_for_as_long_as_it_stands() {
        // 2 m off for 10 s, then 0.9 m, which is within 1 m but eight of its standard deviations.
        let fate =
            fate(&[said(20, 0, Some(2.0)), said(30, 0, Some(0.9)), said(35, 0, Some(0.0)), said(40, 1, Some(0.0))]);
        assert_eq!((fate.wrong, fate.wrong_secs, fate.merged), (2, 15.0, true));
        assert!((fate.worst_m - 2.0).abs() < 1e-9);
    }

    #[test]
    fn both_have_to_say_so_at_the_end_and_a_merge_that_is_taken_back_is_told() {
        assert!(!fate(&[said(20, 0, Some(0.0))]).merged && !fate(&[said(20, 1, Some(0.0))]).merged);
        let fate = fate(&[said(20, 0, Some(0.0)), said(20, 1, Some(0.0)), said(50, 1, None)]);
        assert!(!fate.merged && fate.fell_apart == 1);
    }

    /// What ties an anchor without truth is neither right nor false.
    #[test]
    fn a_false_alignment_is_told_from_one_that_nobody_can_judge() {
        let (tracks, mut judged) = (tracks(), Judged::default());
        let edge = |j: &str, off: f64, sigma: f64| {
            let covariance = Covariance::from_sigmas([sigma; 6]).unwrap();
            let t_i_j = Relative::Metric(PoseWithCovariance { pose: along(off - 10.0), covariance });
            EdgeView {
                kind: "alignment".into(),
                i: "a/0#0".into(),
                j: j.into(),
                t_i_j: RelationView::from(&t_i_j),
                agreed: true,
                weight: 1.0,
                reason: String::new(),
                contradicts: false,
            }
        };
        let judge = Judge { tracks: &tracks, planar: true, truth: TRUTH };
        let edges =
            [edge("b/0#0", 0.0, 0.1), edge("b/0#0", 1.1, 0.1), edge("b/0#0", 1.2, 1.0), edge("b/0#7", 9.0, 0.1)];
        judge.alignments(&edges, &mut judged);
        assert_eq!((judged.alignments, judged.falsely, judged.used_unjudged), ([4, 4, 4], [2, 2], 1));
        assert_eq!(judged.beyond_claim, 1, "one of the false says of itself that it is vague");
        let [one, vague] = judged.false_ones.as_slice() else { panic!("{:?}", judged.false_ones) };
        assert!(one.contains("1.10 m") && vague.contains("1.20 m"), "{one}; {vague}");
    }

    /// The truth of an anchor is as doubtful as it is said to be, and no more: 10 m away, 0.02 rad are 0.2 m.
    #[test]
    fn what_is_not_known_of_an_anchor_is_not_held_against_a_map() {
        let mut tracks = tracks();
        let judge = |tracks: &[Track]| {
            let judge = Judge { tracks, planar: true, truth: TRUTH };
            let mut judged = Judged { pairs: judge.overlaps(), ..Judged::default() };
            judge.statements(&[said(20, 0, Some(0.6))], Instant::ZERO.after(Duration::from_secs(60)), &mut judged);
            judged.pairs[&(0, 1)].wrong
        };
        assert_eq!(judge(&tracks), 1);
        tracks[1].anchors.get_mut(&0).unwrap().doubt = 0.05;
        assert_eq!(judge(&tracks), 1, "five standard deviations are left");
        tracks[1].anchors.get_mut(&0).unwrap().doubt = 0.2;
        assert_eq!(judge(&tracks), 0);
        tracks[1].anchors.get_mut(&0).unwrap().doubt = 0.02;
        assert_eq!(judge(&tracks), 1);
        tracks[0].anchors.get_mut(&0).unwrap().doubt = 0.02;
        assert_eq!(judge(&tracks), 0);
    }
}

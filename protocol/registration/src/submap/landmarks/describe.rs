//! Turns a submap of landmarks into what others and its owner need of it: see [`describe`](super::super::describe()).

use super::super::Submap;
use super::super::describe::Described;
use super::super::features::{Features, KEYPOINT_LEN, KEYPOINTS_MAX, Keypoints, VIEWPOINTS_MAX};
use super::super::summary::{Summary, WORDS};
use super::super::thinning::hash_of;
use super::{Codec, DESCRIPTOR_LEN, Descriptor, Landmark};
use crate::config::SubmapConfig;

/// Words that a label counts for: two labels rarely share more than one.
const WORDS_PER_LABEL: i32 = 3;
/// Groups of levels in a summary, each told by three bits of a descriptor.
const GROUPS: usize = 16;
/// Levels of each.
const LEVELS: usize = WORDS / GROUPS;

/// Features, keypoints and summary of a submap of landmarks. As many of those seen most often become keypoints as fit
/// into the bytes that `config.keypoints` points of surfaces take.
pub fn describe(submap: &Submap, config: &SubmapConfig) -> Described {
    let landmarks = &submap.constellation.landmarks;
    let extent = [0, 1, 2].map(|axis| landmarks.iter().fold(0.0, |most: f32, l| most.max(l.at[axis].abs() as f32)));
    let chart = Codec::new(config.voxel_m, &submap.constellation);
    let within = |chart: &Codec, keypoints: usize| chart.within(KEYPOINT_LEN * keypoints.min(KEYPOINTS_MAX));
    let first = within(&chart, config.keypoints);
    let further = Some(within(&chart.after(first.len()), config.keypoints_further)).filter(|further| further.len() > 0);
    let further = further.map(Keypoints::of_landmarks);
    let keypoints = Keypoints::of_landmarks(first).before(further.as_ref());
    let viewpoints = submap.keyframes.iter().take(VIEWPOINTS_MAX);
    let viewpoints = viewpoints.map(|t| t.translation.map(|x| x as f32).into()).collect();
    let features = Features::of_landmarks(chart, viewpoints);
    let summary = Summary::of_landmarks(config.voxel_m, &shares(landmarks));
    Described { features, keypoints, further, summary, extent }
}

/// Which labels were seen, and how descriptors are spread: blind to where the submap lies, how it is turned and scaled.
pub(super) fn shares(landmarks: &[Landmark]) -> [f32; WORDS] {
    let mut shares = [0.0; WORDS];
    for landmark in landmarks {
        if let Some(label) = landmark.mark.label {
            for turn in 0..WORDS_PER_LABEL {
                shares[(hash_of(&[label as i32, turn, 0]) % WORDS as u64) as usize] += 1.0;
            }
        } else if let Some(descriptor) = &landmark.mark.descriptor {
            (0..GROUPS).for_each(|group| shares[group * LEVELS + level(descriptor, group)] += 1.0);
        }
    }
    shares
}

/// The level that three bits, far apart, of the descriptor say.
fn level(descriptor: &Descriptor, group: usize) -> usize {
    let bit = |k: usize| usize::from(descriptor[k % DESCRIPTOR_LEN] >> (k / DESCRIPTOR_LEN % 8) & 1);
    let first = 5 * group + 1;
    bit(first) + 2 * bit(first + 83) + 4 * bit(first + 171)
}

//! Submaps from end to end: keyframes in, alignments with honest covariances out, on real and on ray-cast data. Prints
//! its measurements (`--nocapture`).

mod data;
mod measure;
mod world;

use measure::Score;

#[test]
fn calib() {
    let Some(data) = data::shared() else { return };
    let sets = [
        data::seven_scenes(&data),
        data::kitti07(&data),
        world::World::hall(1).set("hall", 6, [5.0, 3.0], 0.005, 2),
        world::World::hall(5).set("hall5", 6, [5.0, 3.0], 0.005, 2),
        world::World::hall(7).set("hall-clean", 6, [5.0, 3.0], 0.0, 2),
    ];
    for set in sets {
        for n in [128, 268, 384, 512] {
            println!("{}", Score::of(&set, n).line(set.name, n));
        }
    }
}
#[test]
fn corridor() {
    use merganser_protocol::submap::{RefineConfig, refine};
    let set = world::World::corridor().set("corridor", 4, [1.0, 0.5], 0.002, 3);
    for (a, b, truth) in measure::pairs(&set) {
        println!(
            "{:?}",
            refine(&a.described.keypoints, &b.described.features, &truth, &RefineConfig::default())
                .map(|r| (r.pose.covariance.sigmas().transpose(), r.pose.pose.local(&truth).transpose()))
        );
    }
}
#[test]
fn similar() {
    let Some(data) = data::shared() else { return };
    let auc = |yes: &[f64], no: &[f64]| {
        yes.iter().flat_map(|y| no.iter().map(move |n| f64::from(u8::from(y > n)))).sum::<f64>()
            / (yes.len() * no.len()) as f64
    };
    for set in
        [data::seven_scenes(&data), data::kitti07(&data), world::World::hall(1).set("hall", 8, [5.0, 3.0], 0.005, 2)]
    {
        let (mut yes, mut no) = (vec![], vec![]);
        for (a, b, t) in measure::pairs(&set) {
            let s = a.described.summary.similarity(&b.described.summary);
            if measure::overlap(a, b, &t) >= 0.25 { yes.push(s) } else { no.push(s) }
        }
        if set.name == "kitti07" {
            for a in data::kitti00(&data) {
                for b in &set.places {
                    no.push(a.described.summary.similarity(&b.described.summary));
                }
            }
        }
        if set.name == "hall" {
            for k in 2..5 {
                for a in world::World::hall(k).set("h", 3, [5.0, 3.0], 0.005, 2).places {
                    for b in &set.places {
                        no.push(a.described.summary.similarity(&b.described.summary));
                    }
                }
            }
        }
        let mm = |v: &[f64]| {
            (v.len(), v.iter().copied().fold(1.0, f64::min), measure::median(v), v.iter().copied().fold(0.0, f64::max))
        };
        println!("{} overlapping {:?} not {:?} auc {:.3}", set.name, mm(&yes), mm(&no), auc(&yes, &no));
    }
}

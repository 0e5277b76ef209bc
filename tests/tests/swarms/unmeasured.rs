//! Odometry that states for z, roll and pitch what wheels' drivers do: the robots merge all the same, rightly, and each
//! says once which axes are not measured. Where nothing is measured they say so, and nothing is merged wrongly.

use merganser::recording::import::open_all;
use merganser_protocol::agent::io::Event;
use merganser_protocol::kinds::PairStatus;
use merganser_protocol::submap::stated::Oddity;
use merganser_tests::wires::{Wires, play};
use std::fs;
use std::path::Path;

/// Columns of a table's diagonal: x, y, z, roll, pitch, yaw.
const DIAGONAL: [usize; 6] = [8, 14, 19, 23, 26, 28];

/// The first two of the robots that come with the program, with these variances stated for these axes.
fn stated(variance: &str, axes: core::ops::Range<usize>) -> Wires {
    let dir = tempfile::tempdir().unwrap();
    let from = Path::new("../agent/recordings");
    for robot in ["alpha", "beta"] {
        let to = dir.path().join(robot);
        copy(&from.join(robot), &to);
        let table = fs::read_to_string(to.join("keyframes.csv")).unwrap();
        let change = |(number, line): (usize, &str)| {
            let mut fields: Vec<&str> = line.split(',').collect();
            if number > 0 {
                DIAGONAL[axes.clone()].iter().for_each(|column| fields[*column] = variance);
            }
            fields.join(",") + "\n"
        };
        let changed: String = table.lines().enumerate().map(change).collect();
        fs::write(to.join("keyframes.csv"), changed).unwrap();
    }
    play(&open_all(dir.path()).unwrap(), 1).unwrap()
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let (path, name) = entry.map(|entry| (entry.path(), entry.file_name())).unwrap();
        if path.is_dir() {
            copy(&path, &to.join(name));
        } else {
            fs::copy(&path, to.join(name)).unwrap();
        }
    }
}

fn oddities(wires: &Wires) -> Vec<(usize, String)> {
    let odd = wires.events.iter().filter_map(|(robot, event)| match event {
        Event::InputOdd { oddity: Oddity::Unmeasured(axes) | Oddity::Blurs(axes), .. } => {
            Some((*robot, axes.to_string()))
        }
        _ => None,
    });
    odd.collect()
}

fn status(wires: &Wires) -> PairStatus {
    wires.agents[0].snapshot(wires.now).frames.pairs[0].status
}

#[test]
fn robots_on_wheels_merge_and_say_what_they_do_not_measure() {
    merges_and_says_so(&["1e6", "0"]);
}

#[test]
#[ignore = "night: the other ways to say that nothing was measured"]
fn robots_on_wheels_merge_however_they_say_that_nothing_is_measured() {
    merges_and_says_so(&["9999", "-1"]);
}

fn merges_and_says_so(variances: &[&str]) {
    let honest = stated("1e-8", 0..0);
    let at = |wires: &Wires| {
        let frames = wires.agents[0].snapshot(wires.now).frames.frames;
        frames.into_iter().find(|frame| frame.robot == "beta").unwrap().t_own_frame.unwrap()
    };
    for variance in variances {
        let wires = stated(variance, 2..5);
        assert_eq!(status(&wires), PairStatus::Merged, "{variance}");
        let mut told = oddities(&wires);
        told.sort();
        assert_eq!(told, [(0, "z, roll, pitch".to_owned()), (1, "z, roll, pitch".to_owned())], "{variance}");
        let (ours, theirs) = (at(&wires).pose.translation, at(&honest).pose.translation);
        let off = ours.iter().zip(theirs).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        assert!(off < 0.15, "{variance}: {off} m from where well measured odometry puts it");
    }
}

#[test]
fn where_nothing_is_measured_it_is_said_and_nothing_is_merged_wrongly() {
    let wires = stated("1", 0..6);
    assert_ne!(status(&wires), PairStatus::Merged);
    let mut told = oddities(&wires);
    told.sort();
    assert_eq!(told, [(0, "roll, pitch, yaw".to_owned()), (1, "roll, pitch, yaw".to_owned())]);
}

//! Whatever a file of a pose graph, or a table, holds: its reader does not panic, refuses by line, and what it takes comes
//! back when it is written ([`reading`] has the properties). Fuzzing looks farther with the same functions
//! (`agent/recording/fuzz`, target `graphs`).
#![allow(missing_docs, clippy::unwrap_used, clippy::panic, reason = "a failed unwrap in a test is its report")]

mod reading;

use merganser_estimation::posegraph::g2o;
use proptest::prelude::*;

/// A spatial graph, a planar one, Kimera-Multi's table and ours.
fn valid() -> Vec<Vec<u8>> {
    let upper =
        |n: usize| (0..n).flat_map(|r| (r..n).map(move |c| if r == c { "100" } else { "0" })).collect::<Vec<_>>();
    let (six, three) = (upper(6).join(" "), upper(3).join(" "));
    let spatial: String = (0..4).map(|k| format!("EDGE_SE3:QUAT {k} {} 1 0 0.5 0 0 0.6 0.8 {six}\n", k + 1)).collect();
    let planar: String = (0..4).map(|k| format!("EDGE_SE2 {k} {} 1 0.25 -0.5 {three}\n", k + 1)).collect();
    let header = "id,origin,x,y,z,qx,qy,qz,qw";
    let columns: Vec<String> = (1..=6).flat_map(|r| (r..=6).map(move |c| format!("c{r}{c}"))).collect();
    let row = format!("1,0,1,2,3,0,0,0,1,{}", upper(6).join(","));
    [
        format!("# a graph\nVERTEX_SE3:QUAT 0 1 2 3 0 0 0 1\nFIX 0\n{spatial}PARAMS_SE3OFFSET 0 0\n"),
        format!("VERTEX_SE2 0 1 2 0.5\nVERTEX_SE2 4 5 2 3.5\n{planar}EDGE_SE2 0 4 3 1 -2 {three}\nFIX 0 4\n"),
        "robot_src,pose_src,robot_dst,pose_dst,qx,qy,qz,qw,tx,ty,tz,kappa,tau,is_known_inlier,weight\n\
         0,0,0,1,0,0,0,1,1,0,0,100,10,1,1\n0,1,1,0,0,0,0.6,0.8,1,0,0,100,10,0,0.5\n"
            .into(),
        format!("{header},{}\n{row}\n", columns.join(",")),
    ]
    .map(String::into_bytes)
    .to_vec()
}

/// Words that break what comes after, or overflow.
const WORDS: [&[u8]; 16] = [
    b"-1",
    b"1e309",
    b"nan",
    b"-inf",
    b"18446744073709551616",
    b"1e12",
    b"1.1e12",
    b"1e-320",
    b"",
    b"\n",
    b"\r",
    b"\xff",
    b"0",
    b"EDGE_SE2",
    b"VERTEX_SE3:QUAT",
    b"#",
];

fn damaged(mut bytes: Vec<u8>, all: &[(f64, bool, &[u8])]) -> Vec<u8> {
    for (share, replaces, word) in all {
        let at = (share * bytes.len() as f64) as usize;
        let is_end = |b: &u8| b.is_ascii_whitespace() || *b == b',';
        let from = bytes[..at].iter().rposition(is_end).map_or(0, |end| end + 1);
        let length = bytes[from..].iter().position(is_end).unwrap_or(bytes.len() - from);
        let to = if *replaces { from + length } else { from };
        bytes.splice(from..to, word.iter().copied());
    }
    bytes
}

fn bytes() -> impl Strategy<Value = Vec<u8>> {
    let word = (0.0..1.0_f64, any::<bool>(), prop::sample::select(&WORDS[..]));
    let hurt = (prop::sample::select(valid()), prop::collection::vec(word, 0..5), 0.3..1.2_f64);
    prop_oneof![
        9 => hurt.prop_map(|(valid, all, share)| {
            let mut bytes = damaged(valid, &all);
            bytes.truncate((share * bytes.len() as f64) as usize);
            bytes
        }),
        1 => prop::collection::vec(any::<u8>(), 0..300),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, max_shrink_iters: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn graphs_and_tables_are_read_or_refused(bytes in bytes()) {
        reading::graphs(&bytes);
    }
}

#[test]
fn undamaged_files_are_taken() {
    for text in &valid()[..2] {
        let mut parser = g2o::Parser::default();
        str::from_utf8(text).unwrap().lines().for_each(|line| parser.line(line).unwrap());
        let graph = parser.finish();
        assert!(graph.measurements.len() >= 4 && graph.poses.len() == 5, "{graph:?}");
    }
    valid().iter().for_each(|bytes| reading::graphs(bytes));
}

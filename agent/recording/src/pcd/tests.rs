//! PCD files as `pcd-rs`, PCL and drivers write them, and as nobody should.

use super::super::limits::POINTS_MAX;
use super::*;
use pcd_rs::{DataKind, DynRecord, Field, Schema, ValueKind, WriterInit};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::io::Cursor;

fn points(bytes: &[u8]) -> Vec<[f64; 3]> {
    parse(bytes).ok().unwrap().points
}

fn problem(text: impl AsRef<[u8]>) -> Problem {
    parse(text.as_ref()).err().unwrap().problem
}

fn written(kind: DataKind, points: u32) -> Vec<u8> {
    let schema = Schema::from_iter([
        ("intensity", ValueKind::F32, 1),
        ("x", ValueKind::F32, 1),
        ("y", ValueKind::F64, 1),
        ("z", ValueKind::F32, 1),
    ]);
    let mut bytes = Cursor::new(Vec::new());
    let init = WriterInit {
        width: u64::from(points),
        height: 1,
        viewpoint: pcd_rs::ViewPoint::default(),
        data_kind: kind,
        schema: Some(schema),
        version: None,
    };
    let mut writer = init.build_from_writer::<DynRecord, _>(&mut bytes).unwrap();
    for i in 0..points {
        let i = i as f32;
        let (y, z) = (Field::F64(vec![f64::from(-i)]), Field::F32(vec![0.25]));
        writer.push(&DynRecord(vec![Field::F32(vec![7.0]), Field::F32(vec![i]), y, z])).unwrap();
    }
    writer.finish().unwrap();
    bytes.into_inner()
}

#[test]
fn every_data_kind_reads_back() {
    for kind in [DataKind::Ascii, DataKind::Binary, DataKind::BinaryCompressed] {
        let points = points(&written(kind, 40));
        assert_eq!(points.len(), 40, "{kind:?}");
        assert_eq!(points[3], [3.0, -3.0, 0.25], "{kind:?}");
    }
}

#[test]
fn organised_clouds_leave_out_what_was_not_measured() {
    let cloud = |width: usize, height: usize| {
        let head = format!(
            "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {width}\nHEIGHT {height}\n\
             VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {}\nDATA ",
            width * height
        );
        let points = [[f32::NAN; 3], [1.0, 2.0, 3.0], [4.0, 5.0, f32::NAN], [f32::INFINITY, 0.0, 0.0]];
        let binary: Vec<u8> = points.iter().flatten().flat_map(|c| c.to_le_bytes()).collect();
        let ascii = "nan nan nan\n1 2 3\n4 5 nan\ninf 0 0\n";
        [[format!("{head}binary\n").into_bytes(), binary].concat(), format!("{head}ascii\n{ascii}").into_bytes()]
    };
    for bytes in cloud(2, 2) {
        assert_eq!(points(&bytes), [[1.0, 2.0, 3.0]]);
    }
    for bytes in cloud(4, 1) {
        let points = points(&bytes);
        assert!(points.len() == 4 && points[0][0].is_nan(), "left to be refused as a mistake");
    }
}

#[test]
fn cut_off_files_are_refused_at_every_byte() {
    for kind in [DataKind::Ascii, DataKind::Binary, DataKind::BinaryCompressed] {
        let bytes = written(kind, 5);
        // The last byte of ASCII is a newline, which nobody misses.
        let whole = bytes.len() - usize::from(kind == DataKind::Ascii);
        for cut in 0..whole {
            let read = parse(&bytes[..cut]);
            // An ASCII number may lose digits and still be one; nothing can notice that.
            let digits = kind == DataKind::Ascii && bytes[..cut].ends_with(b"0.2") || bytes[..cut].ends_with(b"0.");
            assert!(read.is_err() || digits || cut + 4 > whole && kind == DataKind::Ascii, "{kind:?} at {cut}");
        }
    }
}

#[test]
fn claims_beyond_the_file_and_the_bounds_are_refused() {
    let head = |fields: &str, sizes: &str, points: u64, data: &str| {
        let n = fields.split(' ').count();
        let (types, counts) = (["F"].repeat(n).join(" "), ["1"].repeat(n).join(" "));
        format!(
            "VERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\nWIDTH {points}\nHEIGHT 1\n\
             VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
        )
    };
    let over = head("x y z", "4 4 4", POINTS_MAX as u64 + 1, "binary");
    assert!(matches!(problem(over), Problem::CloudPoints(_)));
    let short = head("x y z", "4 4 4", POINTS_MAX as u64, "binary");
    assert!(matches!(problem(short), Problem::CloudLength { found: 0, .. }));
    let mut bomb = head("x y z", "4 4 4", 1, "binary_compressed").into_bytes();
    bomb.extend(4u32.to_le_bytes());
    bomb.extend(u32::MAX.to_le_bytes());
    bomb.extend([0; 4]);
    assert!(matches!(problem(&bomb), Problem::Pcd(why) if why.contains("unpacks")));
    let flat = head("x y", "4 4", 1, "ascii") + "1 2\n";
    assert!(matches!(problem(flat), Problem::Pcd(why) if why.contains("\"z\"")));
    let wide = head("x y z", "4 4 4", 1, "binary").replace("COUNT 1 1 1", "COUNT 1 1 999999999");
    assert!(matches!(problem(wide), Problem::Pcd(why) if why.contains("bytes")));
}

/// Three points with fields that pad, as an Ouster's driver writes them.
fn padded(data: &str) -> String {
    format!(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ intensity _ t\nSIZE 4 4 4 1 4 1 4\nTYPE F F F U F U U\n\
         COUNT 1 1 1 0 1 0 1\nWIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA {data}\n"
    )
}

#[test]
fn fields_of_count_0_have_no_bytes() {
    let want = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.5]];
    let record = |p: &[f32; 3]| [p.map(f32::to_le_bytes).concat(), vec![9; 8]].concat();
    let body: Vec<u8> = want.iter().flat_map(|p| record(&p.map(|c| c as f32))).collect();
    assert_eq!(points(&[padded("binary").as_bytes(), &body].concat()), want);
    assert_eq!(points((padded("ascii") + "1 2 3 9 9\n4 5 6 9 9\n\n# a comment\n7 8 9.5 9 9").as_bytes()), want);
    // A coordinate that has none is missing.
    let none = padded("ascii").replace("COUNT 1 1 1", "COUNT 1 1 0");
    assert!(matches!(problem(none), Problem::Pcd(why) if why.contains("no field \"z\"")));
}

#[test]
fn a_viewpoint_that_says_something_is_remarked_and_not_applied() {
    let with = |viewpoint: &str| {
        let head = padded("ascii").replace("VIEWPOINT 0 0 0 1 0 0 0\n", viewpoint);
        let read = parse((head + "1 2 3 9 9\n4 5 6 9 9\n7 8 9.5 9 9\n").as_bytes()).ok().unwrap();
        assert_eq!(read.points[1], [4.0, 5.0, 6.0]);
        read.remarks.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    for silent in ["", "VIEWPOINT 0 0 0 1 0 0 0\n", "VIEWPOINT 0 0 0 -1 0 0 0\n", "VIEWPOINT 0 0 0 0 0 0 0\n"] {
        assert!(with(silent).is_empty(), "{silent}");
    }
    for odd in ["10 20 3 1 0 0 0", "0 0 0 0.7 0 0 0.7", "0 0 1e-3 1 0 0 0", "0 0 0 0 1 0 0"] {
        let told = with(&format!("VIEWPOINT {odd}\n"));
        let [told] = &told[..] else { panic!("{odd}: {told:?}") };
        assert!(told.contains("is not applied; points must be in the body frame"), "{told}");
    }
}

#[test]
fn counts_that_contradict_each_other_are_refused_by_line() {
    let points = "1 2 3 9 9\n4 5 6 9 9\n7 8 9.5 9 9\n";
    let with = |from: &str, to: &str| parse((padded("ascii").replace(from, to) + points).as_bytes());
    let refused = |from: &str, to: &str, at: usize, parts: &[&str]| {
        let fault = with(from, to).err().unwrap();
        let told = fault.problem.to_string();
        assert_eq!(fault.line, Some(at), "{told}");
        assert!(parts.iter().all(|part| told.contains(part)), "{told}");
    };
    refused("WIDTH 3", "WIDTH 2", 10, &["POINTS 3 is not WIDTH 2 × HEIGHT 1 = 2"]);
    refused("POINTS 3", "POINTS 4", 10, &["POINTS 4 is not WIDTH 3"]);
    refused("HEIGHT 1", "HEIGHT 2", 10, &["HEIGHT 2 = 6"]);
    refused("WIDTH 3", "WIDTH three", 7, &["WIDTH", "\"three\""]);
    refused("COUNT 1 1 1 0 1 0 1", "COUNT 1 1 1", 6, &["COUNT has 3 words for 7 fields"]);
    refused("SIZE 4 4 4", "SIZE 4 4 3", 5, &["field z: TYPE F of SIZE 3"]);
    refused("VIEWPOINT 0 ", "VIEWPOINT ", 9, &["7 are wanted: x y z qw qx qy qz"]);
    refused("DATA ascii", "DATA text", 11, &["DATA text is not read"]);
    // One of the two is enough.
    for (from, to) in [("POINTS 3\n", ""), ("WIDTH 3\nHEIGHT 1\n", ""), ("HEIGHT 1\n", "")] {
        assert_eq!(with(from, to).ok().unwrap().points.len(), 3, "{from:?}");
    }
    // The file holds fewer, or more.
    let states = |n: usize| {
        padded("ascii").replace("WIDTH 3", &format!("WIDTH {n}")).replace("POINTS 3", &format!("POINTS {n}"))
    };
    assert!(matches!(problem(states(4) + points), Problem::Pcd(why) if why.contains("3 points where POINTS states 4")));
    assert!(matches!(problem(states(2) + points), Problem::Pcd(why) if why.contains("more after the 2 points")));
}

#[test]
fn every_type_of_number_and_case_of_names_reads_back_in_every_form() {
    const KINDS: [(&str, usize); 10] =
        [("I", 1), ("I", 2), ("i", 4), ("I", 8), ("U", 1), ("U", 2), ("u", 4), ("U", 8), ("F", 4), ("f", 8)];
    for seed in 0..300 {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let mut fields: Vec<(String, usize, usize)> = (0..rng.random_range(0..4))
            .map(|k| (format!("f{k}"), rng.random_range(0..10), rng.random_range(0..3)))
            .collect();
        for axis in ["y", "X", "z"] {
            let at = rng.random_range(0..=fields.len());
            fields.insert(at, (axis.into(), rng.random_range(0..10), 1));
        }
        let n = rng.random_range(1..5);
        let value = |axis: &str, k: usize| {
            ["x", "y", "z"].iter().position(|a| a.eq_ignore_ascii_case(axis)).map_or(1, |a| 10 * k + a)
        };
        let joined =
            |word: &dyn Fn(&(String, usize, usize)) -> String| fields.iter().map(word).collect::<Vec<_>>().join(" ");
        let head = format!(
            "VERSION .7\nFIELDS {}\nSIZE {}\nTYPE {}\nCOUNT {}\nPOINTS {n}\nDATA ",
            joined(&|f| f.0.clone()),
            joined(&|f| KINDS[f.1].1.to_string()),
            joined(&|f| KINDS[f.1].0.to_owned()),
            joined(&|f| f.2.to_string()),
        );
        let number = |field: &(String, usize, usize), k: usize| {
            let (value, (kind, size)) = (value(&field.0, k), KINDS[field.1]);
            match (kind, size) {
                ("F" | "f", 4) => (value as f32).to_le_bytes().to_vec(),
                ("F" | "f", _) => (value as f64).to_le_bytes().to_vec(),
                _ => value.to_le_bytes()[..size].to_vec(),
            }
        };
        let of_point = |k: usize| {
            fields.iter().flat_map(move |f| std::iter::repeat_n(number(f, k), f.2).flatten()).collect::<Vec<u8>>()
        };
        let of_field = |f: &(String, usize, usize)| {
            (0..n).flat_map(|k| std::iter::repeat_n(number(f, k), f.2).flatten()).collect::<Vec<u8>>()
        };
        let text = |k: usize| {
            fields
                .iter()
                .flat_map(|f| std::iter::repeat_n(value(&f.0, k).to_string(), f.2))
                .collect::<Vec<_>>()
                .join(" ")
                + "\r\n"
        };
        let binary: Vec<u8> = (0..n).flat_map(of_point).collect();
        let by_field: Vec<u8> = fields.iter().flat_map(of_field).collect();
        let runs: Vec<u8> = by_field.chunks(32).flat_map(|run| [&[run.len() as u8 - 1], run].concat()).collect();
        let lengths = [runs.len() as u32, by_field.len() as u32].map(u32::to_le_bytes).concat();
        let bodies = [
            ("ascii", (0..n).map(text).collect::<String>().into_bytes()),
            ("binary", binary),
            ("binary_compressed", [lengths, runs].concat()),
        ];
        let want: Vec<[f64; 3]> = (0..n).map(|k| [0, 1, 2].map(|a| (10 * k + a) as f64)).collect();
        for (form, body) in bodies {
            let read = parse(&[head.as_bytes(), form.as_bytes(), b"\n", &body].concat());
            let read = read.unwrap_or_else(|fault| panic!("seed {seed} {form}: {:?} {}", fault.line, fault.problem));
            assert_eq!(read.points, want, "seed {seed} {form}");
            let whole = fields.iter().any(|f| !f.0.starts_with('f') && !["F", "f"].contains(&KINDS[f.1].0));
            assert_eq!(read.remarks, if whole { vec![Remark::Whole] } else { vec![] }, "seed {seed}");
        }
    }
}

#[test]
fn no_cut_or_changed_file_makes_the_reader_panic() {
    let rng = &mut ChaCha8Rng::seed_from_u64(1);
    for kind in [DataKind::Ascii, DataKind::Binary, DataKind::BinaryCompressed] {
        let bytes = written(kind, 9);
        for _ in 0..3000 {
            let mut changed = bytes[..rng.random_range(0..=bytes.len())].to_vec();
            let at = rng.random_range(0..bytes.len());
            if let Some(byte) = changed.get_mut(at) {
                *byte = rng.random();
            }
            let _ = parse(&changed);
        }
    }
}

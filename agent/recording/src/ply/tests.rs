//! PLY files as programs write them, and as nobody should.

use super::super::limits::POINTS_MAX;
use super::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ASCII: &str = "ply\nformat ascii 1.0\ncomment c\nelement vertex 2\nproperty uchar red\nproperty double x\n\
                     property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\n\
                     end_header\n1 0.5 2 3\n2 -1 1e-3 4\n3 0 1 2\n";

fn points(bytes: &[u8]) -> Vec<[f64; 3]> {
    parse(bytes).ok().unwrap().points
}

fn told(text: &str) -> (Option<usize>, String) {
    let fault = parse(text.as_bytes()).err().unwrap();
    (fault.line, fault.problem.to_string())
}

#[test]
fn ascii_with_other_properties_and_elements_reads() {
    assert_eq!(points(ASCII.as_bytes()), [[0.5, 2.0, 3.0], [-1.0, 1e-3, 4.0]]);
    for end in ["\r\n", "\r", "\n\n", "\n \n\t\n"] {
        assert_eq!(points(ASCII.replace('\n', end).as_bytes()), points(ASCII.as_bytes()), "{end:?}");
    }
}

#[test]
fn binary_with_other_properties_reads() {
    let mut bytes = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty short a\nproperty float y\n\
        property double x\nproperty float z\nend_header\n"
        .to_vec();
    for i in 0..2 {
        let i = i as f32;
        bytes.extend(7i16.to_le_bytes());
        bytes.extend(i.to_le_bytes());
        bytes.extend((f64::from(i) + 0.5).to_le_bytes());
        bytes.extend((-i).to_le_bytes());
    }
    assert_eq!(points(&bytes), [[0.5, 0.0, 0.0], [1.5, 1.0, -1.0]]);
    let coloured =
        encode_coloured(2, [([1.0, 2.0, 3.0], [9; 3]), ([4.0; 3], [1; 3])].iter().map(|(p, c)| (p, *c)), None);
    assert_eq!(points(&coloured), [[1.0, 2.0, 3.0], [4.0; 3]]);
}

#[test]
fn cut_off_and_overlong_files_are_refused() {
    let bytes = encode(&[[1.0, 2.0, 3.0]; 4]);
    for cut in 0..bytes.len() {
        assert!(parse(&bytes[..cut]).is_err(), "at {cut}");
    }
    let longer = [bytes, vec![0]].concat();
    assert!(matches!(parse(&longer).err().unwrap().problem, Problem::CloudLength { found: 49, expected: 48 }));
}

#[test]
fn bad_headers_and_lines_are_told_with_their_line() {
    let cases = [
        ("plx\n", Some(1), "first line"),
        (&ASCII.replace("format ascii", "format binary"), Some(2), "write ascii, binary_little_endian or"),
        (&ASCII.replace("vertex 2", "vertex two"), Some(4), "not a number of elements"),
        (&ASCII.replace("double x", "double u"), None, "no property x"),
        (&ASCII.replace("double x", "list uchar int x"), None, "no property x"),
        (&ASCII.replace("double x", "list float int l"), Some(6), "float for a length"),
        (&ASCII.replace("element vertex 2\n", ""), Some(4), "before any element"),
        (&ASCII.replace("element face", "element vertex"), Some(9), "two elements vertex"),
        (&ASCII.replace("double x", "quad x"), Some(6), "quad"),
        (&ASCII.replace("end_header", "end_head"), Some(11), "does not belong"),
        (&ASCII.replace("-1 1e-3", "-1"), Some(13), "3 values instead of 4"),
        (&ASCII.replace("1e-3", "one"), Some(13), "\"one\""),
        (&ASCII.replace("vertex 2", &format!("vertex {}", POINTS_MAX + 1)), Some(4), "POINTS_MAX"),
    ];
    for (text, line, what) in cases {
        let (at, message) = told(text);
        assert_eq!(at, line, "{message}");
        assert!(message.contains(what), "{message}");
    }
}

/// A file of random elements, properties (lists among them) and values, with x, y, z of `points` somewhere among them.
fn random(seed: u64, points: &[[f64; 3]]) -> Vec<u8> {
    const KINDS: [(&str, usize); 8] = [
        ("char", 1),
        ("uint8", 1),
        ("short", 2),
        ("ushort", 2),
        ("int32", 4),
        ("uint", 4),
        ("float", 4),
        ("double", 8),
    ];
    let rng = &mut ChaCha8Rng::seed_from_u64(seed);
    let format = ["ascii", "binary_little_endian", "binary_big_endian"][rng.random_range(0..3)];
    // A file whose lines end in CR alone may not go on in bytes that begin with LF, but these do not.
    let end = ["\n", "\r\n", "\r"][rng.random_range(0..3)];
    let mut head = format!("ply{end}comment made by a test{end}{end}format {format} 1.0{end}obj_info none{end}");
    let mut body: Vec<u8> = Vec::new();
    let vertex = rng.random_range(0..3);
    for element in 0..rng.random_range(vertex + 1..5) {
        let count = if element == vertex { points.len() } else { rng.random_range(0..4) };
        let name = if element == vertex { "vertex".to_owned() } else { format!("thing{element}") };
        head += &format!("element {name} {count}{end}comment {element}{end}");
        let mut properties: Vec<(String, Option<usize>, usize)> = (0..rng.random_range(1..4))
            .map(|k| (format!("p{k}"), rng.random_bool(0.4).then(|| rng.random_range(1..3)), rng.random_range(0..8)))
            .collect();
        if element == vertex {
            for axis in ["z", "x", "y"] {
                let at = rng.random_range(0..=properties.len());
                properties.insert(at, (axis.into(), None, rng.random_range(6..8)));
            }
        }
        for (name, length, kind) in &properties {
            let list = length.map_or(String::new(), |length| format!("list {} ", KINDS[length].0));
            head += &format!("property {list}{} {name}{end}", KINDS[*kind].0);
        }
        for (index, point) in (0..count).map(|index| (index, points.get(index))) {
            let mut words = Vec::new();
            for (name, length, kind) in &properties {
                let axis = ["x", "y", "z"].iter().position(|axis| axis == name).filter(|_| element == vertex);
                let items = length.map_or(1, |_| rng.random_range(0..4));
                if let Some(length) = length {
                    words.push((items as f64, *length));
                }
                words.extend((0..items).map(|_| (axis.zip(point).map_or(7.0, |(axis, point)| point[axis]), *kind)));
            }
            for (value, kind) in words {
                let mut bytes = match KINDS[kind] {
                    ("float", _) => (value as f32).to_le_bytes().to_vec(),
                    ("double", _) => value.to_le_bytes().to_vec(),
                    (_, bytes) => (value as i64).to_le_bytes()[..bytes].to_vec(),
                };
                match format {
                    "ascii" => body.extend(format!("{value} ").bytes()),
                    "binary_big_endian" => {
                        bytes.reverse();
                        body.extend(bytes);
                    }
                    _ => body.extend(bytes),
                }
            }
            if format == "ascii" {
                body.extend(end.bytes().chain(end.bytes().filter(|_| index % 2 == 0)));
            }
        }
    }
    head += &format!("end_header{end}");
    [head.into_bytes(), body].concat()
}

#[test]
fn whatever_else_a_file_holds_and_however_its_points_are_read() {
    let want: Vec<[f64; 3]> = (0..7).map(|k| [f64::from(k) + 0.5, -2.25, f64::from(-k)]).collect();
    for seed in 0..400 {
        let bytes = random(seed, &want);
        let read = parse(&bytes).unwrap_or_else(|fault| panic!("seed {seed}: {:?} {}", fault.line, fault.problem));
        assert_eq!(read.points, want, "seed {seed}");
        let columns = columns(&bytes, &["z", "nothing", "x"]).ok().unwrap();
        let column = |axis: usize| Some(want.iter().map(|point| point[axis]).collect::<Vec<_>>());
        assert_eq!(columns, [column(2), None, column(0)], "seed {seed}");
    }
}

#[test]
fn no_cut_or_changed_file_makes_the_reader_panic() {
    let rng = &mut ChaCha8Rng::seed_from_u64(1);
    for seed in 0..200 {
        let bytes = random(seed, &[[1.0, 2.0, 3.0]; 3]);
        for _ in 0..40 {
            let mut changed = bytes[..rng.random_range(0..=bytes.len())].to_vec();
            let at = rng.random_range(0..bytes.len());
            if let Some(byte) = changed.get_mut(at) {
                *byte = rng.random();
            }
            let _ = (parse(&changed), columns(&changed, &["x", "p0"]));
        }
    }
}

#[test]
fn whole_and_upper_case_coordinates_are_read_and_whole_ones_remarked() {
    let upper = ASCII.replace("float y", "float Y");
    assert_eq!(points(upper.as_bytes()), points(ASCII.as_bytes()));
    let whole = ASCII.replace("double x", "short x").replace("0.5", "5");
    let read = parse(whole.as_bytes()).ok().unwrap();
    assert_eq!((read.points[0], read.remarks), ([5.0, 2.0, 3.0], vec![Remark::Whole]));
    assert_eq!(parse(ASCII.as_bytes()).ok().unwrap().remarks, []);
}

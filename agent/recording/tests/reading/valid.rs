//! Small good files of every kind, which tests damage and fuzzing begins with.

use super::reading::good;
use merganser_recording::cloud;
use merganser_recording::manifest::CloudFormat;
use merganser_recording::observation::KeyframeMessage;
use serde_json::json;
use std::fmt::Write as _;
use std::io::Write as _;

fn points() -> Vec<[f32; 3]> {
    (0..20_u8).map(|k| [0.5 * f32::from(k), -0.25, 1.0 + 0.125 * f32::from(k)]).collect()
}

/// Clouds of every format, in every form.
pub fn clouds() -> Vec<Vec<u8>> {
    let mut all: Vec<Vec<u8>> = [CloudFormat::Ply, CloudFormat::KittiBin, CloudFormat::XyzBin, CloudFormat::XyzI16]
        .map(|format| cloud::encode(&points(), format).unwrap())
        .to_vec();
    let text: String = points().iter().map(|[x, y, z]| format!("{x} {y} {z} 1 2\n")).collect();
    all.push(
        format!(
            "ply\nformat ascii 1.0\ncomment a\nelement odd 1\nproperty list uchar int i\nelement vertex 20\n\
             property double x\nproperty float y\nproperty float z\nproperty uchar a\nproperty short b\n\
             end_header\n3 1 2 3\n{text}"
        )
        .into_bytes(),
    );
    let mut big = b"ply\nformat binary_big_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
                    property float z\nproperty list uchar ushort i\nelement face 0\nend_header\n"
        .to_vec();
    for point in &points()[..3] {
        big.extend(point.iter().flat_map(|c| c.to_be_bytes()));
        big.extend([1, 0, 7]);
    }
    all.push(big);
    let head = |data: &str| {
        format!(
            "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ i\nSIZE 4 4 4 1 2\nTYPE F F F U U\nCOUNT 1 1 1 0 1\nWIDTH 20\nHEIGHT 1\n\
             VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 20\nDATA {data}\n"
        )
        .into_bytes()
    };
    let text: String = points().iter().map(|[x, y, z]| format!("{x} {y} {z} 7\n")).collect();
    all.push([head("ascii"), text.into_bytes()].concat());
    let rows =
        points().iter().flat_map(|p| [p.map(f32::to_le_bytes).concat(), vec![7, 0]].concat()).collect::<Vec<u8>>();
    all.push([head("binary"), rows].concat());
    let column = |axis: usize| points().iter().flat_map(|p| p[axis].to_le_bytes()).collect::<Vec<u8>>();
    let columns = [column(0), column(1), column(2), [7, 0].repeat(20)].concat();
    let packed: Vec<u8> = columns.chunks(32).flat_map(|run| [&[run.len() as u8 - 1], run].concat()).collect();
    let lengths = [packed.len() as u32, columns.len() as u32].map(u32::to_le_bytes).concat();
    all.push([head("binary_compressed"), lengths, packed].concat());
    // Runs that unpack to a hundred times as much: 20 points of zeros.
    let zeros = [0, 0, 0xe0, 255, 0, 0xe0, 6, 0];
    let lengths = [zeros.len() as u32, 280_u32].map(u32::to_le_bytes).concat();
    all.push([head("binary_compressed"), lengths, zeros.to_vec()].concat());
    all.push(good(super::reading::FILES[6]));
    all
}

/// Keyframes, a sighting and a position, in JSON and postcard.
pub fn messages() -> Vec<Vec<u8>> {
    let triangle =
        |n: usize| (0..n).flat_map(|r| (r..n).map(move |c| if r == c { 1e-4 } else { 0.0 })).collect::<Vec<_>>();
    let mut keyframe = json!({"stamp_ns": 1_700_000_000_000_000_000_i64, "translation": [0, 1.5, 0],
        "rotation": [0, 0, 0, 1], "covariance": triangle(6), "covariance_of": "motion", "points": [[1.5, 0.2, 0.0]]});
    let mut all = vec![keyframe.clone()];
    keyframe["landmarks"] = json!([{"covariance": triangle(3), "label": 72, "descriptor": vec![9; 32]}]);
    keyframe["place"] = json!({"model": "net", "metric": "cosine", "vector": [0.5, -0.25, 1.0]});
    keyframe["up"] = json!({"direction": [0.0, 0.0, 1.0], "sigma_rad": 0.01});
    keyframe["session"] = json!(7);
    all.push(keyframe.clone());
    for field in ["landmarks", "points"] {
        keyframe.as_object_mut().unwrap().remove(field);
    }
    keyframe["depth"] = json!({"width": 4, "height": 4, "fx": 4, "fy": 4, "cx": 2, "cy": 2, "unit_m": 0.001,
        "range_m": [0.3, 4.0], "t_body_camera": {"translation": [0.1, 0, 0.3], "rotation": [-0.5, 0.5, -0.5, 0.5]},
        "data": "6APoA+gD6APoA+gD6APoA+gD6APoA+gD6APoA+gD6AM="});
    all.push(keyframe);
    let mut bytes: Vec<Vec<u8>> = all.iter().map(|message| message.to_string().into_bytes()).collect();
    bytes.extend(all.iter().map(|message| {
        postcard::to_stdvec(&serde_json::from_value::<KeyframeMessage>(message.clone()).unwrap()).unwrap()
    }));
    bytes.push(
        json!({"stamp_ns": 1, "robot": "beta", "position": [2.1, -0.4, 0.0], "covariance": triangle(3)})
            .to_string()
            .into_bytes(),
    );
    bytes.push(
        json!({"stamp_ns": 1, "robot": "beta", "translation": [2.1, -0.4, 0.0], "rotation": [0, 0, 0, 1],
            "covariance": triangle(6)})
        .to_string()
        .into_bytes(),
    );
    let mut image = Vec::new();
    let mut encoder = png::Encoder::new(&mut image, 4, 4);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    encoder.write_header().unwrap().write_image_data(&[3; 32]).unwrap();
    bytes.push(image);
    bytes.push([&[4, 2][..], &[5; 16]].concat());
    bytes
}

/// A log with both messages of lasers, and the tables of MRCLAM.
pub fn logs() -> Vec<Vec<u8>> {
    let mut laser = String::from("# a log\nPARAM robot_frontlaser_offset 0.1 nohost 0\n");
    for k in 0..4 {
        let _ = writeln!(laser, "FLASER 4 1.5 2 81.9 3 0 0 0 {k}.5 0 0.1 {k}.25 robot {k}.5");
        let _ = writeln!(
            laser,
            "ROBOTLASER1 0 -1.5708 3.1416 0.785 81.9 0.01 0 4 1.5 2 81.9 3 0 0 0 0 {k} 0 0 0 0 0 0 0 {k}.75 robot {k}.8"
        );
    }
    let tables = [
        "# time forward angular\n1248272272.841 0.000 0.000\n1248272272.851 0.1 -0.02\n",
        "# time barcode range bearing\n1248272272.841 72 1.5 -0.3\n1248272273.9 5 2.25 0.1\n",
        "# subject barcode\n1 5\n2 14\n6 72\n",
    ];
    [vec![laser.into_bytes()], tables.map(|table| table.as_bytes().to_vec()).to_vec()].concat()
}

/// A laser's log as xz and as bz2.
pub fn packed_logs() -> Vec<Vec<u8>> {
    let log = logs().remove(0);
    let mut packer = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::fast());
    packer.write_all(&log).unwrap();
    vec![xz_that_wants(&log, 1 << 16), packer.finish().unwrap()]
}

/// The bytes as an xz file that states a dictionary of so many bytes, without having one.
pub fn xz_that_wants(bytes: &[u8], dictionary: u32) -> Vec<u8> {
    let mut packer = lzma_rust2::XzWriter::new(Vec::new(), lzma_rust2::XzOptions::with_preset(0)).unwrap();
    packer.write_all(bytes).unwrap();
    let mut packed = packer.finish().unwrap();
    // The first block's head: its length in fours, flags, the filter LZMA2, one byte of properties, the dictionary.
    let head = 12..12 + 4 * (usize::from(packed[12]) + 1);
    assert_eq!(packed[14..16], [0x21, 1], "LZMA2 alone, with the head's optional lengths left out");
    // (2 | n & 1) << (n / 2 + 11)
    packed[16] =
        (0..=40_u8).find(|n| (2 | u32::from(n & 1)).checked_shl(u32::from(n / 2) + 11) == Some(dictionary)).unwrap();
    let sum = crc32(&packed[head.start..head.end - 4]).to_le_bytes();
    packed[head.end - 4..head.end].copy_from_slice(&sum);
    packed
}

fn crc32(bytes: &[u8]) -> u32 {
    let step = |sum: u32, _| (sum >> 1) ^ (0xedb8_8320 & 0_u32.wrapping_sub(sum & 1));
    !bytes.iter().fold(!0, |sum, byte| (0..8).fold(sum ^ u32::from(*byte), step))
}

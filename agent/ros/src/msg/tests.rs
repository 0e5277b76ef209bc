//! Points of clouds in any layout are the same points; bad layouts are refused by name.

use super::{CloudError, Header, LaserScan, PointCloud2, PointField};
use crate::limits::POINTS_MAX;
use crate::wire::Blob;
use proptest::prelude::*;

/// Points that every type of number can hold.
const POINTS: [[i8; 3]; 6] = [[1, 2, 3], [4, 5, 6], [7, 8, 9], [10, 11, 12], [13, 14, 15], [16, 17, 18]];

fn number(value: i8, datatype: u8, is_bigendian: bool) -> Vec<u8> {
    let mut bytes = match datatype {
        1 | 2 => value.to_le_bytes().to_vec(),
        3 | 4 => i16::from(value).to_le_bytes().to_vec(),
        5 | 6 => i32::from(value).to_le_bytes().to_vec(),
        7 => f32::from(value).to_le_bytes().to_vec(),
        _ => f64::from(value).to_le_bytes().to_vec(),
    };
    if is_bigendian {
        bytes.reverse();
    }
    bytes
}

/// A cloud of 2 rows of 3 points with so many bytes before each coordinate, behind each point, and behind each row.
fn cloud(datatypes: [u8; 3], before: [usize; 3], behind: usize, padding: usize, is_bigendian: bool) -> PointCloud2 {
    let (mut data, mut fields, mut step) = (Vec::new(), Vec::new(), 0);
    for (row, points) in POINTS.chunks(3).enumerate() {
        for (column, point) in points.iter().enumerate() {
            let begins = data.len();
            for axis in 0..3 {
                data.extend(vec![0xee; before[axis]]);
                if row + column == 0 {
                    let name = ["x", "y", "z"][axis].to_owned();
                    let offset = (data.len() - begins) as u32;
                    fields.push(PointField { name, offset, datatype: datatypes[axis], count: 1 });
                }
                data.extend(number(point[axis], datatypes[axis], is_bigendian));
            }
            data.extend(vec![0xee; behind]);
            step = data.len() - begins;
        }
        data.extend(vec![0xee; padding]);
    }
    fields.reverse(); // their order says nothing
    PointCloud2 {
        header: Header::default(),
        height: 2,
        width: 3,
        fields,
        is_bigendian,
        point_step: step as u32,
        row_step: (3 * step + padding) as u32,
        data: Blob(data),
        is_dense: true,
    }
}

fn plain() -> PointCloud2 {
    cloud([7; 3], [0; 3], 4, 0, false)
}

fn expected() -> Vec<[f64; 3]> {
    POINTS.map(|point| point.map(f64::from)).to_vec()
}

proptest! {
    #[test]
    fn points_are_the_same_in_every_layout(
        datatypes in prop::array::uniform3(1..=8_u8), before in prop::array::uniform3(0..5_usize), behind in 0..5_usize,
        padding in 0..9_usize, is_bigendian: bool,
    ) {
        let cloud = cloud(datatypes, before, behind, padding, is_bigendian);
        prop_assert_eq!(cloud.points(usize::MAX).unwrap(), (expected(), 0));
    }

    /// Whatever a cloud claims: points within its data, or a named error.
    #[test]
    fn no_claim_does_harm(
        height: u32, width: u32, small in any::<bool>(), offsets in prop::array::uniform3(any::<u32>()), datatype: u8,
        point_step: u32, row_step: u32, length in 0..200_usize, is_bigendian: bool,
    ) {
        let limit = |value: u32| if small { value % 12 } else { value };
        let field = |axis: usize| PointField {
            name: ["x", "y", "z"][axis].into(), offset: limit(offsets[axis]), datatype: datatype % 10, count: 1,
        };
        let cloud = PointCloud2 {
            header: Header::default(), height: limit(height), width: limit(width), fields: (0..3).map(field).collect(),
            is_bigendian, point_step: limit(point_step), row_step: limit(row_step), data: Blob(vec![1; length]),
            is_dense: false,
        };
        if let Ok((points, left_out)) = cloud.points(usize::MAX) {
            let all = u64::from(cloud.height) * u64::from(cloud.width);
            prop_assert_eq!(points.len() as u64 + left_out as u64, all);
            prop_assert!(all <= length as u64);
        }
    }
}

#[test]
fn large_clouds_are_thinned_evenly() {
    assert_eq!(plain().points(6).unwrap().0.len(), 6);
    let (points, _) = plain().points(3).unwrap();
    assert_eq!(points, [expected()[0], expected()[2], expected()[4]]);
    assert_eq!(plain().points(0).unwrap().0.len(), 1);
}

#[test]
fn each_bad_layout_is_named() {
    let refused = |change: fn(&mut PointCloud2)| {
        let mut cloud = plain();
        change(&mut cloud);
        cloud.points(usize::MAX).unwrap_err()
    };
    let error = refused(|cloud| cloud.fields.retain(|field| field.name != "z"));
    assert_eq!(error.to_string(), "has no field z, only y, x; x, y and z are needed");
    assert_eq!(
        refused(|cloud| cloud.fields.clear()).to_string(),
        "has no field x, only none at all; x, y and z are needed"
    );
    let error = refused(|cloud| cloud.fields[0].datatype = 9);
    assert_eq!(error, CloudError::Datatype { field: 'z', datatype: 9 });
    let error = refused(|cloud| cloud.fields[1].offset = 13);
    assert_eq!(error, CloudError::Offset { field: 'y', size: 4, offset: 13, point_step: 16 });
    let error = refused(|cloud| cloud.row_step = 47);
    assert_eq!(error, CloudError::Row { row_step: 47, width: 3, point_step: 16 });
    let error = refused(|cloud| cloud.data.0.truncate(95));
    assert_eq!(error, CloudError::Data { found: 95, height: 2, row_step: 48 });
    let error = refused(|cloud| (cloud.height, cloud.width) = (1000, POINTS_MAX as u32 / 1000 + 1));
    assert!(matches!(error, CloudError::Points { .. }), "{error}");
    let error = refused(|cloud| (cloud.height, cloud.width) = (1000, POINTS_MAX as u32 / 1000));
    assert!(!matches!(error, CloudError::Points { .. }), "so many are read: {error}");
}

#[test]
fn what_drivers_leave_out_does_no_harm() {
    let mut cloud = plain();
    (cloud.height, cloud.width, cloud.row_step) = (1, 6, 0);
    assert_eq!(cloud.points(usize::MAX).unwrap().0, expected(), "no row_step of a single row");
    let mut padded = self::cloud([7; 3], [0; 3], 4, 5, false);
    padded.data.0.truncate(padded.data.0.len() - 5);
    assert_eq!(padded.points(usize::MAX).unwrap().0, expected(), "no padding behind the last row");
    let mut upper = plain();
    upper.fields.iter_mut().for_each(|field| field.name = field.name.to_uppercase());
    assert_eq!(upper.points(usize::MAX).unwrap().0, expected());
    (upper.height, upper.width) = (0, 3);
    upper.fields.clear();
    assert_eq!(upper.points(usize::MAX).unwrap(), (vec![], 0), "an empty cloud needs no fields");
}

#[test]
fn points_that_are_none_are_counted() {
    let mut cloud = plain();
    cloud.data.0[16..20].copy_from_slice(&f32::NAN.to_le_bytes());
    cloud.data.0[36..40].copy_from_slice(&f32::INFINITY.to_le_bytes());
    cloud.data.0[56..60].copy_from_slice(&1.1e7_f32.to_le_bytes());
    let (points, left_out) = cloud.points(usize::MAX).unwrap();
    assert_eq!((points, left_out), (vec![expected()[0], expected()[4], expected()[5]], 3));
    cloud.data.0[56..60].copy_from_slice(&1e7_f32.to_le_bytes());
    assert_eq!(cloud.points(usize::MAX).unwrap().1, 2, "the farthest that is taken");
    cloud.data.0[64..76].fill(0);
    assert_eq!(cloud.points(usize::MAX).unwrap().1, 3, "the origin itself is where nothing was measured");
    cloud.data.0[72..76].copy_from_slice(&1e-6_f32.to_le_bytes());
    assert_eq!(cloud.points(usize::MAX).unwrap().1, 2, "the nearest that is taken");
}

#[test]
fn rays_that_hit_nothing_are_counted() {
    let scan = LaserScan {
        header: Header::default(),
        angle_min: 0.0,
        angle_max: 0.0,
        angle_increment: core::f32::consts::FRAC_PI_2,
        time_increment: 0.0,
        scan_time: 0.0,
        range_min: 1.0,
        range_max: 4.0,
        ranges: vec![1.0, 2.0, 0.5, 4.5, f32::NAN, f32::INFINITY, -2.0, 4.0_f32.next_down(), 4.0],
        intensities: vec![],
    };
    let (points, missed) = scan.points();
    assert_eq!(missed, 6, "range_max itself is no hit");
    let near = |point: [f64; 3], to: [f64; 3]| point.iter().zip(to).all(|(a, b)| (a - b).abs() < 1e-5);
    assert!(near(points[0], [1.0, 0.0, 0.0]) && near(points[1], [0.0, 2.0, 0.0]) && near(points[2], [0.0, -4.0, 0.0]));
    let endless = LaserScan { range_max: f32::INFINITY, angle_increment: f32::NAN, ..scan };
    assert_eq!(endless.points().0.len(), 0, "a range without a direction is no point");
}

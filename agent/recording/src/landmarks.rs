//! Landmarks in clouds: a PLY whose vertices have, besides x, y, z, the properties `cxx cxy cxz cyy cyz czz` (the
//! covariance of the place, body frame, m²), and may have `label` (any integer type; negative for none) and `d0` to
//! `d31` (uchar: 256 bits; all zero for none).

use super::bounded::{Fault, read_bytes};
use super::error::{Problem, RecordingError};
use super::ply;
use crate::manifest::CloudFormat;
use merganser_protocol::geometry::Covariance;
use merganser_protocol::submap::Mark;
use merganser_protocol::submap::landmarks::{DESCRIPTOR_LEN, Descriptor};
use nalgebra::Matrix3;
use std::path::Path;

/// Properties of a covariance: its upper triangle, row by row.
const COVARIANCE: [&str; 6] = ["cxx", "cxy", "cxz", "cyy", "cyz", "czz"];

/// What the cloud at `path` says of its landmarks besides their places.
///
/// # Errors
/// [`RecordingError`]: no PLY, no covariances, or a covariance, label or descriptor that cannot be one.
pub(super) fn read(path: &Path, format: CloudFormat) -> Result<Vec<Mark>, RecordingError> {
    if format != CloudFormat::Ply {
        let why = "landmarks are read from PLY only; store the clouds as ply with cxx, cxy, cxz, cyy, cyz, czz";
        return Err(Problem::Ply(why.into()).of(path));
    }
    let refuse = |fault: Fault| RecordingError { path: path.into(), line: fault.line, problem: fault.problem };
    parse(&read_bytes(path)?).map_err(refuse)
}

fn parse(bytes: &[u8]) -> Result<Vec<Mark>, Fault> {
    let refuse = |why: String| Fault::from(Problem::Ply(why));
    let named: Vec<String> = (0..DESCRIPTOR_LEN).map(|k| format!("d{k}")).collect();
    let mut names: Vec<&str> = COVARIANCE.to_vec();
    names.push("label");
    names.extend(named.iter().map(String::as_str));
    let columns = ply::columns(bytes, &names)?;
    let (covariances, rest) = columns.split_at(COVARIANCE.len());
    let (labels, descriptors) = rest.split_at(1);
    let mut covariance = Vec::new();
    for (column, name) in covariances.iter().zip(COVARIANCE) {
        let missing = || refuse(format!("landmarks need the property {name}: state cxx, cxy, cxz, cyy, cyz, czz"));
        covariance.push(column.as_ref().ok_or_else(missing)?);
    }
    let described: Vec<&Vec<f64>> = descriptors.iter().flatten().collect();
    if !described.is_empty() && described.len() != DESCRIPTOR_LEN {
        return Err(refuse(format!("{} of the properties d0 to d31 are there; state all or none", described.len())));
    }
    let mark = |k: usize| -> Result<Mark, Fault> {
        let [xx, xy, xz, yy, yz, zz] = core::array::from_fn(|c| covariance[c].get(k).copied().unwrap_or(f64::NAN));
        let covariance = Covariance::new(Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz))
            .map_err(|error| refuse(format!("landmark {k} (counted from 0): {error}")))?;
        let label = match labels.iter().flatten().next().and_then(|labels| labels.get(k)) {
            None => None,
            Some(&label) if label < 0.0 => None,
            Some(&label) if label.fract() == 0.0 && label <= f64::from(u32::MAX) => Some(label as u32),
            Some(label) => {
                return Err(refuse(format!("landmark {k} (counted from 0): label {label} is no whole number")));
            }
        };
        let mut descriptor: Descriptor = [0; DESCRIPTOR_LEN];
        for (byte, column) in descriptor.iter_mut().zip(&described) {
            let value = column.get(k).copied().unwrap_or(f64::NAN);
            if !(0.0..=255.0).contains(&value) || value.fract() != 0.0 {
                return Err(refuse(format!("landmark {k} (counted from 0): {value} is no byte of a descriptor")));
            }
            *byte = value as u8;
        }
        Ok(Mark { covariance, label, descriptor: (descriptor != [0; DESCRIPTOR_LEN]).then_some(descriptor) })
    };
    (0..covariance[0].len()).map(mark).collect()
}

/// A binary PLY of landmarks.
///
/// # Errors
/// [`Problem::Ply`]: a label that an `int` does not hold.
pub(super) fn encode(points: &[[f32; 3]], marks: &[Mark]) -> Result<Vec<u8>, Problem> {
    let (labelled, described) = (marks.iter().any(|m| m.label.is_some()), marks.iter().any(|m| m.descriptor.is_some()));
    let mut properties: String = COVARIANCE.iter().map(|name| format!("property double {name}\n")).collect();
    if labelled {
        properties += "property int label\n";
    }
    if described {
        properties.extend((0..DESCRIPTOR_LEN).map(|k| format!("property uchar d{k}\n")));
    }
    let mut rows = Vec::new();
    for mark in marks {
        let m = mark.covariance.matrix();
        let upper = (0..3).flat_map(|row| (row..3).map(move |column| (row, column)));
        let mut row: Vec<u8> = upper.flat_map(|at| m[at].to_le_bytes()).collect();
        if labelled {
            let label = mark.label.map_or(Ok(-1), i32::try_from);
            let label = label.map_err(|_| Problem::Ply(format!("label {:?} is above {}", mark.label, i32::MAX)))?;
            row.extend(label.to_le_bytes());
        }
        if described {
            row.extend(mark.descriptor.unwrap_or_default());
        }
        rows.push(row);
    }
    Ok(ply::encode_with(points, &properties, rows.into_iter()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn marks() -> Vec<Mark> {
        let covariance = |k: f64| Covariance::new(Matrix3::new(k, 0.1, 0.0, 0.1, 2.0, 0.2, 0.0, 0.2, 3.0)).unwrap();
        vec![
            Mark { covariance: covariance(1.0), label: Some(72), descriptor: None },
            Mark { covariance: covariance(1.5), label: None, descriptor: Some([9; 32]) },
        ]
    }

    #[test]
    fn written_landmarks_read_back_to_the_bit() {
        let points = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]];
        let bytes = encode(&points, &marks()).unwrap();
        assert_eq!(parse(&bytes).ok().unwrap(), marks());
        assert_eq!(ply::parse(&bytes).ok().unwrap().points, points.map(|point| point.map(f64::from)));
        let large = Mark { label: Some(i32::MAX as u32 + 1), ..marks()[0] };
        assert!(encode(&points[..1], &[large]).is_err());
        assert!(encode(&points[..1], &[Mark { label: Some(i32::MAX as u32), ..large }]).is_ok());
    }

    #[test]
    fn text_reads_and_bad_landmarks_are_told() {
        let head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n";
        let covariance: String = COVARIANCE.iter().map(|name| format!("property float {name}\n")).collect();
        let whole = format!("{head}{covariance}property uint label\nend_header\n1 2 3 0.5 0 0 0.5 0 0.5 4000000000\n");
        let read = parse(whole.as_bytes()).ok().unwrap();
        assert_eq!((read.len(), read[0].label), (1, Some(4_000_000_000)));
        let cases = [
            (whole.replace("cyz", "foo"), "need the property cyz"),
            (whole.replace(" 0.5 0 0 ", " 0.5 9 0 "), "landmark 0 (counted from 0)"),
            (whole.replace("4000000000", "1.5"), "label 1.5 is no whole number"),
            (whole.replace("label", "d3"), "1 of the properties d0 to d31"),
        ];
        for (text, what) in cases {
            let told = parse(text.as_bytes()).err().unwrap().problem.to_string();
            assert!(told.contains(what), "{told}");
        }
    }
}

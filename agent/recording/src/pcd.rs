//! PCD clouds through `pcd-rs`. What the header claims is checked against the file before that library sees it, since
//! it allocates what a header asks for. An organised cloud (of more than one row) keeps its sensor's grid, with NaN or
//! infinity where nothing was measured: such points are left out. In any other they are a mistake.

use super::bounded::bounded;
use super::error::Problem;
use pcd_rs::{DataKind, DynReader, Field, PcdMeta};
use std::io::Cursor;

/// Bytes of one point at most, all fields together.
const RECORD_BYTES_MAX: u64 = 1024;

/// The x, y, z of each point.
pub(super) fn parse(bytes: &[u8]) -> Result<Vec<[f32; 3]>, Problem> {
    let mut cursor = Cursor::new(bytes);
    let meta = PcdMeta::from_reader(&mut cursor).map_err(told)?;
    let body = bytes.get(cursor.position() as usize..).unwrap_or_default();
    let count = bounded(meta.num_points)?;
    check_length(&meta, body, count)?;
    let columns = columns(&meta)?;
    let reader = DynReader::from_bytes(bytes).map_err(told)?;
    let is_organised = meta.height > 1;
    let mut points = Vec::with_capacity(count);
    for record in reader {
        let fields = record.map_err(told)?.0;
        let mut point = [0.0; 3];
        for (value, column) in point.iter_mut().zip(columns) {
            *value = match fields.get(column) {
                Some(Field::F32(values)) => values.first().copied().unwrap_or(f32::NAN),
                Some(Field::F64(values)) => values.first().map_or(f32::NAN, |v| *v as f32),
                _ => return Err(Problem::Pcd("the fields x, y, z must be floats".into())),
            };
        }
        if !is_organised || point.iter().all(|c| c.is_finite()) {
            points.push(point);
        }
    }
    if points.len() < count && is_organised {
        tracing::debug!(left_out = count - points.len(), of = count, "nothing was measured at some points of a PCD");
    }
    Ok(points)
}

/// Positions of x, y, z among the fields that are not padding.
fn columns(meta: &PcdMeta) -> Result<[usize; 3], Problem> {
    let names: Vec<&str> = meta.field_defs.iter().filter(|f| !f.is_padding()).map(|f| f.name.as_str()).collect();
    let mut columns = [0; 3];
    for (column, axis) in columns.iter_mut().zip(["x", "y", "z"]) {
        *column = names
            .iter()
            .position(|name| *name == axis)
            .ok_or_else(|| Problem::Pcd(format!("there is no field {axis:?} among FIELDS {}", names.join(" "))))?;
    }
    Ok(columns)
}

/// Compares the length that the header implies with what is there.
fn check_length(meta: &PcdMeta, body: &[u8], count: usize) -> Result<(), Problem> {
    let sizes = meta.field_defs.iter().map(|field| field.count.saturating_mul(field.kind.byte_size() as u64));
    let record = sizes.fold(0, u64::saturating_add);
    if record > RECORD_BYTES_MAX {
        return Err(Problem::Pcd(format!("a point has {record} bytes; at most {RECORD_BYTES_MAX} are read")));
    }
    let due = count * record as usize;
    let (found, expected) = match meta.data {
        DataKind::Ascii => return Ok(()),
        DataKind::Binary => (body.len(), due),
        DataKind::BinaryCompressed => {
            let Some((head, packed)) = body.split_at_checked(8) else {
                return Err(Problem::CloudLength { found: body.len(), expected: 8 });
            };
            let (words, _) = head.as_chunks::<4>();
            let [packed_due, unpacked] = [0, 1].map(|i| u32::from_le_bytes(words[i]) as usize);
            if unpacked != due {
                return Err(Problem::Pcd(format!("unpacks to {unpacked} bytes where {due} are due")));
            }
            (packed.len(), packed_due)
        }
    };
    if found < expected {
        return Err(Problem::CloudLength { found, expected });
    }
    Ok(())
}

fn told(error: pcd_rs::Error) -> Problem {
    Problem::Pcd(error.to_string())
}

#[cfg(test)]
mod tests {
    use super::super::limits::POINTS_MAX;
    use super::*;
    use pcd_rs::{DynRecord, Schema, ValueKind, WriterInit};

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
            let points = parse(&written(kind, 40)).unwrap();
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
            assert_eq!(parse(&bytes).unwrap(), [[1.0, 2.0, 3.0]]);
        }
        for bytes in cloud(4, 1) {
            let points = parse(&bytes).unwrap();
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
        assert!(matches!(parse(over.as_bytes()), Err(Problem::CloudPoints(_))));
        let short = head("x y z", "4 4 4", POINTS_MAX as u64, "binary");
        assert!(matches!(parse(short.as_bytes()), Err(Problem::CloudLength { found: 0, .. })));
        let mut bomb = head("x y z", "4 4 4", 1, "binary_compressed").into_bytes();
        bomb.extend(4u32.to_le_bytes());
        bomb.extend(u32::MAX.to_le_bytes());
        bomb.extend([0; 4]);
        assert!(matches!(parse(&bomb), Err(Problem::Pcd(why)) if why.contains("unpacks")));
        let flat = head("x y", "4 4", 1, "ascii") + "1 2\n";
        assert!(matches!(parse(flat.as_bytes()), Err(Problem::Pcd(why)) if why.contains("\"z\"")));
        let wide = head("x y z", "4 4 4", 1, "binary").replace("COUNT 1 1 1", "COUNT 1 1 999999999");
        assert!(matches!(parse(wide.as_bytes()), Err(Problem::Pcd(why)) if why.contains("bytes")));
    }
}

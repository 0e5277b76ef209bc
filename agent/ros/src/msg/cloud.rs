//! `sensor_msgs/PointCloud2` and its points: any layout of fields, any type of number, both byte orders, rows with
//! padding.

use super::{Header, message};
use crate::limits::{COORDINATE_MAX, POINTS_MAX};
use crate::wire::Blob;
use thiserror::Error;

message! {
    /// `sensor_msgs/PointField`.
    PointField {
        /// Such as `x`.
        name: String,
        /// Bytes from the beginning of a point.
        offset: u32,
        /// 1 to 8: signed and unsigned numbers of 1, 2 and 4 bytes, then floats of 4 and 8.
        datatype: u8,
        /// Numbers; 0 is taken for 1.
        count: u32,
    }
}

message! {
    /// `sensor_msgs/PointCloud2`.
    PointCloud2 = "sensor_msgs/PointCloud2" {
        /// When, and the frame of the points.
        header: Header,
        /// Rows; 1 if the cloud has no order.
        height: u32,
        /// Points of a row.
        width: u32,
        /// What a point consists of.
        fields: Vec<PointField>,
        /// Whether numbers are big-endian.
        is_bigendian: bool,
        /// Bytes of a point.
        point_step: u32,
        /// Bytes of a row.
        row_step: u32,
        /// The points, row by row.
        data: Blob,
        /// Whether all points are finite.
        is_dense: bool,
    }
}

/// Why a cloud has no points that can be used.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum CloudError {
    /// A coordinate is missing.
    #[error("has no field {missing}, only {names}; x, y and z are needed")]
    Field {
        /// Which.
        missing: char,
        /// Those that are there.
        names: String,
    },
    /// A coordinate is of no known type.
    #[error("field {field}: datatype {datatype} is none of 1 to 8")]
    Datatype {
        /// Which.
        field: char,
        /// As stated.
        datatype: u8,
    },
    /// A coordinate lies beyond its point.
    #[error("field {field}: {size} bytes at {offset} do not lie within point_step = {point_step}")]
    Offset {
        /// Which.
        field: char,
        /// Bytes of the number.
        size: usize,
        /// As stated.
        offset: u32,
        /// As stated.
        point_step: u32,
    },
    /// Rows are shorter than their points.
    #[error("row_step = {row_step} is less than width × point_step = {width} × {point_step}")]
    Row {
        /// As stated.
        row_step: u32,
        /// As stated.
        width: u32,
        /// As stated.
        point_step: u32,
    },
    /// The data do not hold what height and width claim.
    #[error("{found} bytes of data, where {height} rows of {row_step} bytes are due")]
    Data {
        /// Bytes that are there.
        found: usize,
        /// As stated.
        height: u32,
        /// As stated.
        row_step: u32,
    },
    /// Too many points.
    #[error("{height} × {width} points; at most {POINTS_MAX} (POINTS_MAX) are read")]
    Points {
        /// Rows.
        height: u32,
        /// Points of a row.
        width: u32,
    },
}

/// One coordinate of a point.
#[derive(Clone, Copy)]
struct Coordinate {
    offset: usize,
    datatype: u8,
}

impl PointCloud2 {
    /// The points in the cloud's frame, m, and how many were left out for being not finite or the origin itself (both
    /// are written where nothing was measured), or beyond [`COORDINATE_MAX`]. Of clouds of more than `kept_max` points every second, third… is read.
    ///
    /// # Errors
    /// [`CloudError`].
    pub fn points(&self, kept_max: usize) -> Result<(Vec<[f64; 3]>, usize), CloudError> {
        let (height, width) = (self.height, self.width);
        let all = u64::from(height) * u64::from(width);
        if all > POINTS_MAX as u64 {
            return Err(CloudError::Points { height, width });
        }
        if all == 0 {
            return Ok((Vec::new(), 0));
        }
        let coordinates = [self.coordinate('x')?, self.coordinate('y')?, self.coordinate('z')?];
        let (point_step, row_step) = (self.point_step, self.row_step);
        let row_len = u64::from(width) * u64::from(point_step);
        // Some drivers leave the row's length of a single row at 0.
        let row_step = if height == 1 && u64::from(row_step) < row_len { row_len } else { u64::from(row_step) };
        if row_step < row_len {
            return Err(CloudError::Row { row_step: self.row_step, width, point_step });
        }
        // The last row may come without its padding.
        let due = row_step * u64::from(height - 1) + row_len;
        let found = self.data.0.len();
        if (found as u64) < due {
            return Err(CloudError::Data { found, height, row_step: self.row_step });
        }
        // All products are within `data` now.
        let stride = (all as usize).div_ceil(kept_max.max(1));
        let mut points = Vec::with_capacity((all as usize).div_ceil(stride));
        let mut left_out = 0;
        for index in (0..all as usize).step_by(stride) {
            let (row, column) = (index / width as usize, index % width as usize);
            let at = row * row_step as usize + column * point_step as usize;
            let point = coordinates.map(|coordinate| self.number(at, coordinate));
            if point.iter().all(|x| x.abs() <= COORDINATE_MAX) && point != [0.0; 3] {
                points.push(point);
            } else {
                left_out += 1;
            }
        }
        Ok((points, left_out))
    }

    fn coordinate(&self, name: char) -> Result<Coordinate, CloudError> {
        let names = |field: &PointField, upper: bool| {
            let name = if upper { name.to_ascii_uppercase() } else { name };
            field.name.chars().eq([name])
        };
        let field = self.fields.iter().find(|field| names(field, false));
        let field = field.or_else(|| self.fields.iter().find(|field| names(field, true)));
        let Some(PointField { offset, datatype, .. }) = field else {
            let names = self.fields.iter().take(16).map(|field| field.name.chars().take(32).collect::<String>());
            let names = match names.collect::<Vec<_>>().join(", ") {
                none if none.is_empty() => "none at all".into(),
                names => names,
            };
            return Err(CloudError::Field { missing: name, names });
        };
        let (offset, datatype) = (*offset, *datatype);
        let size = match datatype {
            1 | 2 => 1,
            3 | 4 => 2,
            5..=7 => 4,
            8 => 8,
            _ => return Err(CloudError::Datatype { field: name, datatype }),
        };
        if offset as u64 + size as u64 > u64::from(self.point_step) {
            return Err(CloudError::Offset { field: name, size, offset, point_step: self.point_step });
        }
        Ok(Coordinate { offset: offset as usize, datatype })
    }

    /// NaN if it lay outside the data, which it does not.
    fn number(&self, point: usize, Coordinate { offset, datatype }: Coordinate) -> f64 {
        let at = point + offset;
        match datatype {
            1 => self.bytes::<1>(at).map_or(f64::NAN, |b| f64::from(i8::from_le_bytes(b))),
            2 => self.bytes::<1>(at).map_or(f64::NAN, |b| f64::from(u8::from_le_bytes(b))),
            3 => self.bytes::<2>(at).map_or(f64::NAN, |b| f64::from(i16::from_le_bytes(b))),
            4 => self.bytes::<2>(at).map_or(f64::NAN, |b| f64::from(u16::from_le_bytes(b))),
            5 => self.bytes::<4>(at).map_or(f64::NAN, |b| f64::from(i32::from_le_bytes(b))),
            6 => self.bytes::<4>(at).map_or(f64::NAN, |b| f64::from(u32::from_le_bytes(b))),
            7 => self.bytes::<4>(at).map_or(f64::NAN, |b| f64::from(f32::from_le_bytes(b))),
            _ => self.bytes::<8>(at).map_or(f64::NAN, f64::from_le_bytes),
        }
    }

    /// Low byte first.
    fn bytes<const N: usize>(&self, at: usize) -> Option<[u8; N]> {
        let mut bytes = *self.data.0.get(at..)?.first_chunk::<N>()?;
        if self.is_bigendian {
            bytes.reverse();
        }
        Some(bytes)
    }
}

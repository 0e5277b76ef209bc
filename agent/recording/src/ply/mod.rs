//! PLY clouds: ASCII and binary of either byte order, the `vertex` element's x, y, z. A small strict reader of our own,
//! since no maintained library reads PLY; other properties (lists, too) and other elements are passed over. Lines end as
//! the first does, and empty ones and comments do not matter.

mod body;
mod header;
#[cfg(test)]
mod tests;

use super::axes;
use super::bounded::{Fault, Read};
use super::error::Problem;
use super::remark::Remark;
use super::text::Lines;
use header::{Header, Kind};

/// The x, y, z of each vertex.
pub(super) fn parse(bytes: &[u8]) -> Result<Read, Fault> {
    let mut lines = Lines::of(bytes);
    let header = header::read(&mut lines)?;
    let axes = axes::of(&names(&header)).map_err(|axis| {
        let names: Vec<&str> = header.vertices.properties.iter().map(|property| property.name.as_str()).collect();
        Problem::Ply(format!("the vertices have no property {axis}, only: {}", names.join(" ")))
    })?;
    let is_whole = |axis: &usize| match header.vertices.properties[*axis].kind {
        Kind::One(scalar) => scalar.is_whole(),
        Kind::List(..) => false,
    };
    let whole = axes.iter().any(is_whole);
    let mut points = Vec::new();
    body::rows(&header, &mut lines, &axes, |row| points.push([row[0], row[1], row[2]]))?;
    Ok(Read { points, remarks: whole.then_some(Remark::Whole).into_iter().collect() })
}

/// Names of the vertices' properties; a list is none that a number could be sought by.
fn names(header: &Header) -> Vec<&str> {
    let properties = header.vertices.properties.iter();
    let names = properties.map(|property| match property.kind {
        Kind::One(_) => property.name.as_str(),
        Kind::List(..) => "",
    });
    names.collect()
}

/// The values of the named properties, vertex by vertex; of those that the vertices do not have, `None`.
pub(super) fn columns(bytes: &[u8], wanted: &[&str]) -> Result<Vec<Option<Vec<f64>>>, Fault> {
    let mut lines = Lines::of(bytes);
    let header = header::read(&mut lines)?;
    let names = names(&header);
    let places: Vec<Option<usize>> =
        wanted.iter().map(|name| names.iter().position(|property| property == name)).collect();
    let mut columns: Vec<Option<Vec<f64>>> = places.iter().map(|place| place.map(|_| Vec::new())).collect();
    let there: Vec<usize> = places.into_iter().flatten().collect();
    body::rows(&header, &mut lines, &there, |row| {
        for (column, value) in columns.iter_mut().flatten().zip(row) {
            column.push(*value);
        }
    })?;
    Ok(columns)
}

/// A binary little-endian PLY of x, y, z as floats.
pub(super) fn encode(points: &[[f32; 3]]) -> Vec<u8> {
    let mut bytes = head(points.len(), None, "");
    bytes.extend(points.iter().flatten().flat_map(|c| c.to_le_bytes()));
    bytes
}

/// A binary little-endian PLY of coloured points: x, y, z as floats; red, green, blue as bytes. `comment` is one line.
pub fn encode_coloured<'a>(
    count: usize,
    points: impl Iterator<Item = (&'a [f32; 3], [u8; 3])>,
    comment: Option<&str>,
) -> Vec<u8> {
    let mut bytes = head(count, comment, "property uchar red\nproperty uchar green\nproperty uchar blue\n");
    for (point, colour) in points {
        bytes.extend(point.iter().flat_map(|c| c.to_le_bytes()));
        bytes.extend(colour);
    }
    bytes
}

/// A binary little-endian PLY of x, y, z as floats and further properties, whose values are `more`, vertex by vertex.
pub(super) fn encode_with(points: &[[f32; 3]], properties: &str, more: impl Iterator<Item = Vec<u8>>) -> Vec<u8> {
    let mut bytes = head(points.len(), None, properties);
    for (point, more) in points.iter().zip(more) {
        bytes.extend(point.iter().flat_map(|c| c.to_le_bytes()));
        bytes.extend(more);
    }
    bytes
}

fn head(count: usize, comment: Option<&str>, more: &str) -> Vec<u8> {
    let comment = comment.map_or(String::new(), |text| format!("comment {text}\n"));
    format!(
        "ply\nformat binary_little_endian 1.0\n{comment}element vertex {count}\n\
         property float x\nproperty float y\nproperty float z\n{more}end_header\n"
    )
    .into_bytes()
}

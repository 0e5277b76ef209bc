//! PCD clouds, as PCL and the LiDARs' drivers write them. A strict reader of our own: libraries take a field of `COUNT`
//! 0, with which drivers pad, for one of 1, and tell neither line nor field. An organised cloud (of more than one row)
//! keeps its sensor's grid, with NaN or infinity where nothing was measured: such points are left out. In any other they
//! are a mistake.
//!
//! `VIEWPOINT` is not applied, and told where it is not the identity: to some programs it says where the sensor stood in
//! the frame of the points, to others where points in the sensor's frame belong, and a file does not tell which.

mod header;
#[cfg(test)]
mod tests;

use super::bounded::{Fault, Read};
use super::error::Problem;
use super::remark::Remark;
use super::scalar::Order;
use super::text::Lines;
use super::{axes, lzf};
use header::{Data, Field, Header};

/// How far a number of `VIEWPOINT` may be from the identity's before it says something.
const VIEWPOINT_SLACK: f64 = 1e-6;

/// The x, y, z of each point.
pub(super) fn parse(bytes: &[u8]) -> Result<Read, Fault> {
    let mut lines = Lines::of(bytes);
    let header = header::read(&mut lines)?;
    let columns = columns(&header)?;
    let mut points = match header.data {
        Data::Ascii => ascii(&header, columns, &mut lines)?,
        Data::Binary => {
            let record = record(&header);
            let due = header.points * record;
            let body = lines.rest().get(..due);
            let body = body.ok_or(Problem::CloudLength { found: lines.rest().len(), expected: due })?;
            picked(&header, columns, body, |column| (offset(&header, column), record))
        }
        Data::Compressed => {
            let body = unpacked(&header, lines.rest())?;
            // Field by field, each with the values of all points.
            let place = |column: usize| (offset(&header, column) * header.points, header.fields[column].bytes());
            picked(&header, columns, &body, place)
        }
    };
    if header.height > 1 {
        let all = points.len();
        points.retain(|point| point.iter().all(|c| c.is_finite()));
        let left_out = all - points.len();
        tracing::debug!(left_out, of = all, "nothing was measured at some points of a PCD");
    }
    let whole = columns.iter().any(|column| header.fields[*column].scalar.is_whole());
    let remarks = viewpoint(&header).into_iter().chain(whole.then_some(Remark::Whole)).collect();
    Ok(Read { points, remarks })
}

/// Which fields x, y, z are.
fn columns(header: &Header) -> Result<[usize; 3], Problem> {
    let names: Vec<&str> = header.fields.iter().map(|f| if f.count == 0 { "" } else { f.name.as_str() }).collect();
    axes::of(&names).map_err(|axis| {
        let fields: Vec<&str> = header.fields.iter().map(|field| field.name.as_str()).collect();
        Problem::Pcd(format!("there is no field {axis:?} among FIELDS {}", fields.join(" ")))
    })
}

/// Bytes of one point.
fn record(header: &Header) -> usize {
    offset(header, header.fields.len())
}

/// Bytes of the fields before this one.
fn offset(header: &Header, column: usize) -> usize {
    header.fields.iter().take(column).map(Field::bytes).sum()
}

/// The values of three columns: of each the first at an offset, the others a stride apart.
fn picked(header: &Header, columns: [usize; 3], body: &[u8], place: impl Fn(usize) -> (usize, usize)) -> Vec<[f64; 3]> {
    let value = |k: usize, column: usize| {
        let ((first, stride), scalar) = (place(column), header.fields[column].scalar);
        let begin = first + k * stride;
        body.get(begin..begin + scalar.bytes()).map_or(f64::NAN, |bytes| scalar.value(bytes, Order::Little))
    };
    (0..header.points).map(|k| columns.map(|column| value(k, column))).collect()
}

fn ascii(header: &Header, columns: [usize; 3], lines: &mut Lines<'_>) -> Result<Vec<[f64; 3]>, Fault> {
    let due: usize = header.fields.iter().map(|field| field.count).sum();
    let place = |column: usize| header.fields.iter().take(column).map(|field| field.count).sum::<usize>();
    let places = columns.map(place);
    let mut points = Vec::new();
    while let Some(line) = lines.full() {
        let fault = |why: String| Fault { line: Some(lines.number), problem: Problem::Pcd(why) };
        let text = str::from_utf8(line).map_err(|_| fault("is no text".into()))?;
        if text.starts_with('#') {
            continue;
        }
        let (index, words) = (points.len(), text.split_ascii_whitespace().collect::<Vec<_>>());
        if index == header.points {
            return Err(fault(format!("there is more after the {index} points of the header")));
        }
        if words.len() != due {
            let found = words.len();
            return Err(fault(format!("point {index} has {found} values instead of {due}; was the file cut off?")));
        }
        let mut point = [0.0; 3];
        for (value, place) in point.iter_mut().zip(places) {
            *value = words[place].parse().map_err(|_| fault(format!("{:?} is not a number", words[place])))?;
        }
        points.push(point);
    }
    if points.len() == header.points {
        return Ok(points);
    }
    let why = format!("has {} points where POINTS states {}; was the file cut off?", points.len(), header.points);
    Err(Fault { line: Some(lines.number), problem: Problem::Pcd(why) })
}

/// What a compressed cloud unpacks to: four bytes say how long it is packed, four how long unpacked.
fn unpacked(header: &Header, body: &[u8]) -> Result<Vec<u8>, Problem> {
    let due = header.points * record(header);
    let Some((head, packed)) = body.split_at_checked(8) else {
        return Err(Problem::CloudLength { found: body.len(), expected: 8 });
    };
    let (words, _) = head.as_chunks::<4>();
    let [packed_due, unpacked] = [0, 1].map(|i| u32::from_le_bytes(words[i]) as usize);
    if unpacked != due {
        return Err(Problem::Pcd(format!("unpacks to {unpacked} bytes where {due} are due")));
    }
    let cut = || Problem::CloudLength { found: packed.len(), expected: packed_due };
    let packed = packed.get(..packed_due).ok_or_else(cut)?;
    lzf::unpack(packed, due).ok_or_else(|| Problem::Pcd("the compressed points are damaged; write them again".into()))
}

/// Says that a sensor's place is stated, which is not applied.
fn viewpoint(header: &Header) -> Option<Remark> {
    let stated = header.viewpoint?;
    let [x, y, z, _, qx, qy, qz] = stated;
    // A turn by −q is one by q, and some write only zeros for none: the vector part tells.
    let is_identity = [x, y, z, qx, qy, qz].iter().all(|number| number.abs() <= VIEWPOINT_SLACK);
    (!is_identity).then(|| Remark::Viewpoint(stated.map(|number| number.to_string()).join(" ")))
}

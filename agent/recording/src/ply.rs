//! PLY clouds: ASCII and binary little-endian, the `vertex` element's x, y, z. A small strict reader of our own, since
//! no maintained library reads PLY; the other properties and later elements are skipped.

use super::bounded::{Fault, bounded};
use super::error::Problem;
use std::ops::Range;

/// Lines of a header at most.
const HEADER_LINES_MAX: usize = 1000;

/// How one scalar is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scalar {
    Int(usize, Sign),
    F32,
    F64,
}

/// Whether an integer may be negative.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sign {
    Signed,
    Unsigned,
}

impl Scalar {
    fn parse(text: &str) -> Option<Self> {
        Some(match text {
            "char" | "int8" => Self::Int(1, Sign::Signed),
            "uchar" | "uint8" => Self::Int(1, Sign::Unsigned),
            "short" | "int16" => Self::Int(2, Sign::Signed),
            "ushort" | "uint16" => Self::Int(2, Sign::Unsigned),
            "int" | "int32" => Self::Int(4, Sign::Signed),
            "uint" | "uint32" => Self::Int(4, Sign::Unsigned),
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::Int(bytes, _) => bytes,
            Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The value of its bytes, little-endian.
    fn value(self, bytes: &[u8]) -> f64 {
        match (self, bytes) {
            (Self::F32, &[a, b, c, d]) => f64::from(f32::from_le_bytes([a, b, c, d])),
            (Self::F64, &[a, b, c, d, e, f, g, h]) => f64::from_le_bytes([a, b, c, d, e, f, g, h]),
            (Self::Int(_, Sign::Signed), &[a]) => f64::from(a.cast_signed()),
            (Self::Int(_, Sign::Signed), &[a, b]) => f64::from(i16::from_le_bytes([a, b])),
            (Self::Int(_, Sign::Signed), &[a, b, c, d]) => f64::from(i32::from_le_bytes([a, b, c, d])),
            (Self::Int(_, Sign::Unsigned), &[a]) => f64::from(a),
            (Self::Int(_, Sign::Unsigned), &[a, b]) => f64::from(u16::from_le_bytes([a, b])),
            (Self::Int(_, Sign::Unsigned), &[a, b, c, d]) => f64::from(u32::from_le_bytes([a, b, c, d])),
            _ => f64::NAN,
        }
    }
}

/// What a header says.
struct Header {
    binary: bool,
    vertices: usize,
    /// The vertex element's properties, in order.
    properties: Vec<(String, Scalar)>,
    /// First byte after the header.
    body: usize,
    /// Lines of the header.
    lines: usize,
    /// Whether other elements follow the vertices.
    more: bool,
}

/// The x, y, z of each vertex.
pub(super) fn parse(bytes: &[u8]) -> Result<Vec<[f32; 3]>, Fault> {
    let header = header(bytes)?;
    let body = &bytes[header.body..];
    if header.binary { Ok(binary(&header, body)?) } else { ascii(&header, body) }
}

fn header(bytes: &[u8]) -> Result<Header, Fault> {
    let mut header = Header { binary: false, vertices: 0, properties: Vec::new(), body: 0, lines: 0, more: false };
    let (mut format, mut vertex, mut elements) = (None, None, 0);
    loop {
        header.lines += 1;
        let line = header.lines;
        let fault = |problem| Fault { line: Some(line), problem };
        let refuse = |what: String| Err(fault(Problem::Ply(what)));
        let rest = &bytes[header.body..];
        let Some(end) = rest.iter().position(|b| *b == b'\n').filter(|_| line <= HEADER_LINES_MAX) else {
            return refuse("the PLY header does not end with \"end_header\"".into());
        };
        header.body += end + 1;
        let Ok(text) = str::from_utf8(&rest[..end]) else {
            return refuse("the PLY header is not text".into());
        };
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        match (line, words.as_slice()) {
            (1, ["ply"]) => {}
            (1, _) => return refuse("this is no PLY file; the first line must be \"ply\"".into()),
            (_, [] | ["comment" | "obj_info", ..]) => {}
            (_, ["format", name, "1.0"]) => match *name {
                "ascii" => format = Some(false),
                "binary_little_endian" => format = Some(true),
                _ => return refuse(format!("format {name} is not read; write ascii or binary_little_endian")),
            },
            (_, ["element", name, count]) => {
                let Ok(count) = count.parse() else {
                    return refuse(format!("{count:?} is not a number of elements"));
                };
                if *name == "vertex" {
                    if elements != 0 {
                        return refuse("the first element must be vertex".into());
                    }
                    vertex = Some(bounded(count).map_err(fault)?);
                }
                elements += 1;
            }
            // Properties of later elements do not matter: their data come after the vertices'.
            (_, ["property", ..]) if elements > 1 => {}
            (_, ["property", kind, name]) if elements == 1 => match Scalar::parse(kind) {
                Some(scalar) => header.properties.push(((*name).to_owned(), scalar)),
                None => return refuse(format!("{kind} is no type of PLY")),
            },
            (_, ["property", "list", ..]) => return refuse("a vertex with a list property is not read".into()),
            (_, ["end_header"]) => break,
            _ => {
                return refuse(format!(
                    "{:?} does not belong in a PLY header",
                    text.chars().take(40).collect::<String>()
                ));
            }
        }
    }
    header.binary = format.ok_or_else(|| Problem::Ply("the PLY header has no format line".into()))?;
    header.vertices = vertex.ok_or_else(|| Problem::Ply("the PLY header has no vertex element".into()))?;
    header.more = elements > 1;
    Ok(header)
}

impl Header {
    /// Which property each of x, y, z is.
    fn axes(&self) -> Result<[usize; 3], Problem> {
        let mut axes = [0; 3];
        for (axis, name) in axes.iter_mut().zip(["x", "y", "z"]) {
            let is_axis =
                |(property, scalar): &(String, Scalar)| property == name && !matches!(scalar, Scalar::Int(..));
            *axis =
                self.properties.iter().position(is_axis).ok_or_else(|| {
                    Problem::Ply(format!("the vertices have no property {name} of type float or double"))
                })?;
        }
        Ok(axes)
    }
}

fn binary(header: &Header, body: &[u8]) -> Result<Vec<[f32; 3]>, Problem> {
    let axes = header.axes()?;
    let offset = |property: usize| header.properties[..property].iter().map(|(_, s)| s.bytes()).sum::<usize>();
    let spans: [Range<usize>; 3] = axes.map(|axis| offset(axis)..offset(axis) + header.properties[axis].1.bytes());
    let record = offset(header.properties.len());
    let expected = header.vertices.saturating_mul(record);
    if body.len() < expected || (body.len() > expected && !header.more) {
        return Err(Problem::CloudLength { found: body.len(), expected });
    }
    let scalar = |bytes: &[u8]| match *bytes {
        [a, b, c, d] => f32::from_le_bytes([a, b, c, d]),
        [a, b, c, d, e, f, g, h] => f64::from_le_bytes([a, b, c, d, e, f, g, h]) as f32,
        _ => f32::NAN,
    };
    let point = |bytes: &[u8]| spans.clone().map(|span| scalar(&bytes[span]));
    Ok(body[..expected].chunks_exact(record).map(point).collect())
}

fn ascii(header: &Header, body: &[u8]) -> Result<Vec<[f32; 3]>, Fault> {
    let axes = header.axes()?;
    let mut lines = body.split(|b| *b == b'\n');
    let mut points = Vec::new();
    for index in 0..header.vertices {
        let line = Some(header.lines + index + 1);
        let refuse = |why: String| Fault { line, problem: Problem::Ply(why) };
        let text = lines.next().and_then(|line| str::from_utf8(line).ok()).unwrap_or_default();
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        if words.len() != header.properties.len() {
            let (found, due) = (words.len(), header.properties.len());
            return Err(refuse(format!("vertex {index} has {found} values instead of {due}; was the file cut off?")));
        }
        let mut point = [0.0; 3];
        for (value, axis) in point.iter_mut().zip(axes) {
            *value = words[axis].parse().map_err(|_| refuse(format!("{:?} is not a number", words[axis])))?;
        }
        points.push(point);
    }
    if !header.more && lines.any(|line| !line.trim_ascii().is_empty()) {
        return Err(Problem::Ply(format!("there is more after the {} vertices of the header", header.vertices)).into());
    }
    Ok(points)
}

/// The values of the named properties, vertex by vertex; of those that the vertices do not have, `None`. The file is
/// one that [`parse`] reads.
pub(super) fn columns(bytes: &[u8], names: &[&str]) -> Result<Vec<Option<Vec<f64>>>, Fault> {
    let header = header(bytes)?;
    let body = &bytes[header.body..];
    let words: Vec<Vec<&str>> = if header.binary {
        Vec::new()
    } else {
        let line = |line| str::from_utf8(line).unwrap_or_default().split_ascii_whitespace().collect();
        body.split(|b| *b == b'\n').take(header.vertices).map(line).collect()
    };
    let offset = |property: usize| header.properties[..property].iter().map(|(_, s)| s.bytes()).sum::<usize>();
    let record = offset(header.properties.len()).max(1);
    let column = |name: &&str| -> Option<Vec<f64>> {
        let property = header.properties.iter().position(|(property, _)| property == name)?;
        let (begin, scalar) = (offset(property), header.properties[property].1);
        let in_record = |bytes: &[u8]| bytes.get(begin..begin + scalar.bytes()).map_or(f64::NAN, |b| scalar.value(b));
        let in_line = |words: &Vec<&str>| words.get(property).and_then(|word| word.parse().ok()).unwrap_or(f64::NAN);
        Some(if header.binary {
            body.chunks_exact(record).take(header.vertices).map(in_record).collect()
        } else {
            words.iter().map(in_line).collect()
        })
    };
    Ok(names.iter().map(column).collect())
}

/// A binary little-endian PLY of x, y, z as floats.
pub(super) fn encode(points: &[[f32; 3]]) -> Vec<u8> {
    let mut bytes = head(points.len(), "");
    bytes.extend(points.iter().flatten().flat_map(|c| c.to_le_bytes()));
    bytes
}

/// A binary little-endian PLY of coloured points: x, y, z as floats; red, green, blue as bytes.
pub fn encode_coloured<'a>(count: usize, points: impl Iterator<Item = (&'a [f32; 3], [u8; 3])>) -> Vec<u8> {
    let mut bytes = head(count, "property uchar red\nproperty uchar green\nproperty uchar blue\n");
    for (point, colour) in points {
        bytes.extend(point.iter().flat_map(|c| c.to_le_bytes()));
        bytes.extend(colour);
    }
    bytes
}

/// A binary little-endian PLY of x, y, z as floats and further properties, whose values are `more`, vertex by vertex.
pub(super) fn encode_with(points: &[[f32; 3]], properties: &str, more: impl Iterator<Item = Vec<u8>>) -> Vec<u8> {
    let mut bytes = head(points.len(), properties);
    for (point, more) in points.iter().zip(more) {
        bytes.extend(point.iter().flat_map(|c| c.to_le_bytes()));
        bytes.extend(more);
    }
    bytes
}

fn head(count: usize, more: &str) -> Vec<u8> {
    format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n\
         property float x\nproperty float y\nproperty float z\n{more}end_header\n"
    )
    .into_bytes()
}

#[cfg(test)]
mod tests {
    use super::super::limits::POINTS_MAX;
    use super::*;

    const ASCII: &str = "ply\nformat ascii 1.0\ncomment c\nelement vertex 2\nproperty uchar red\nproperty double x\n\
                         property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\n\
                         end_header\n1 0.5 2 3\n2 -1 1e-3 4\n3 0 1 2\n";

    fn told(text: &str) -> (Option<usize>, String) {
        let fault = parse(text.as_bytes()).err().unwrap();
        (fault.line, fault.problem.to_string())
    }

    #[test]
    fn ascii_with_other_properties_and_elements_reads() {
        assert_eq!(parse(ASCII.as_bytes()).ok().unwrap(), [[0.5, 2.0, 3.0], [-1.0, 1e-3, 4.0]]);
        assert_eq!(parse(ASCII.replace('\n', "\r\n").as_bytes()).ok().unwrap().len(), 2);
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
        assert_eq!(parse(&bytes).ok().unwrap(), [[0.5, 0.0, 0.0], [1.5, 1.0, -1.0]]);
        let coloured = encode_coloured(2, [([1.0, 2.0, 3.0], [9; 3]), ([4.0; 3], [1; 3])].iter().map(|(p, c)| (p, *c)));
        assert_eq!(parse(&coloured).ok().unwrap(), [[1.0, 2.0, 3.0], [4.0; 3]]);
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
            (&ASCII.replace("format ascii", "format binary_big_endian"), Some(2), "binary_big_endian"),
            (&ASCII.replace("vertex 2", "vertex two"), Some(4), "not a number of elements"),
            (&ASCII.replace("double x", "double u"), None, "no property x"),
            (&ASCII.replace("double x", "int x"), None, "no property x"),
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
}

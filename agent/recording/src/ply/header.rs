//! The head of a PLY file: its elements, what each holds, and how they are stored.

use super::super::bounded::{Fault, bounded};
use super::super::error::Problem;
use super::super::scalar::{Order, Scalar};
use super::super::text::Lines;

/// Lines of a header at most.
const LINES_MAX: usize = 1000;

/// How a property is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    One(Scalar),
    /// How many there are, then each.
    List(Scalar, Scalar),
}

/// A property of an element.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Property {
    pub name: String,
    pub kind: Kind,
}

/// A kind of thing of which the file has a number.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Element {
    pub count: usize,
    pub properties: Vec<Property>,
}

impl Element {
    /// Bytes of one, if it has no list.
    pub fn bytes(&self) -> Option<usize> {
        let bytes = |property: &Property| match property.kind {
            Kind::One(scalar) => Some(scalar.bytes()),
            Kind::List(..) => None,
        };
        self.properties.iter().map(bytes).sum()
    }
}

/// What a header says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Header {
    /// How numbers are stored; `None` as text.
    pub binary: Option<Order>,
    /// Elements before the vertices.
    pub before: Vec<Element>,
    pub vertices: Element,
    /// Whether other elements follow the vertices.
    pub more: bool,
}

/// The header as far as it is read.
#[derive(Default)]
struct Draft {
    format: Option<Option<Order>>,
    elements: Vec<Element>,
    vertex: Option<usize>,
}

/// Reads the lines up to `end_header`.
pub fn read(lines: &mut Lines<'_>) -> Result<Header, Fault> {
    let mut draft = Draft::default();
    loop {
        let line = lines.ended().filter(|_| lines.number <= LINES_MAX);
        let at = lines.number.max(1);
        let fault = |problem| Fault { line: Some(at), problem };
        let refuse = |what: &str| Err(fault(Problem::Ply(what.into())));
        let Some(line) = line else {
            return refuse("the PLY header does not end with \"end_header\"");
        };
        let Ok(text) = str::from_utf8(line) else {
            return refuse("the PLY header is not text");
        };
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        match (at, words.as_slice()) {
            (1, ["ply"]) | (2.., [] | ["comment" | "obj_info", ..]) => {}
            (1, _) => return refuse("this is no PLY file; the first line must be \"ply\""),
            (_, ["end_header"]) => return draft.finish().map_err(fault),
            (_, words) => draft.take(words).map_err(fault)?,
        }
    }
}

impl Draft {
    fn take(&mut self, words: &[&str]) -> Result<(), Problem> {
        let refuse = |what: String| Err(Problem::Ply(what));
        match words {
            ["format", name, "1.0"] => match *name {
                "ascii" => self.format = Some(None),
                "binary_little_endian" => self.format = Some(Some(Order::Little)),
                "binary_big_endian" => self.format = Some(Some(Order::Big)),
                _ => {
                    let what = "is not read; write ascii, binary_little_endian or binary_big_endian";
                    return refuse(format!("format {name} {what}"));
                }
            },
            ["element", name, count] => {
                let Ok(mut count) = count.parse() else {
                    return refuse(format!("{count:?} is not a number of elements"));
                };
                if *name == "vertex" {
                    if self.vertex.is_some() {
                        return refuse("there are two elements vertex; write one".into());
                    }
                    count = bounded(count as u64)?;
                    self.vertex = Some(self.elements.len());
                }
                self.elements.push(Element { count, properties: Vec::new() });
            }
            ["property", rest @ ..] => {
                let kind = match rest {
                    ["list", count, item, _] => Kind::List(length(count)?, scalar(item)?),
                    [kind, _] => Kind::One(scalar(kind)?),
                    _ => return refuse(format!("a property has a type and a name, not {:?}", rest.join(" "))),
                };
                let name = rest.last().map_or(String::new(), |name| (*name).to_owned());
                let Some(element) = self.elements.last_mut() else {
                    return refuse(format!("property {name} stands before any element"));
                };
                element.properties.push(Property { name, kind });
            }
            _ => {
                let text: String = words.join(" ").chars().take(40).collect();
                return refuse(format!("{text:?} does not belong in a PLY header"));
            }
        }
        Ok(())
    }

    fn finish(mut self) -> Result<Header, Problem> {
        let binary = self.format.ok_or_else(|| Problem::Ply("the PLY header has no format line".into()))?;
        let vertex = self.vertex.ok_or_else(|| Problem::Ply("the PLY header has no vertex element".into()))?;
        let more = self.elements.len() > vertex + 1;
        let vertices = self.elements.swap_remove(vertex);
        self.elements.truncate(vertex);
        Ok(Header { binary, before: self.elements, vertices, more })
    }
}

fn scalar(text: &str) -> Result<Scalar, Problem> {
    Ok(match text {
        "char" | "int8" => Scalar::Signed(1),
        "uchar" | "uint8" => Scalar::Unsigned(1),
        "short" | "int16" => Scalar::Signed(2),
        "ushort" | "uint16" => Scalar::Unsigned(2),
        "int" | "int32" => Scalar::Signed(4),
        "uint" | "uint32" => Scalar::Unsigned(4),
        "float" | "float32" => Scalar::F32,
        "double" | "float64" => Scalar::F64,
        _ => return Err(Problem::Ply(format!("{text} is no type of PLY"))),
    })
}

/// The type of a list's length.
fn length(text: &str) -> Result<Scalar, Problem> {
    let scalar = scalar(text)?;
    if scalar.is_whole() { Ok(scalar) } else { Err(Problem::Ply(format!("a list cannot have {text} for a length"))) }
}

//! The head of a PCD file: what a point holds, how many there are, and how they are stored.

use super::super::bounded::{Fault, bounded};
use super::super::error::Problem;
use super::super::scalar::Scalar;
use super::super::text::Lines;

/// Lines of a header at most.
const LINES_MAX: usize = 1000;
/// Bytes of one point at most, all fields together.
const RECORD_BYTES_MAX: usize = 1024;

/// How points are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Data {
    Ascii,
    Binary,
    Compressed,
}

/// One field of a point.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Field {
    pub name: String,
    pub scalar: Scalar,
    /// Numbers of it in one point. PCL pads with fields that have none.
    pub count: usize,
}

impl Field {
    pub fn bytes(&self) -> usize {
        self.count * self.scalar.bytes()
    }
}

/// What a header says.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    pub fields: Vec<Field>,
    pub height: u64,
    pub points: usize,
    /// Translation, then quaternion (w, x, y, z), as written, if it is stated.
    pub viewpoint: Option<[f64; 7]>,
    pub data: Data,
}

/// The words of the lines that matter, each with its line.
#[derive(Default)]
struct Entries<'a> {
    of_key: std::collections::BTreeMap<String, (usize, Vec<&'a str>)>,
}

/// Reads the lines up to `DATA`.
pub fn read(lines: &mut Lines<'_>) -> Result<Header, Fault> {
    let entries = Entries::read(lines)?;
    let fields = entries.fields()?;
    let record = fields.iter().map(Field::bytes).fold(0, usize::saturating_add);
    if record > RECORD_BYTES_MAX {
        return Err(entries.refuse("COUNT", format!("a point has {record} bytes; at most {RECORD_BYTES_MAX} are read")));
    }
    let data = match entries.word("DATA")?.to_ascii_lowercase().as_str() {
        "ascii" => Data::Ascii,
        "binary" => Data::Binary,
        "binary_compressed" => Data::Compressed,
        other => {
            let what = format!("DATA {other} is not read; write ascii, binary or binary_compressed");
            return Err(entries.refuse("DATA", what));
        }
    };
    let (points, height) = entries.points()?;
    Ok(Header { fields, height, points, viewpoint: entries.viewpoint()?, data })
}

impl<'a> Entries<'a> {
    fn read(lines: &mut Lines<'a>) -> Result<Self, Fault> {
        let mut entries = Self::default();
        while !entries.of_key.contains_key("DATA") {
            let line = lines.ended().filter(|_| lines.number <= LINES_MAX);
            let text = line.and_then(|line| str::from_utf8(line).ok());
            let Some(text) = text else {
                let what = "the PCD header does not end with a DATA line; is this a PCD file?".to_owned();
                return Err(Fault { line: Some(lines.number.max(1)), problem: Problem::Pcd(what) });
            };
            let mut words = text.split('#').next().unwrap_or_default().split_ascii_whitespace();
            if let Some(key) = words.next() {
                // The older name of the line.
                let key = key.to_ascii_uppercase().replace("COLUMNS", "FIELDS");
                entries.of_key.insert(key, (lines.number, words.collect()));
            }
        }
        Ok(entries)
    }

    /// A problem, told of the line of `key`.
    fn refuse(&self, key: &str, what: String) -> Fault {
        Fault { line: self.of_key.get(key).map(|(line, _)| *line), problem: Problem::Pcd(what) }
    }

    fn words(&self, key: &str) -> Result<&[&'a str], Fault> {
        let entry = self.of_key.get(key).ok_or_else(|| self.refuse("DATA", format!("the header has no {key} line")));
        entry.map(|(_, words)| words.as_slice())
    }

    fn word(&self, key: &str) -> Result<&'a str, Fault> {
        match self.words(key)? {
            [word] => Ok(word),
            words => Err(self.refuse(key, format!("{key} has {} words; one is wanted", words.len()))),
        }
    }

    fn number<T: std::str::FromStr>(&self, key: &str, word: &str) -> Result<T, Fault> {
        word.parse().map_err(|_| self.refuse(key, format!("{key}: {word:?} is no number that may stand here")))
    }

    fn fields(&self) -> Result<Vec<Field>, Fault> {
        let names = self.words("FIELDS")?;
        let column = |key: &str| -> Result<&[&'a str], Fault> {
            let words = self.words(key)?;
            if words.len() == names.len() {
                return Ok(words);
            }
            let (found, wanted) = (words.len(), names.len());
            Err(self.refuse(key, format!("{key} has {found} words for {wanted} fields; write one for each")))
        };
        let (sizes, types) = (column("SIZE")?, column("TYPE")?);
        let ones = vec!["1"; names.len()];
        let counts = if self.of_key.contains_key("COUNT") { column("COUNT")? } else { &ones };
        let mut fields = Vec::new();
        for (((name, size), kind), count) in names.iter().zip(sizes).zip(types).zip(counts) {
            let scalar = match (kind.to_ascii_uppercase().as_str(), self.number::<usize>("SIZE", size)?) {
                ("I", size @ (1 | 2 | 4 | 8)) => Scalar::Signed(size),
                ("U", size @ (1 | 2 | 4 | 8)) => Scalar::Unsigned(size),
                ("F", 4) => Scalar::F32,
                ("F", 8) => Scalar::F64,
                _ => {
                    let what = format!("field {name}: TYPE {kind} of SIZE {size} is no type of PCD; write F of 4 or 8");
                    return Err(self.refuse("TYPE", what));
                }
            };
            let count = self.number::<usize>("COUNT", count)?.min(RECORD_BYTES_MAX + 1);
            fields.push(Field { name: (*name).to_owned(), scalar, count });
        }
        Ok(fields)
    }

    /// How many points there are, and rows of them. What one line says and another does not is no matter; what two
    /// lines say differently is.
    fn points(&self) -> Result<(usize, u64), Fault> {
        let stated = |key: &str| -> Result<Option<u64>, Fault> {
            if !self.of_key.contains_key(key) {
                return Ok(None);
            }
            self.number(key, self.word(key)?).map(Some)
        };
        let (width, height, points) = (stated("WIDTH")?, stated("HEIGHT")?.unwrap_or(1), stated("POINTS")?);
        let grid = width.map(|width| width.saturating_mul(height));
        let count = match (points, grid) {
            (Some(points), Some(grid)) if points != grid => {
                let width = width.unwrap_or_default();
                let what = format!(
                    "POINTS {points} is not WIDTH {width} × HEIGHT {height} = {grid}; write in both how many points \
                     the file holds"
                );
                return Err(self.refuse("POINTS", what));
            }
            (points, grid) => points.or(grid),
        };
        let count = count.ok_or_else(|| self.refuse("DATA", "the header has no POINTS line".to_owned()))?;
        let line = self.of_key.get("POINTS").or(self.of_key.get("WIDTH")).map(|(line, _)| *line);
        Ok((bounded(count).map_err(|problem| Fault { line, problem })?, height))
    }

    fn viewpoint(&self) -> Result<Option<[f64; 7]>, Fault> {
        if !self.of_key.contains_key("VIEWPOINT") {
            return Ok(None);
        }
        let words = self.words("VIEWPOINT")?;
        let mut out = [0.0; 7];
        if words.len() != out.len() {
            let what = format!("VIEWPOINT has {} numbers; 7 are wanted: x y z qw qx qy qz", words.len());
            return Err(self.refuse("VIEWPOINT", what));
        }
        for (value, word) in out.iter_mut().zip(words) {
            *value = self.number("VIEWPOINT", word)?;
        }
        Ok(Some(out))
    }
}

//! The values of a PLY file's vertices, in whatever order and form it has them.

use super::super::bounded::Fault;
use super::super::error::Problem;
use super::super::scalar::Order;
use super::super::text::Lines;
use super::header::{Element, Header, Kind};

/// Calls `take` with the values of each vertex: those of the wanted properties, which are places among its own and no
/// lists.
pub fn rows(header: &Header, lines: &mut Lines<'_>, wanted: &[usize], take: impl FnMut(&[f64])) -> Result<(), Fault> {
    match header.binary {
        Some(order) => Ok(binary(header, Cursor { bytes: lines.rest(), order }, wanted, take)?),
        None => ascii(header, lines, wanted, take),
    }
}

/// Bytes read one after the other.
struct Cursor<'a> {
    bytes: &'a [u8],
    order: Order,
}

impl Cursor<'_> {
    /// Passes over one property; its value, unless it is a list. `None` where the bytes end.
    fn take(&mut self, kind: Kind) -> Option<f64> {
        match kind {
            Kind::One(scalar) => {
                let (own, rest) = self.bytes.split_at_checked(scalar.bytes())?;
                self.bytes = rest;
                Some(scalar.value(own, self.order))
            }
            Kind::List(length, item) => {
                // Of a negative length none is left.
                let items = self.take(Kind::One(length))? as usize;
                self.bytes = self.bytes.get(items.checked_mul(item.bytes())?..)?;
                Some(f64::NAN)
            }
        }
    }

    /// Passes over all of an element's.
    fn skip(&mut self, element: &Element) -> Option<()> {
        if let Some(bytes) = element.bytes() {
            self.bytes = self.bytes.get(element.count.checked_mul(bytes)?..)?;
            return Some(());
        }
        for _ in 0..element.count {
            for property in &element.properties {
                self.take(property.kind)?;
            }
        }
        Some(())
    }
}

fn binary(
    header: &Header,
    mut cursor: Cursor<'_>,
    wanted: &[usize],
    mut take: impl FnMut(&[f64]),
) -> Result<(), Problem> {
    let early = || Problem::Ply("the file ends before its vertices; was it cut off while being copied?".into());
    header.before.iter().try_for_each(|element| cursor.skip(element)).ok_or_else(early)?;
    let (vertices, found) = (&header.vertices, cursor.bytes.len());
    if let Some(bytes) = vertices.bytes() {
        let expected = vertices.count.saturating_mul(bytes);
        if found < expected || found > expected && !header.more {
            return Err(Problem::CloudLength { found, expected });
        }
    }
    let mut values = vec![f64::NAN; vertices.properties.len()];
    let mut row = vec![f64::NAN; wanted.len()];
    for index in 0..vertices.count {
        for (value, property) in values.iter_mut().zip(&vertices.properties) {
            let cut =
                || Problem::Ply(format!("the file ends within vertex {index}; was it cut off while being copied?"));
            *value = cursor.take(property.kind).ok_or_else(cut)?;
        }
        for (out, &place) in row.iter_mut().zip(wanted) {
            *out = values[place];
        }
        take(&row);
    }
    if !header.more && !cursor.bytes.is_empty() {
        return Err(Problem::CloudLength { found, expected: found - cursor.bytes.len() });
    }
    Ok(())
}

fn ascii(header: &Header, lines: &mut Lines<'_>, wanted: &[usize], mut take: impl FnMut(&[f64])) -> Result<(), Fault> {
    // An element without properties has an empty line, which is passed over as any is.
    for element in header.before.iter().filter(|element| !element.properties.is_empty()) {
        for _ in 0..element.count {
            if lines.full().is_none() {
                return Err(Problem::Ply("the file ends before its vertices; was it cut off?".into()).into());
            }
        }
    }
    let mut row = vec![f64::NAN; wanted.len()];
    for index in 0..header.vertices.count {
        let line = lines.full().unwrap_or_default();
        let refuse = |why: String| Fault { line: Some(lines.number), problem: Problem::Ply(why) };
        let words: Vec<&str> = str::from_utf8(line).unwrap_or_default().split_ascii_whitespace().collect();
        let Some(places) = places(&header.vertices, &words) else {
            let (found, due) = (words.len(), due(&header.vertices));
            return Err(refuse(format!("vertex {index} has {found} values instead of {due}; was the file cut off?")));
        };
        for (value, &place) in row.iter_mut().zip(wanted) {
            let word = places[place].unwrap_or_default();
            *value = word.parse().map_err(|_| refuse(format!("{word:?} is not a number")))?;
        }
        take(&row);
    }
    if !header.more && lines.full().is_some() {
        let why = format!("there is more after the {} vertices of the header", header.vertices.count);
        return Err(Fault { line: Some(lines.number), problem: Problem::Ply(why) });
    }
    Ok(())
}

/// The word of each property, of a list none; `None` if the words are not as many as they should be.
fn places<'a>(element: &Element, words: &[&'a str]) -> Option<Vec<Option<&'a str>>> {
    let (mut out, mut rest) = (Vec::with_capacity(element.properties.len()), words);
    for property in &element.properties {
        let (word, after) = rest.split_first()?;
        let is_one = matches!(property.kind, Kind::One(_));
        rest = if is_one { after } else { after.get(word.parse::<usize>().ok()?..)? };
        out.push(is_one.then_some(*word));
    }
    rest.is_empty().then_some(out)
}

/// How many values a vertex has, for people.
fn due(element: &Element) -> String {
    let is_list = |kind: Kind| matches!(kind, Kind::List(..));
    let lists = element.properties.iter().filter(|property| is_list(property.kind)).count();
    let ones = element.properties.len() - lists;
    if lists == 0 { ones.to_string() } else { format!("{ones} and {lists} lists, each after its length") }
}

//! Lines at the head of a file that may go on in binary. They end in LF, CR LF or, in files of old Macs, in CR; the
//! first end tells which, since no byte of what follows may be taken for one.

/// Lines of a file, counted from 1.
pub(super) struct Lines<'a> {
    bytes: &'a [u8],
    at: usize,
    end: u8,
    /// Lines so far.
    pub number: usize,
}

impl<'a> Lines<'a> {
    /// From the beginning of a file.
    pub fn of(bytes: &'a [u8]) -> Self {
        let first = bytes.iter().position(|b| matches!(b, b'\n' | b'\r'));
        let is_cr = first.is_some_and(|at| bytes[at] == b'\r' && bytes.get(at + 1) != Some(&b'\n'));
        Self { bytes, at: 0, end: if is_cr { b'\r' } else { b'\n' }, number: 0 }
    }

    /// The next line without its end and the blanks around it; `None` if no line ends any more.
    pub fn ended(&mut self) -> Option<&'a [u8]> {
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(|b| *b == self.end)?;
        self.at += length + 1;
        self.number += 1;
        Some(rest[..length].trim_ascii())
    }

    /// The next line that is not empty, whether it ends or the file does.
    pub fn full(&mut self) -> Option<&'a [u8]> {
        while self.at < self.bytes.len() {
            let line = self.ended().unwrap_or_else(|| {
                let rest = &self.bytes[self.at..];
                self.at = self.bytes.len();
                self.number += 1;
                rest.trim_ascii()
            });
            if !line.is_empty() {
                return Some(line);
            }
        }
        None
    }

    /// What follows the lines so far.
    pub fn rest(&self) -> &'a [u8] {
        &self.bytes[self.at..]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_end_tells_how_lines_end() {
        for (end, rest) in [("\n", "\r\n\n"), ("\r\n", "\n\r"), ("\r", "\n\n")] {
            let text = format!("a{end}{end} b {end}{rest}");
            let mut lines = Lines::of(text.as_bytes());
            assert_eq!(
                (lines.ended(), lines.ended(), lines.ended()),
                (Some(&b"a"[..]), Some(&b""[..]), Some(&b"b"[..]))
            );
            assert_eq!((lines.number, lines.rest()), (3, rest.as_bytes()), "{end:?}");
        }
        let mut lines = Lines::of(b"\n\na\n \nb");
        assert_eq!((lines.full(), lines.number), (Some(&b"a"[..]), 3));
        assert_eq!((lines.full(), lines.number), (Some(&b"b"[..]), 5));
        assert_eq!((lines.full(), lines.ended()), (None, None));
    }
}

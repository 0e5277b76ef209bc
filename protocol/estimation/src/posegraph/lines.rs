//! Lines of several files, counted through, so that one number finds a line again.

/// Where files begin among all lines that were read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Files {
    /// Lines before each file.
    starts: Vec<usize>,
    /// Lines so far.
    lines: usize,
}

/// A line of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    /// Which file, from 0, in the order in which they were begun.
    pub file: usize,
    /// Which of its lines, from 1.
    pub line: usize,
}

impl Files {
    /// Where a line is that was counted through all files, from 1.
    pub fn place(&self, line: usize) -> Place {
        let file = self.starts.partition_point(|&start| start < line).saturating_sub(1);
        Place { file, line: line - self.starts.get(file).copied().unwrap_or_default().min(line) }
    }

    /// The next line is the first of the next file.
    pub(super) fn begin(&mut self) {
        self.starts.push(self.lines);
    }

    /// Counts the next line; its number within its file.
    pub(super) fn advance(&mut self) -> usize {
        if self.starts.is_empty() {
            self.begin();
        }
        self.lines += 1;
        self.place(self.lines).line
    }

    /// The last line, counted through all files.
    pub(super) fn last(&self) -> usize {
        self.lines
    }
}

/// A file's line without the mark that some editors begin a file with.
pub(super) fn without_mark(text: &str, line: usize) -> &str {
    if line == 1 { text.strip_prefix('\u{feff}').unwrap_or(text) } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_counted_through_is_found_again() {
        let mut files = Files::default();
        let mut seen = Vec::new();
        for (file, lines) in [2, 0, 3, 1].into_iter().enumerate() {
            files.begin();
            for line in 1..=lines {
                assert_eq!(files.advance(), line);
                seen.push((files.last(), Place { file, line }));
            }
        }
        assert!(seen.iter().all(|&(line, place)| files.place(line) == place), "{seen:?}");
        let mut one = Files::default();
        assert_eq!((one.advance(), one.advance()), (1, 2));
        assert_eq!(one.place(2), Place { file: 0, line: 2 });
        assert_eq!(Files::default().place(0), Place { file: 0, line: 0 });
    }
}

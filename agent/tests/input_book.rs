//! The tables of `docs/input.md` say what is told of odd input. Each message in them is one that a test expects: its words
//! stand in some test's source, and in what is not a test.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// Letters that a piece of a message has at least, to be known again.
const LETTERS_MIN: usize = 12;

/// Messages that tests expect by what they are in the program, and not by their words.
const BY_KIND: [(&str, &str); 6] = [
    ("views of one submap do not fit together", "it_takes_a_full_window_and_its_median"),
    ("the body is tilted by", "a_tilted_body_is_refused"),
    ("taken for metres; if they are millimetres", "Remark::Whole"),
    ("wants more than 128 MiB", "a_packed_log_that_wants_a_large_dictionary"),
    ("m from the body in a cloud", "Problem::Offset"),
    ("the fourth number of point", "Problem::Reflectance"),
];

fn sources(folder: &Path, out: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() && !path.ends_with("fuzz") {
            sources(&path, out);
        } else if path.extension().is_some_and(|ending| ending == "rs") {
            out.push(path);
        }
    }
}

/// The text of a Rust source with its strings in one line each.
fn joined(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap();
    let mut parts = text.split("\\\n");
    let first = parts.next().unwrap_or_default().to_owned();
    parts.fold(first, |out, part| out + part.trim_start()).replace("\\\"", "\"")
}

/// The part of a source that is tests.
fn tests_of(path: &Path, text: &str) -> String {
    let name = path.file_name().unwrap().to_string_lossy();
    let is_test = name.ends_with("tests.rs") || path.components().any(|part| part.as_os_str() == "tests");
    if is_test {
        text.to_owned()
    } else {
        text.split_once("#[cfg(test)]").map_or(String::new(), |two| two.1.to_owned())
    }
}

/// The longest pieces of a message that do not differ from case to case: between `…`, numbers and names of files.
fn pieces(message: &str) -> Vec<String> {
    let plain: String = message.chars().map(|c| if c.is_ascii_digit() { '…' } else { c }).collect();
    let mut pieces: Vec<String> =
        plain.split('…').map(|piece| piece.trim_matches([' ', ',', ':', ';', '.']).to_owned()).collect();
    pieces.retain(|piece| piece.chars().filter(|c| c.is_alphabetic()).count() >= LETTERS_MIN);
    pieces
}

/// Literals of a source.
fn literals(text: &str) -> BTreeSet<String> {
    text.split('"')
        .map(str::trim)
        .filter(|part| part.len() >= LETTERS_MIN && part.len() < 400)
        .map(str::to_owned)
        .collect()
}

#[test]
fn each_message_of_the_book_is_expected_by_a_test() {
    let book = fs::read_to_string("docs/input.md").unwrap();
    let section = book.split("\n## ").find(|section| section.starts_with("What is odd")).unwrap();
    let mut files = Vec::new();
    for folder in ["src", "tests", "recording", "ros", "../protocol", "../tests"] {
        sources(Path::new(folder), &mut files);
    }
    files.retain(|path| !path.ends_with("input_book.rs"));
    let tests: Vec<String> = files.iter().map(|path| tests_of(path, &joined(path))).collect();
    let expected: BTreeSet<String> = tests.iter().flat_map(|text| literals(text)).collect();
    let rows = section.lines().filter(|line| line.starts_with("| "));
    let messages = rows.filter_map(|row| row.split(" | ").nth(1)).flat_map(|said| said.split('`').skip(1).step_by(2));
    // Options and fields are no messages.
    let messages: Vec<&str> =
        messages.filter(|message| message.contains(' ') && message.len() > 2 * LETTERS_MIN).collect();
    assert!(messages.len() > 30, "{messages:?}");
    let is_expected = |message: &&str| {
        pieces(message).iter().any(|piece| {
            expected.iter().any(|known| known.contains(piece.as_str()) || (piece.contains(known.as_str())))
        })
    };
    let is_by_kind = |message: &&str| {
        let kind = BY_KIND.iter().find(|(words, _)| message.contains(words));
        kind.is_some_and(|(_, kind)| tests.iter().any(|text| text.contains(kind)))
    };
    let unknown: Vec<&&str> = messages.iter().filter(|message| !is_expected(message) && !is_by_kind(message)).collect();
    assert!(unknown.is_empty(), "no test expects: {unknown:#?}");
}
